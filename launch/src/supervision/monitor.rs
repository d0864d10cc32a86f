//! Subscribes to all topics of a run and records every frame.

use carff::conditions::Conditions;
use carff::spans::KeptSpans;
use carff_config::GraphConfig;
use carff_decision::{Evidence, ImageEvidence};
use carff_messages::forms::AnyMessage;
use carff_messages::{
    Action, ActionCode, Belief, DatasetView, Forecast, FrameMeta, Gaussian, Header, Health, HealthState, ImageCheck,
    Observability, Posterior, Reason, Stage, UnknownBox, Unknowns, ViewMeta,
};
use carff_transport::{ImagePayload, Node, OpenError, ReceiveError, Receiver, topics};
use std::collections::{BTreeMap, VecDeque};

/// Record of a camera frame. Values from the dataset are -1 or `Unknown` without a dataset.
#[derive(Clone, Debug)]
pub struct FrameHistory {
    /// Frame number in the run.
    pub frame_id: u64,
    /// Camera pose.
    pub view: i32,
    /// Time step of the branch.
    pub branch: i32,
    /// Step of it.
    pub timestamp: i32,
    /// Number of the drive.
    pub drive: i32,
    /// Number of earlier frames of the drive.
    pub frame_in_drive: i32,
    /// True for the last frame of its time step, whose decision counts.
    pub last_of_timestamp: bool,
    /// Visibility of the actor or its place.
    pub observability: Option<Observability>,
    /// Capture time: monotonic clock, nanoseconds.
    pub capture_time_ns: u64,
    /// Number of the first frame of the take, where there is a posterior.
    pub take_start: u64,
    /// Posterior from the encoder.
    pub posterior: Option<Gaussian>,
    /// Evidence of the image, if it was compared with the known states.
    pub image: Option<ImageEvidence>,
    /// Evidence of the belief's steps that have arrived.
    pub(crate) evidence: Evidence,
    /// Number of these steps, and the number of the last one; 0 until it has arrived.
    pub(crate) steps: [u32; 2],
    /// Decision based on the frame.
    pub action: Option<ActionCode>,
    /// Reason of the decision; also set if a belief about the frame was refused.
    pub reason: Option<Reason>,
    /// Hazard probability of the decision.
    pub hazard_probability: f32,
    /// Probability of something unknown in the decision.
    pub unknown_probability: f32,
    /// Confidence of the decision.
    pub confidence: f32,
    /// Time from capture to the publication of the decision, nanoseconds; 0 without a decision.
    pub latency_ns: u64,
}

impl FrameHistory {
    /// Creates the record of a frame without a decision.
    fn of(header: &Header, view: &DatasetView) -> Self {
        Self {
            frame_id: header.frame_id,
            view: view.view,
            branch: view.branch,
            timestamp: view.timestamp,
            drive: view.drive,
            frame_in_drive: view.frame_in_drive,
            last_of_timestamp: view.is_last_of_timestamp(),
            observability: Observability::of_code(view.observability).ok().flatten(),
            capture_time_ns: header.capture_time_ns,
            take_start: 0,
            posterior: None,
            image: None,
            evidence: Evidence::NONE,
            steps: [0; 2],
            action: None,
            reason: None,
            hazard_probability: 0.0,
            unknown_probability: 0.0,
            confidence: 0.0,
            latency_ns: 0,
        }
    }

    /// Returns the evidence of the whole belief; `None` if a step of it did not arrive.
    pub fn evidence(&self) -> Option<Evidence> {
        let [arrived, last] = self.steps;
        (last > 0 && arrived == last).then_some(self.evidence)
    }

    fn take_belief(&mut self, belief: &Belief) {
        self.evidence.add_belief(belief);
        self.steps[0] += 1;
        if belief.is_final() {
            self.steps[1] = belief.header.step;
        }
    }
}

/// Health reports of a stage, summed over its restarts.
#[derive(Clone, Copy, Debug, Default)]
pub struct StageSummary {
    /// Latest heartbeat.
    pub last: Option<Health>,
    /// Messages skipped in favour of newer ones.
    pub skipped: u64,
    /// Invalid messages dropped.
    pub invalid: u64,
    /// Errors.
    pub errors: u64,
    /// Maximum resident memory, bytes.
    pub max_rss_bytes: u64,
    /// Counts of earlier processes.
    earlier: [u64; 3],
}

