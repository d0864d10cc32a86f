//! Health, rates and resource use of a run's stages over time, for the full-screen view and the metrics.

use crate::conditions::Conditions;
use crate::session::{Going, Session};
use carff_messages::forms::AnyMessage;
use carff_messages::{
    Action, ActionCode, Belief, Forecast, FrameMeta, Health, HealthState, ImageCheck, Posterior, Reason, Stage,
    ViewMeta,
};
use carff_transport::TopicId;
use carff_transport::monotonic_now_ns;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use std::collections::{BTreeMap, VecDeque};

/// Number of latencies kept for each stage and for the whole loop.
const REMEMBERED: usize = 240;
/// Time window of rates, nanoseconds.
const RATE_NS: u64 = 3_000_000_000;
/// Time between two readings of the processor times, nanoseconds.
const PROCESSORS_NS: u64 = 1_000_000_000;

/// Health, rates and resource use of one stage.
#[derive(Clone, Debug, Default)]
pub(crate) struct StageVitals {
    /// The state that it last reported.
    pub(crate) state: Option<HealthState>,
    /// Process id; 0 before the first heartbeat.
    pub(crate) pid: u32,
    /// Time of its last message: monotonic clock, nanoseconds.
    pub(crate) heard_ns: u64,
    /// Number of messages on its topic.
    pub(crate) messages: u64,
    /// Publish times of its latest messages.
    published_ns: VecDeque<u64>,
    /// Latest latencies, milliseconds: from the arrival of an input to the output, as the stage measures it.
    pub(crate) latency_ms: VecDeque<f64>,
    /// Longest latency since the stage's start, milliseconds.
    pub(crate) max_latency_ms: f64,
    /// Resident memory, bytes.
    pub(crate) rss_bytes: u64,
    /// Skipped inputs, invalid inputs and errors since its start.
    pub(crate) counts: [u64; 3],
    /// Number of new processes since the observation started.
    pub(crate) restarts: u64,
    /// Number of heartbeats that reported `slow` or `stale`.
    pub(crate) late: u64,
    /// Share of a core, 0 to the number of cores.
    pub(crate) cpu: f64,
    /// Processor time since the stage's start, nanoseconds.
    pub(crate) cpu_ns: u64,
    /// Number of outputs in its last heartbeat.
    published: u64,
    cpu_seen: Option<(u64, u64)>,
}

impl StageVitals {
    /// Returns the recent rate of messages, hertz.
    pub(crate) fn rate_hz(&self, now_ns: u64) -> f64 {
        let from_ns = now_ns.saturating_sub(RATE_NS);
        let recent = self.published_ns.iter().filter(|&&at| at >= from_ns).count();
        recent as f64 / (RATE_NS as f64 / 1e9)
    }

    /// Returns the reported state, or `silent` if heartbeats are missing.
    pub(crate) fn state_name(&self, now_ns: u64) -> &'static str {
        match self.state {
            None => "unknown",
            Some(HealthState::Done) => HealthState::Done.name(),
            Some(_) if now_ns.saturating_sub(self.heard_ns) > RATE_NS => "silent",
            Some(state) => state.name(),
        }
    }
}

/// Health, decisions and resource use of one run. All counts of messages start with the observation.
#[derive(Clone, Debug, Default)]
pub(crate) struct RunVitals {
    pub(crate) stages: BTreeMap<Stage, StageVitals>,
    /// Number of frames from the camera.
    pub(crate) frames: u64,
    /// Number of actions by name.
    pub(crate) actions: BTreeMap<&'static str, u64>,
    /// Number of safe actions by reason.
    pub(crate) safe_actions: BTreeMap<&'static str, u64>,
    /// Conditions of the camera.
    pub(crate) conditions: Conditions,
    /// Number of decisions on a frame.
    pub(crate) decisions: u64,
    /// Time from camera to action of the latest decisions, milliseconds.
    pub(crate) decided_ms: VecDeque<f64>,
    /// Hazard probability of the latest action.
    pub(crate) hazard_probability: f32,
    /// Probability of something unknown in the latest action.
    pub(crate) unknown_probability: f32,
    /// The latest action and its reason.
    pub(crate) last_action: Option<(&'static str, &'static str)>,
    pub(crate) histograms: Histograms,
}

