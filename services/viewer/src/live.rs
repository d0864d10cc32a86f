//! Watches a running graph frame by frame. It attaches as a probe, so it never delays a stage.

use crate::input::{ChosenImage, Truth};
use crate::journal::{Journal, ShownDecision};
use crate::session::{Moment, ShownForecast};
use carff_dataset::Image;
use carff_decision::Step;
use carff_messages::{
    Action, ActionCode, Belief, FrameMeta, Gaussian, Health, Observability, Posterior, Reason, Rule, Stage, UnknownBox,
    Unknowns,
};
use carff_observe::{AttachError, Attached, LiveRun, attach};
use carff_transport::{OpenError, ReceiveError, Receiver, topics};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Polling interval of the topics.
const LOOK: Duration = Duration::from_millis(20);
/// Interval at which the feed checks whether the run is still alive or has come back.
const LOOK_FOR_RUN: Duration = Duration::from_secs(1);
/// Maximum number of unfinished frames; the oldest are dropped.
const MOST_FRAMES: usize = 32;

/// Reason why a run cannot be watched.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The run cannot be joined.
    #[error(transparent)]
    Attach(#[from] AttachError),
    /// A topic cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// A topic can no longer be read.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// No thread could be started.
    #[error("cannot start a thread to watch the run: {0}")]
    Thread(std::io::Error),
}

/// State of a watched run.
#[derive(Clone, Debug)]
pub struct WatchedRun {
    /// The run at the last join.
    pub run: LiveRun,
    /// Ok while joined, else the reason why not. The feed retries every second.
    pub joined: Result<(), String>,
    /// Number of frames received.
    pub frames: u64,
    /// Decisions, and durations by frame.
    pub journal: Journal,
    /// Last health report of each stage.
    pub health: BTreeMap<Stage, Health>,
    /// Moments of the newest frame with a complete belief, until they are taken.
    newest: Option<Vec<Moment>>,
}

/// Watches a run on its own thread until the feed is dropped.
pub struct LiveFeed {
    watched: Arc<Mutex<WatchedRun>>,
    stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl LiveFeed {
    /// Joins the named run, or the only live run. The feed calls `wake` when it has news.
    pub fn attach(run: Option<String>, wake: impl Fn() + Send + 'static) -> Result<Self, LiveError> {
        let stopped = Arc::new(AtomicBool::new(false));
        let theirs = stopped.clone();
        // The thread joins, so that everything of the run stays in it. This function waits for its first answer.
        let (answer, answered) = mpsc::sync_channel(1);
        let thread = std::thread::Builder::new()
            .name("live".into())
            .spawn(move || match Watcher::join(run.as_deref()) {
                Err(error) => drop(answer.send(Err(error))),
                Ok(watcher) => {
                    let watched = Arc::new(Mutex::new(WatchedRun::of(watcher.attached.live.clone())));
                    if answer.send(Ok(watched.clone())).is_ok() {
                        watch(watcher, &watched, &theirs, &wake);
                    }
                }
            })
            .map_err(LiveError::Thread)?;
        let gone = |_| LiveError::Thread(std::io::Error::other("it ended at once"));
        let watched = answered.recv().map_err(gone)??;
        Ok(Self { watched, stopped, thread: Some(thread) })
    }

    /// Returns the current state of the run.
    pub fn watched(&self) -> MutexGuard<'_, WatchedRun> {
        locked(&self.watched)
    }

    /// Returns the moments of the newest frame if they are new.
    pub fn take_newest(&self) -> Option<Vec<Moment>> {
        self.watched().newest.take()
    }
}

impl Drop for LiveFeed {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The thread ends early only by a panic, which has been reported by then.
            let _ = thread.join();
        }
    }
}

/// Locks the state. It is consistent at any time, so a poisoned lock is harmless.
fn locked(watched: &Mutex<WatchedRun>) -> MutexGuard<'_, WatchedRun> {
    watched.lock().unwrap_or_else(PoisonError::into_inner)
}

impl WatchedRun {
    fn of(run: LiveRun) -> Self {
        Self { run, joined: Ok(()), frames: 0, journal: Journal::default(), health: BTreeMap::new(), newest: None }
    }
}