impl StageSummary {
    fn take(&mut self, health: &Health) {
        if self.last.is_some_and(|last| last.pid != health.pid) {
            self.earlier = [self.skipped, self.invalid, self.errors];
        }
        self.skipped = self.earlier[0] + health.skipped;
        self.invalid = self.earlier[1] + health.invalid;
        self.errors = self.earlier[2] + health.errors;
        self.max_rss_bytes = self.max_rss_bytes.max(health.rss_bytes);
        self.last = Some(*health);
    }

    /// Returns the state in the last heartbeat.
    pub fn state(&self) -> HealthState {
        self.last.and_then(|h| h.state().ok()).unwrap_or(HealthState::Starting)
    }
}

/// Images in which something stands that no known state explains.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UnknownImages {
    /// Images with a probability of something unknown of at least 0.5.
    pub images: u64,
    /// Frame number and box of the most probable one; `None` if no image has a box.
    pub surest: Option<(u64, UnknownBox)>,
}

impl UnknownImages {
    fn take(&mut self, unknowns: &Unknowns) {
        self.images += u64::from(carff_decision::is_likely(f64::from(unknowns.probability)));
        // Boxes begin with the most probable one.
        if let Some(first) = unknowns.boxes().first()
            && self.surest.is_none_or(|(_, known)| first.probability > known.probability)
        {
            self.surest = Some((unknowns.header.frame_id, *first));
        }
    }
}

/// Records of a run: the newest frames and times, up to a limit.
#[derive(Clone, Debug, Default)]
pub struct Records {
    /// Values that the graph file requests, and the limit of records.
    wanted: Wanted,
    /// Frames by number.
    pub frames: BTreeMap<u64, FrameHistory>,
    /// Number of valid camera frames that the launcher has read.
    pub frames_seen: u64,
    /// Number of published actions, both decisions and repeats.
    pub actions: u64,
    /// Number of published actions that the launcher did not read in time, because it was stopped or slow.
    pub actions_not_recorded: u64,
    /// Sequence number of the next action.
    next_action: u64,
    /// Safe actions by reason.
    pub safe_actions: BTreeMap<&'static str, u64>,
    /// Conditions of the camera, by its checked images.
    pub conditions: Conditions,
    /// Number of images that were compared with the known states.
    pub compared: u64,
    /// Images among them with something unknown.
    pub unknown: UnknownImages,
    /// Duration of each comparison, nanoseconds.
    pub compare_ns: VecDeque<u64>,
    /// Reductions under overload: beliefs with fewer samples, frames with fewer steps, and views with fewer pixels than
    /// the graph file requests.
    pub given_up: BTreeMap<&'static str, u64>,
    /// Duration of each forecast step, nanoseconds.
    pub forecaster_ns: VecDeque<u64>,
    /// Duration of each probing step, nanoseconds.
    pub prober_ns: VecDeque<u64>,
    /// Duration of each frame's encoding, nanoseconds.
    pub encoder_ns: VecDeque<u64>,
    /// Duration of each view's rendering, nanoseconds.
    pub renderer_ns: VecDeque<u64>,
    /// Health reports of the stages.
    pub stages: BTreeMap<Stage, StageSummary>,
    /// Publication time of each stage's latest message: monotonic clock, nanoseconds.
    pub spoke_ns: BTreeMap<Stage, u64>,
}

/// Values that the graph file requests.
#[derive(Clone, Copy, Debug, Default)]
struct Wanted {
    keep: usize,
    samples: u32,
    horizon: u32,
    width_px: u32,
}

impl Records {
    /// Returns the frames in order.
    pub fn frames(&self) -> Vec<FrameHistory> {
        self.frames.values().cloned().collect()
    }

    /// Returns the number of captured frames, including frames that the launcher could not record.
    pub fn frame_count(&self) -> u64 {
        self.frames.last_key_value().map_or(0, |(last, _)| last + 1)
    }