/// A label of a metric, with its value.
pub(crate) type Labels = [(&'static str, &'static str); 1];

/// Distributions of times, seconds.
#[derive(Clone, Debug)]
pub(crate) struct Histograms {
    /// From capture to decision.
    pub(crate) camera_to_action: Histogram,
    /// From the arrival of an input to the output.
    pub(crate) stages: Family<Labels, Histogram, fn() -> Histogram>,
}

impl Default for Histograms {
    fn default() -> Self {
        // From 0.5 ms to 4 s.
        let histogram = || Histogram::new(exponential_buckets(0.0005, 2.0, 14));
        Self { camera_to_action: histogram(), stages: Family::new_with_constructor(histogram) }
    }
}

fn remember<T>(values: &mut VecDeque<T>, value: T) {
    if values.len() >= REMEMBERED {
        values.pop_front();
    }
    values.push_back(value);
}

/// The stage that sent a message, and the time that it took, nanoseconds, where the message states it.
pub(crate) fn stage_latency_ns(message: AnyMessage<'_>) -> Option<(Stage, u64)> {
    let encoder = message.get::<Posterior>().map(|m| (Stage::Encoder, m.stage_latency_ns));
    let forecaster = || message.get::<Forecast>().map(|m| (Stage::Forecaster, m.stage_latency_ns));
    let prober = || message.get::<Belief>().map(|m| (Stage::Prober, m.stage_latency_ns));
    let renderer = || message.get::<ViewMeta>().map(|m| (Stage::Renderer, m.stage_latency_ns));
    encoder.or_else(forecaster).or_else(prober).or_else(renderer)
}

impl RunVitals {
    /// The topics that it reads.
    pub(crate) fn topics() -> impl Iterator<Item = TopicId> {
        TopicId::all()
    }

    /// Adds a message.
    pub(crate) fn take(&mut self, message: AnyMessage<'_>) {
        let header = message.header();
        if let Some(health) = message.get::<Health>() {
            return self.take_health(health);
        }
        if let Some(check) = message.get::<ImageCheck>() {
            return self.conditions.take_check(check);
        }
        // Camera and controller report their latency in heartbeats only.
        let (stage, latency_ns) = if message.get::<FrameMeta>().is_some() {
            self.frames += 1;
            (Stage::Camera, None)
        } else if let Some(action) = message.get::<Action>() {
            self.take_action(action);
            (Stage::Controller, None)
        } else if let Some((stage, latency_ns)) = stage_latency_ns(message) {
            (stage, Some(latency_ns))
        } else {
            return;
        };
        let vitals = self.stages.entry(stage).or_default();
        vitals.messages += 1;
        remember(&mut vitals.published_ns, header.publish_time_ns);
        if let Some(latency_ns) = latency_ns {
            self.take_latency(stage, latency_ns);
        }
    }

    fn take_latency(&mut self, stage: Stage, latency_ns: u64) {
        let vitals = self.stages.entry(stage).or_default();
        let latency_ms = latency_ns as f64 / 1e6;
        vitals.max_latency_ms = vitals.max_latency_ms.max(latency_ms);
        remember(&mut vitals.latency_ms, latency_ms);
        self.histograms.stages.get_or_create(&[("stage", stage.name())]).observe(latency_ns as f64 / 1e9);
    }