/// Watches until it is stopped, and rejoins when the run ends and comes back.
fn watch(first: Watcher, watched: &Mutex<WatchedRun>, stopped: &AtomicBool, wake: &dyn Fn()) {
    let name = first.attached.live.name.clone();
    let mut watcher = Some(first);
    let mut looked = Instant::now();
    while !stopped.load(Ordering::Relaxed) {
        let mut lost = None;
        if let Some(joined) = &mut watcher {
            match joined.drain(watched) {
                Ok(true) => wake(),
                Ok(false) => {}
                Err(error) => lost = Some(error.to_string()),
            }
        }
        if looked.elapsed() >= LOOK_FOR_RUN || lost.is_some() {
            looked = Instant::now();
            match &watcher {
                Some(joined) if lost.is_none() && joined.attached.live.is_alive() => {}
                Some(_) => {
                    watcher = None;
                    let why = lost.unwrap_or_else(|| format!("run `{name}` has ended"));
                    locked(watched).joined = Err(why);
                    wake();
                }
                None => match Watcher::join(Some(&name)) {
                    Ok(joined) => {
                        *locked(watched) = WatchedRun::of(joined.attached.live.clone());
                        watcher = Some(joined);
                        wake();
                    }
                    Err(LiveError::Attach(AttachError::NoRun | AttachError::NoSuchRun { .. })) => {}
                    Err(error) => locked(watched).joined = Err(error.to_string()),
                },
            }
        }
        std::thread::sleep(LOOK);
    }
}

/// Subscriptions to a run's topics.
struct Watcher {
    attached: Attached,
    frames: Receiver<carff_transport::ImagePayload<FrameMeta>>,
    posteriors: Receiver<Posterior>,
    forecasts: Receiver<carff_messages::Forecast>,
    unknowns: Receiver<Unknowns>,
    beliefs: Receiver<Belief>,
    actions: Receiver<Action>,
    healths: Vec<Receiver<Health>>,
    assembly: Assembly,
    /// The last action that was not a decision; only changes are recorded.
    last_safe: Option<(ActionCode, Reason)>,
}

impl Watcher {
    fn join(run: Option<&str>) -> Result<Self, LiveError> {
        let attached = attach(run, "viewer")?;
        let node = &attached.node;
        let healths = Stage::ALL.iter().map(|&stage| Ok(node.receiver(topics::health(stage))?.polled()));
        Ok(Self {
            frames: node.receiver(&topics::FRAME)?.polled(),
            posteriors: node.receiver(&topics::POSTERIOR)?.polled(),
            forecasts: node.receiver(&topics::FORECAST)?.polled(),
            unknowns: node.receiver(&topics::UNKNOWN)?.polled(),
            beliefs: node.receiver(&topics::BELIEF)?.polled(),
            actions: node.receiver(&topics::ACTION)?.polled(),
            healths: healths.collect::<Result<_, OpenError>>()?,
            assembly: Assembly::default(),
            last_safe: None,
            attached,
        })
    }

    /// Reads all waiting messages; returns whether the window has news.
    fn drain(&mut self, watched: &Mutex<WatchedRun>) -> Result<bool, ReceiveError> {
        let mut is_new = false;
        // Topics are read in the order of the data flow, so that each message finds its frame.
        while let Some(frame) = self.frames.next()? {
            let meta = &*frame;
            locked(watched).frames = meta.header.frame_id + 1;
            self.assembly.frame(meta.header.frame_id, input(meta, frame.bytes()));
        }
        while let Some(posterior) = self.posteriors.next()? {
            let (frame, took_ns) = (posterior.header.frame_id, posterior.stage_latency_ns);
            locked(watched).journal.took("encoder", frame as f64, took_ns as f64 * 1e-6);
            self.assembly.posterior(&posterior);
        }
        while let Some(forecast) = self.forecasts.next()? {
            self.assembly.forecast(&forecast);
        }
        while let Some(unknowns) = self.unknowns.next()? {
            self.assembly.unknowns(&unknowns);
        }
        while let Some(belief) = self.beliefs.next()? {
            let frame = belief.header.frame_id as f64;
            let mut now = locked(watched);
            now.journal.took("forecaster", frame, belief.forecaster_ns as f64 * 1e-6);
            now.journal.took("prober", frame, belief.stage_latency_ns as f64 * 1e-6);
            if let Some(moments) = self.assembly.belief(&belief) {
                now.newest = Some(moments);
                is_new = true;
            }
        }
        while let Some(action) = self.actions.next()? {
            let mut now = locked(watched);
            if let Some(decision) = decision(&action, &mut self.last_safe) {
                if let Some(ms) = decision.latency_ms {
                    now.journal.took("camera to action", action.based_on_frame as f64, ms);
                }
                now.journal.decided(decision);
                is_new = true;
            }
        }
        for receiver in &mut self.healths {
            while let Some(health) = receiver.next()? {
                if let Ok(stage) = health.stage() {
                    locked(watched).health.insert(stage, *health);
                }
            }
        }
        Ok(is_new)
    }
}