    /// Returns the number of frames that a stage of the decision path skipped.
    pub fn skipped(&self) -> u64 {
        [Stage::Encoder, Stage::Forecaster, Stage::Prober, Stage::Controller]
            .iter()
            .filter_map(|stage| self.stages.get(stage))
            .map(|s| s.skipped)
            .sum()
    }

    fn note_time(times_ns: &mut VecDeque<u64>, time_ns: u64, keep: usize) {
        if times_ns.len() >= keep {
            times_ns.pop_front();
        }
        times_ns.push_back(time_ns);
    }

    fn give_up(&mut self, what: &'static str, given_up: bool) {
        *self.given_up.entry(what).or_default() += u64::from(given_up);
    }

    fn take_frame(&mut self, meta: &FrameMeta) {
        self.spoke_ns.insert(Stage::Camera, meta.header.publish_time_ns);
        self.frames_seen += 1;
        self.record(FrameHistory::of(&meta.header, &meta.dataset_view));
    }

    fn record(&mut self, record: FrameHistory) {
        self.frames.insert(record.frame_id, record);
        while self.frames.len() > self.wanted.keep {
            self.frames.pop_first();
        }
    }

    fn take_posterior(&mut self, posterior: &Posterior) {
        self.spoke_ns.insert(Stage::Encoder, posterior.header.publish_time_ns);
        Self::note_time(&mut self.encoder_ns, posterior.stage_latency_ns, self.wanted.keep);
        if let Some(frame) = self.frames.get_mut(&posterior.header.frame_id) {
            (frame.posterior, frame.take_start) = (Some(posterior.gaussian), posterior.take_start);
        }
    }

    fn take_check(&mut self, check: &ImageCheck) {
        self.spoke_ns.insert(Stage::Encoder, check.header.publish_time_ns);
        self.conditions.take_check(check);
    }

    fn take_unknowns(&mut self, unknowns: &Unknowns) {
        self.compared += 1;
        self.unknown.take(unknowns);
        Self::note_time(&mut self.compare_ns, unknowns.stage_latency_ns, self.wanted.keep);
        if let Some(frame) = self.frames.get_mut(&unknowns.header.frame_id) {
            frame.image = Some(ImageEvidence::from(unknowns));
        }
    }

    fn take_belief(&mut self, belief: &Belief) {
        // A belief depends on a forecast: both stages have published.
        for stage in [Stage::Forecaster, Stage::Prober] {
            self.spoke_ns.insert(stage, belief.header.publish_time_ns);
        }
        Self::note_time(&mut self.forecaster_ns, belief.forecaster_ns, self.wanted.keep);
        Self::note_time(&mut self.prober_ns, belief.stage_latency_ns, self.wanted.keep);
        self.give_up("samples", belief.sample_count < self.wanted.samples);
        self.give_up("horizon", belief.header.step == 1 && belief.horizon < self.wanted.horizon);
        if let Some(frame) = self.frames.get_mut(&belief.header.frame_id) {
            frame.take_belief(belief);
        }
    }

    fn take_view(&mut self, view: &ViewMeta) {
        self.spoke_ns.insert(Stage::Renderer, view.header.publish_time_ns);
        Self::note_time(&mut self.renderer_ns, view.stage_latency_ns, self.wanted.keep);
        self.give_up("resolution", view.width_px < self.wanted.width_px);
    }

    /// Returns the frame that was decided on, if the action is a decision.
    fn take_action(&mut self, action: &Action) -> Option<u64> {
        self.actions += 1;
        // A restarted controller counts from 0 again.
        self.actions_not_recorded += action.header.sequence.saturating_sub(self.next_action);
        self.next_action = action.header.sequence + 1;
        self.spoke_ns.insert(Stage::Controller, action.header.publish_time_ns);
        self.conditions.take_action(action);
        let reason = action.reason().ok()?;
        if reason != Reason::Belief {
            *self.safe_actions.entry(reason.name()).or_default() += 1;
        }
        if !action.is_decision() {
            return None;
        }
        // A replay of later messages has no camera.
        if !self.spoke_ns.contains_key(&Stage::Camera) && !self.frames.contains_key(&action.based_on_frame) {
            let header = Header { frame_id: action.based_on_frame, ..action.header };
            self.record(FrameHistory::of(&header, &DatasetView::UNKNOWN));
        }
        let frame = self.frames.get_mut(&action.based_on_frame)?;
        frame.action = action.code().ok();
        frame.reason = Some(reason);
        frame.hazard_probability = action.hazard_probability;
        frame.unknown_probability = action.unknown_probability;
        frame.confidence = action.confidence;
        frame.latency_ns = action.header.publish_time_ns.saturating_sub(action.header.capture_time_ns);
        Some(frame.frame_id)
    }
}