    fn take_action(&mut self, m: &Action) {
        let (action, reason) = (m.code().map_or("?", ActionCode::name), m.reason().map_or("?", Reason::name));
        *self.actions.entry(action).or_default() += 1;
        if m.reason() != Ok(Reason::Belief) {
            *self.safe_actions.entry(reason).or_default() += 1;
        }
        if m.is_decision() {
            self.decisions += 1;
            remember(&mut self.decided_ms, m.latency_ns as f64 / 1e6);
            self.histograms.camera_to_action.observe(m.latency_ns as f64 / 1e9);
        }
        (self.hazard_probability, self.last_action) = (m.hazard_probability, Some((action, reason)));
        self.unknown_probability = m.unknown_probability;
    }

    fn take_health(&mut self, m: &Health) {
        let Ok(stage) = m.stage() else { return };
        let vitals = self.stages.entry(stage).or_default();
        if vitals.pid != 0 && vitals.pid != m.pid {
            vitals.restarts += 1;
            (vitals.cpu_seen, vitals.max_latency_ms, vitals.published) = (None, 0.0, 0);
        }
        vitals.state = m.state().ok();
        vitals.late += u64::from(matches!(vitals.state, Some(HealthState::Slow | HealthState::Stale)));
        (vitals.pid, vitals.rss_bytes, vitals.heard_ns) = (m.pid, m.rss_bytes, m.header.publish_time_ns);
        vitals.counts = [m.skipped, m.invalid, m.errors];
        vitals.max_latency_ms = vitals.max_latency_ms.max(m.max_latency_ns as f64 / 1e6);
        let has_worked = m.published > std::mem::replace(&mut vitals.published, m.published);
        if has_worked && matches!(stage, Stage::Camera | Stage::Controller) {
            self.take_latency(stage, m.last_latency_ns);
        }
    }

    /// Adds a run's messages until the run is over, or until `after`, which is called after each reading, returns
    /// false.
    pub(crate) fn gather(
        &mut self,
        session: &mut Session,
        mut after: impl FnMut(&Self) -> anyhow::Result<bool>,
    ) -> anyhow::Result<Going> {
        let mut processors_ns = 0;
        loop {
            session.take(|_, message| {
                self.take(message.message());
                Ok(())
            })?;
            let now_ns = monotonic_now_ns();
            if now_ns >= processors_ns {
                processors_ns = now_ns + PROCESSORS_NS;
                self.look_at_processors();
            }
            if !after(self)? {
                return Ok(Going::Done);
            }
            match session.pause()? {
                Going::On => {}
                over => return Ok(over),
            }
        }
    }

    /// Updates the processor use of each process since the last reading.
    fn look_at_processors(&mut self) {
        let now_ns = monotonic_now_ns();
        for vitals in self.stages.values_mut().filter(|v| v.pid != 0) {
            let Some(used_ns) =
                std::fs::read_to_string(format!("/proc/{}/stat", vitals.pid)).ok().and_then(|s| used_ns(&s))
            else {
                continue;
            };
            vitals.cpu_ns = used_ns;
            if let Some((before_ns, at_ns)) = vitals.cpu_seen.replace((used_ns, now_ns)) {
                vitals.cpu = used_ns.saturating_sub(before_ns) as f64 / now_ns.saturating_sub(at_ns).max(1) as f64;
            }
        }
    }
}