/// Returns an entry for the first action on a frame, and for a safe action that differs from the last one.
fn decision(action: &Action, last_safe: &mut Option<(ActionCode, Reason)>) -> Option<ShownDecision> {
    let (code, reason) = (action.code().ok()?, action.reason().ok()?);
    let decided = action.is_decision();
    if reason == Reason::Belief {
        *last_safe = None;
        if !decided {
            return None;
        }
    } else if last_safe.replace((code, reason)) == Some((code, reason)) {
        return None;
    }
    let rule = Rule::try_from(action.rule).ok()?;
    let rests_on = match action.based_on_frame {
        u64::MAX => "no frame".to_owned(),
        frame => format!("frame {frame}"),
    };
    Some(ShownDecision {
        rests_on,
        action: code,
        confidence: action.confidence,
        hazard_probability: action.hazard_probability,
        reason: if reason == Reason::Belief { rule.name() } else { reason.name() }.to_owned(),
        latency_ms: (decided && action.latency_ns > 0).then_some(action.latency_ns as f64 * 1e-6),
    })
}

/// Assembles the messages of each frame.
#[derive(Default)]
struct Assembly {
    frames: BTreeMap<u64, Parts>,
}

struct Parts {
    input: Arc<ChosenImage>,
    unknowns: Arc<[UnknownBox]>,
    forecasts: BTreeMap<u32, carff_messages::Forecast>,
    moments: Vec<Moment>,
    /// The state that the last belief resolved to, and its posterior: the source of the next forecast.
    fed_back: Option<(Gaussian, usize)>,
}

impl Assembly {
    fn frame(&mut self, frame_id: u64, input: ChosenImage) {
        let parts = Parts {
            input: Arc::new(input),
            unknowns: Arc::default(),
            forecasts: BTreeMap::new(),
            moments: Vec::new(),
            fed_back: None,
        };
        self.frames.insert(frame_id, parts);
        while self.frames.len() > MOST_FRAMES {
            self.frames.pop_first();
        }
    }

    fn posterior(&mut self, posterior: &Posterior) {
        if let Some(parts) = self.frames.get_mut(&posterior.header.frame_id) {
            parts.moments = vec![Moment::of_posterior(parts.input.clone(), posterior.gaussian)];
        }
    }

    fn forecast(&mut self, forecast: &carff_messages::Forecast) {
        if let Some(parts) = self.frames.get_mut(&forecast.header.frame_id) {
            parts.forecasts.insert(forecast.header.step, *forecast);
        }
    }

    fn unknowns(&mut self, unknowns: &Unknowns) {
        if let Some(parts) = self.frames.get_mut(&unknowns.header.frame_id) {
            parts.unknowns = unknowns.boxes().into();
        }
    }

    /// Returns all moments of a frame when its last belief arrives.
    fn belief(&mut self, belief: &Belief) -> Option<Vec<Moment>> {
        let frame_id = belief.header.frame_id;
        let parts = self.frames.get_mut(&frame_id)?;
        let forecast = parts.forecasts.get(&belief.header.step)?;
        // A step without the step before it cannot be followed: the window joined in between.
        let before = parts.moments.last().filter(|m| m.step + 1 == belief.header.step)?;
        let moment = moment(before, parts.fed_back, forecast, belief);
        parts.moments.push(moment);
        let state = usize::try_from(belief.resolved_state).ok().filter(|_| belief.fed_back().is_empty());
        parts.fed_back = state.map(|state| (belief.resolved, state));
        if !belief.is_final() {
            return None;
        }
        let Parts { mut moments, unknowns, .. } = self.frames.remove(&frame_id)?;
        for moment in &mut moments {
            moment.unknowns = unknowns.clone();
        }
        // Older frames are no longer needed.
        self.frames.retain(|id, _| *id > frame_id);
        Some(moments)
    }
}