/// Subscriptions to all topics of a run.
#[derive(Debug)]
pub struct Monitor {
    frames: Receiver<ImagePayload<FrameMeta>>,
    posteriors: Receiver<Posterior>,
    checks: Receiver<ImageCheck>,
    unknowns: Receiver<Unknowns>,
    forecasts: Receiver<Forecast>,
    beliefs: Receiver<Belief>,
    actions: Receiver<Action>,
    views: Receiver<ImagePayload<ViewMeta>>,
    healths: Vec<Receiver<Health>>,
    spans: KeptSpans,
    /// Records of the run.
    pub records: Records,
}

impl Monitor {
    /// Subscribes without being notified of messages: notifications would take a core from the stages. The stages' work
    /// on each frame is kept in `spans`.
    pub fn open(node: &Node, graph: &GraphConfig, spans: KeptSpans) -> Result<Self, OpenError> {
        let wanted = Wanted {
            keep: graph.launcher.keep_frames as usize,
            samples: graph.run.samples,
            horizon: graph.run.horizon,
            width_px: graph.renderer.width_px,
        };
        let healths = Stage::ALL.iter().map(|&stage| Ok(node.receiver(topics::health(stage))?.polled()));
        Ok(Self {
            frames: node.receiver(&topics::FRAME)?.polled(),
            posteriors: node.receiver(&topics::POSTERIOR)?.polled(),
            checks: node.receiver(&topics::CHECK)?.polled(),
            unknowns: node.receiver(&topics::UNKNOWN)?.polled(),
            forecasts: node.receiver(&topics::FORECAST)?.polled(),
            beliefs: node.receiver(&topics::BELIEF)?.polled(),
            actions: node.receiver(&topics::ACTION)?.polled(),
            views: node.receiver(&topics::VIEW)?.polled(),
            healths: healths.collect::<Result<_, _>>()?,
            spans,
            records: Records { wanted, ..Records::default() },
        })
    }

    /// Reads all waiting messages. Calls `decided` for each frame with a decision.
    pub fn drain(&mut self, mut decided: impl FnMut(&FrameHistory)) -> Result<(), ReceiveError> {
        // Topics are read in the order of the data flow, so that each message finds its frame.
        while let Some(frame) = self.frames.next()? {
            self.spans.add(AnyMessage::new(&*frame, &[]));
            self.records.take_frame(&frame);
        }
        while let Some(posterior) = self.posteriors.next()? {
            self.spans.add(AnyMessage::new(&*posterior, &[]));
            self.records.take_posterior(&posterior);
        }
        while let Some(check) = self.checks.next()? {
            self.records.take_check(&check);
        }
        while let Some(unknowns) = self.unknowns.next()? {
            self.records.take_unknowns(&unknowns);
        }
        while let Some(forecast) = self.forecasts.next()? {
            self.spans.add(AnyMessage::new(&*forecast, &[]));
        }
        while let Some(belief) = self.beliefs.next()? {
            self.spans.add(AnyMessage::new(&*belief, &[]));
            self.records.take_belief(&belief);
        }
        while let Some(action) = self.actions.next()? {
            self.spans.add(AnyMessage::new(&*action, &[]));
            if let Some(frame) = self.records.take_action(&action).and_then(|id| self.records.frames.get(&id)) {
                decided(frame);
            }
        }
        while let Some(view) = self.views.next()? {
            self.spans.add(AnyMessage::new(&*view, &[]));
            self.records.take_view(&view);
        }
        for receiver in &mut self.healths {
            while let Some(health) = receiver.next()? {
                if let Ok(stage) = health.stage() {
                    self.records.stages.entry(stage).or_default().take(&health);
                }
            }
        }
        self.spans.write();
        Ok(())
    }
}