/// Returns the processor time in a process's `stat` file, nanoseconds.
fn used_ns(stat: &str) -> Option<u64> {
    // The name, in brackets, may contain any character.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(ticks * (1_000_000_000 / rustix::param::clock_ticks_per_second().max(1)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Gaussian, Header, Rule};

    fn health(pid: u32, state: HealthState) -> Health {
        Health {
            header: Header { publish_time_ns: 1_000, ..Header::of_frame(0, 1, 1) },
            stage: Stage::Prober.code(),
            state: state.code(),
            pid,
            received: 0,
            published: 0,
            skipped: 3,
            invalid: 2,
            errors: 1,
            last_latency_ns: 0,
            max_latency_ns: 5_000_000,
            last_progress_ns: 0,
            rss_bytes: 1 << 20,
        }
    }

    /// A new process counts as a restart, slow and stale heartbeats count as late, and silence is reported.
    #[test]
    fn heartbeats_are_gathered() {
        let mut run = RunVitals::default();
        for (pid, state) in
            [(5, HealthState::Ok), (5, HealthState::Slow), (6, HealthState::Stale), (6, HealthState::Ok)]
        {
            run.take(AnyMessage::new(&health(pid, state), &[]));
        }
        let prober = &run.stages[&Stage::Prober];
        assert_eq!((prober.restarts, prober.late, prober.counts, prober.max_latency_ms), (1, 2, [3, 2, 1], 5.0));
        assert_eq!((prober.state_name(2_000), prober.state_name(1_000 + 2 * RATE_NS)), ("ok", "silent"));
    }

    /// Counts start with the observation, at any frame number. The latency of a stage is what the stage measures, also
    /// of the controller, whose actions state the time since the capture; so no latency is above its maximum.
    #[test]
    fn figures_do_not_contradict_each_other() {
        let mut run = RunVitals::default();
        let header = Header { publish_time_ns: 90_000_000, ..Header::of_frame(500, 1_000, 1) };
        for sequence in 0..3 {
            run.take(AnyMessage::new(
                &FrameMeta { header: Header { sequence, ..header }, ..FrameMeta::default() },
                &[],
            ));
            run.take(AnyMessage::new(&action(30_000_000), &[]));
        }
        for (stage, published) in [(Stage::Camera, 3), (Stage::Controller, 7), (Stage::Controller, 7)] {
            let beat = Health {
                stage: stage.code(),
                published,
                last_latency_ns: 100_000,
                max_latency_ns: 200_000,
                ..health(5, HealthState::Ok)
            };
            run.take(AnyMessage::new(&beat, &[]));
        }
        assert_eq!((run.frames, run.decisions), (3, 3));
        for stage in [Stage::Camera, Stage::Controller] {
            let vitals = &run.stages[&stage];
            assert_eq!(
                (vitals.messages, &vitals.latency_ms, vitals.max_latency_ms),
                (3, &[0.1].into(), 0.2),
                "{stage}"
            );
        }
        assert_eq!(run.decided_ms.len(), 3);
        // The heartbeat with the new maximum comes after the output.
        let posterior =
            Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 7_000_000 };
        run.take(AnyMessage::new(&posterior, &[]));
        assert_eq!(run.stages[&Stage::Encoder].max_latency_ms, 7.0);
    }

    fn action(latency_ns: u64) -> Action {
        Action {
            action: ActionCode::Advance.code(),
            sample_count: 10,
            confidence: 1.0,
            hazard_probability: 0.1,
            is_decision: 1,
            valid_until_ns: 1,
            based_on_frame: 7,
            latency_ns,
            ..Action::halt(Header::of_frame(7, 1, 1), Reason::Belief, Rule::Calibrated)
        }
    }

    /// Each decision counts once; safe actions count by their reason.
    #[test]
    fn actions_are_counted() {
        let mut run = RunVitals::default();
        let mut action = action(20_000_000);
        run.take(AnyMessage::new(&action, &[]));
        (action.is_decision, action.action, action.reason) = (0, ActionCode::Halt.code(), Reason::StaleBelief.code());
        run.take(AnyMessage::new(&action, &[]));
        assert_eq!((run.decisions, run.decided_ms.len()), (1, 1));
        assert_eq!((run.actions["advance"], run.actions["halt"], run.safe_actions["stale belief"]), (1, 1, 1));
        assert_eq!(run.last_action, Some(("halt", "stale belief")));
    }

    /// Processor time is read for any process name.
    #[test]
    fn processor_time_is_read() {
        let stat = "12 (a ) b) S 1 12 12 0 -1 4194560 100 0 0 0 30 20 0 0 20 0 1 0 5 1 1";
        assert_eq!(used_ns(stat), Some(50 * (1_000_000_000 / rustix::param::clock_ticks_per_second())));
        assert_eq!(used_ns("nothing"), None);
    }
}