/// Returns the input image of a frame.
fn input(meta: &FrameMeta, bytes: &[u8]) -> ChosenImage {
    let view = &meta.dataset_view;
    let observability = Observability::of_code(view.observability).ok().flatten();
    let index = |value: i32| usize::try_from(value).ok();
    let truth = match (index(view.branch), index(view.timestamp), index(view.view)) {
        (Some(branch), Some(timestamp), Some(view)) => Some(Truth { branch, timestamp, view, observability }),
        _ => None,
    };
    ChosenImage {
        title: format!("frame {}", meta.header.frame_id),
        image: Image { width_px: meta.width_px, height_px: meta.height_px, rgb: bytes.to_vec() },
        camera: Some(meta.camera()),
        truth: truth.filter(|_| view.is_known()),
        frame: meta.header.frame_id,
        seed: Some(meta.header.seed),
    }
}

/// Returns the moment of a step from the graph's messages. `fed_back` is the state that the step before resolved to.
fn moment(
    before: &Moment,
    fed_back: Option<(Gaussian, usize)>,
    forecast: &carff_messages::Forecast,
    belief: &Belief,
) -> Moment {
    let step = Step::of_messages(forecast, belief);
    let (mixture, draws) = (step.mixture.clone(), step.draws.clone());
    let (source, source_state) = match fed_back {
        Some((gaussian, state)) => (gaussian, Some(state)),
        None => (before.source, before.source_state),
    };
    let path = before.steps().cloned().collect();
    let path_probability = forecast.path_probability;
    let before = Moment { source, source_state, path_probability, path, ..before.clone() };
    Moment {
        belief: Some(step),
        ..Moment::of_forecast(&before, forecast.header.step, ShownForecast { mixture, draws })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_decision::Draw;
    use carff_messages::{ForecastSource, Header};

    fn meta(frame_id: u64) -> FrameMeta {
        let dataset_view = carff_messages::DatasetView {
            known: 1,
            view: 7,
            branch: 1,
            timestamp: 2,
            observability: carff_messages::Observability::None.code(),
            ..carff_messages::DatasetView::UNKNOWN
        };
        FrameMeta {
            header: Header::of_frame(frame_id, 5, 77),
            width_px: 2,
            height_px: 1,
            dataset_view,
            ..FrameMeta::default()
        }
    }

    fn posterior(frame_id: u64) -> Posterior {
        let header = Header::of_frame(frame_id, 5, 77);
        Posterior {
            header,
            gaussian: Gaussian { mean: [0.5; 8], ..Gaussian::standard() },
            take_start: 0,
            stage_latency_ns: 0,
        }
    }

    fn forecast(frame_id: u64, step: u32) -> carff_messages::Forecast {
        let header = Header::of_frame(frame_id, 5, 77).at_step(step);
        let mut forecast = carff_messages::Forecast::empty(header, ForecastSource::Observed, 2);
        (forecast.component_count, forecast.sample_count) = (2, 3);
        forecast.weights[..2].copy_from_slice(&[0.25, 0.75]);
        forecast.samples[2] = [step as f32; 8];
        forecast.sample_component[2] = 1;
        forecast.path_probability = 1.0 / step as f32;
        forecast
    }

    fn belief(frame_id: u64, step: u32) -> Belief {
        let mut belief = Belief::empty(Header::of_frame(frame_id, 5, 77).at_step(step), 2);
        (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (4, 2, 2, 3);
        belief.state_probability[..4].copy_from_slice(&[0.1, 0.6, 0.2, 0.1]);
        belief.samples[2].state = 1;
        belief.samples[2].occupancies[1] = 0.875;
        belief.resolved_state = 1;
        belief.resolved.mean = [9.0; 8];
        belief.path_probability = 1.0 / step as f32;
        belief
    }

    /// A frame's messages become its moments: the posterior, and each step with its belief. The second step starts from
    /// the state that the first resolved to. Nothing is shown before the last belief.
    #[test]
    fn messages_become_moments() {
        let mut assembly = Assembly::default();
        assembly.frame(3, input(&meta(3), &[1, 2, 3, 4, 5, 6]));
        assembly.posterior(&posterior(3));
        for step in [1, 2] {
            assembly.forecast(&forecast(3, step));
        }
        let mut unknowns = Unknowns::of_frame(Header::of_frame(3, 5, 77));
        (unknowns.box_count, unknowns.boxes[0].probability) = (1, 0.9);
        assembly.unknowns(&unknowns);
        assert!(assembly.belief(&belief(3, 1)).is_none());
        let moments = assembly.belief(&belief(3, 2)).unwrap();
        assert_eq!(moments.iter().map(|m| m.step).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(moments.iter().all(|m| m.unknowns[..] == unknowns.boxes[..1]));
        let input = &moments[0].input;
        assert_eq!((input.image.rgb.as_slice(), input.seed), ([1, 2, 3, 4, 5, 6].as_slice(), Some(77)));
        let truth = input.truth.unwrap();
        assert_eq!(
            (truth.branch, truth.timestamp, truth.view, truth.observability),
            (1, 2, 7, Some(Observability::None))
        );
        assert_eq!((moments[1].source.mean, moments[1].source_state), ([0.5; 8], None));
        assert_eq!((moments[2].source.mean, moments[2].source_state), ([9.0; 8], Some(1)));
        let last = &moments[2];
        assert_eq!((last.path_probability, last.path.len()), (0.5, 1));
        let step = last.belief.as_ref().unwrap();
        assert_eq!(step.resolved.state_probabilities, [0.1, 0.6, 0.2, 0.1]);
        assert_eq!((step.samples[2].reading.state, step.samples[1].reading.state), (Some(1), None));
        assert_eq!(step.samples[2].occupancies, [0.0, 0.875]);
        assert_eq!(last.forecast.as_ref().unwrap().draws[2], Draw { latent: [2.0; 8], component: 1 });
        assert_eq!(last.selection, crate::session::Selection::Component(1));
    }

    /// Frames without their first message or without an earlier step make no moment. The number of unfinished frames is
    /// bounded.
    #[test]
    fn what_is_incomplete_is_left_out() {
        let mut assembly = Assembly::default();
        assembly.posterior(&posterior(1));
        assembly.forecast(&forecast(1, 2));
        assert!(assembly.belief(&belief(1, 2)).is_none());
        assembly.frame(2, input(&meta(2), &[0; 6]));
        assembly.posterior(&posterior(2));
        assembly.forecast(&forecast(2, 2));
        assert!(assembly.belief(&belief(2, 2)).is_none());
        for frame_id in 3..200 {
            assembly.frame(frame_id, input(&meta(frame_id), &[0; 6]));
        }
        assert_eq!(assembly.frames.len(), MOST_FRAMES);
    }

    /// A decision is recorded once per frame; a safe action is recorded when it begins and when its reason changes.
    #[test]
    fn decisions_are_written_down_once() {
        let action = |reason: Reason, is_decision| Action {
            sample_count: 10,
            confidence: 0.5,
            hazard_probability: 0.5,
            is_decision,
            based_on_frame: 4,
            latency_ns: 2_500_000,
            ..Action::halt(Header::of_frame(4, 5, 77), reason, Rule::Calibrated)
        };
        let mut last = None;
        let stream = [
            (Reason::NoBeliefYet, 0, true),
            (Reason::NoBeliefYet, 0, false),
            (Reason::Belief, 1, true),
            (Reason::Belief, 0, false),
            (Reason::StaleBelief, 0, true),
            (Reason::NoBeliefYet, 0, true),
        ];
        for (reason, is_decision, written) in stream {
            assert_eq!(decision(&action(reason, is_decision), &mut last).is_some(), written, "{reason}");
        }
        let decided = decision(&action(Reason::Belief, 1), &mut last).unwrap();
        assert_eq!(
            (decided.latency_ms, decided.reason.as_str(), decided.action),
            (Some(2.5), "calibrated", ActionCode::Halt)
        );
    }
}
