//! Starts a graph of all stages as the launcher does, and receives its messages.

use crate::helper::{PATIENCE, ask_to_end, cpu_seconds, end_by};
use crate::probes::Probes;
use anyhow::{Context, bail, ensure};
use carff_config::{GraphConfig, StagesConfig};
use carff_messages::{Action, Belief, Forecast, FrameMeta, Health, HealthState, Posterior, Stage, Unknowns};
use carff_runtime::StageArgs;
use carff_transport::{
    ImagePayload, Node, Receiver, Run, Stop, Waiter, Woken, monotonic_now_ns, remove_run_leftovers, run_id_of, topics,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Time between two checks of the stages while they start.
const WATCH_NS: u64 = 50_000_000;
/// Time between two readings of the messages.
const LOOK_NS: u64 = 10_000_000;
/// Time limit for the last frames.
const TAIL: Duration = Duration::from_millis(500);

/// Graph to measure, and its folders.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct GraphArgs {
    /// The graph file.
    #[arg(long, default_value = "configs/graphs/approaching-intersection.toml")]
    graph: PathBuf,
    /// Folder of the dataset. Default: that of the graph file.
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// Folder of the checkpoint. Default: that of the graph file.
    #[arg(long)]
    checkpoint: Option<PathBuf>,
}

impl GraphArgs {
    /// Reads the graph file, and resolves the folders.
    pub(crate) fn load(&self) -> anyhow::Result<Subject> {
        let graph = GraphConfig::load(&self.graph)?;
        let resolve = |given: &Option<PathBuf>, own: &Path| graph.resolve(given.as_deref().unwrap_or(own));
        Ok(Subject {
            dataset: resolve(&self.dataset, &graph.run.dataset),
            checkpoint: resolve(&self.checkpoint, &graph.run.checkpoint),
            graph,
        })
    }
}

/// A graph and its folders.
#[derive(Clone, Debug)]
pub(crate) struct Subject {
    pub(crate) graph: GraphConfig,
    pub(crate) dataset: PathBuf,
    pub(crate) checkpoint: PathBuf,
}

impl Subject {
    /// Refuses a dataset that does not exist.
    pub(crate) fn check_dataset(&self) -> anyhow::Result<()> {
        let folder = self.dataset.display();
        ensure!(self.dataset.is_dir(), "dataset {folder} is missing: `carff launch` renders it, or give --dataset");
        Ok(())
    }
}

/// Settings of one measurement.
#[derive(Clone, Debug)]
pub(crate) struct Plan<'a> {
    /// The graph, with the settings to measure.
    pub(crate) graph: GraphConfig,
    pub(crate) dataset: &'a Path,
    pub(crate) checkpoint: &'a Path,
    /// Frames of this initial time do not count.
    pub(crate) warm_up: Duration,
    pub(crate) measured: Duration,
    /// Number of additional subscribers to frames, beliefs and actions, in one process.
    pub(crate) probes: usize,
}

/// Times of one frame on the monotonic clock, nanoseconds.
#[derive(Clone, Debug, Default)]
#[allow(clippy::struct_field_names, reason = "the postfix is the unit")]
struct Frame {
    captured_ns: u64,
    published_ns: u64,
    /// Start and end of the encoder's work.
    encoded_ns: Option<(u64, u64)>,
    /// End of the comparison of the image, which the prober does before it probes.
    compared_ns: Option<u64>,
    /// Start and end of each step's forecast and probing.
    forecast_ns: BTreeMap<u32, (u64, u64)>,
    probed_ns: BTreeMap<u32, (u64, u64)>,
    decided_ns: Option<u64>,
}

impl Frame {
    /// Returns the time between stages by hand-over: from the publication of a message to the start of the next stage,
    /// nanoseconds. A hand-over may occur several times. `None` if a message was not received.
    fn gaps_ns(&self) -> Option<Vec<(HandOver, u64)>> {
        let (begin, mut end) = self.encoded_ns?;
        let mut gaps = vec![("camera to encoder", begin.saturating_sub(self.published_ns))];
        let mut from = "encoder to forecaster";
        for (step, forecast) in &self.forecast_ns {
            let probed = self.probed_ns.get(step)?;
            gaps.push((from, forecast.0.saturating_sub(end)));
            let ready_ns = forecast.1.max(self.compared_ns.filter(|at_ns| *at_ns <= probed.0).unwrap_or(0));
            gaps.push(("forecaster to prober", probed.0.saturating_sub(ready_ns)));
            (from, end) = ("prober to forecaster", probed.1);
        }
        gaps.push(("prober to controller", self.decided_ns?.saturating_sub(end)));
        Some(gaps)
    }
}

/// Sending and receiving stage, as in `camera to encoder`.
pub(crate) type HandOver = &'static str;

/// Resources of a stage during the measurement.
#[derive(Clone, Debug)]
pub(crate) struct Use {
    pub(crate) stage: Stage,
    /// Cores in use on average.
    pub(crate) cores: f64,
    /// Resident memory at the end, bytes.
    pub(crate) resident_bytes: f64,
}

/// Result of a measurement.
#[derive(Clone, Debug)]
pub(crate) struct Measured {
    /// Time from camera to action of each frame, milliseconds.
    pub(crate) latency_ms: Vec<f64>,
    /// Time between stages as a share of the time from camera to action, of all frames.
    pub(crate) ipc_share: f64,
    /// Time of each hand-over in each frame, milliseconds.
    pub(crate) hand_overs_ms: BTreeMap<HandOver, Vec<f64>>,
    /// Number of captured frames.
    pub(crate) frames: usize,
    /// Number of captured frames without an action.
    pub(crate) missed: usize,
    /// Frame rate that the camera reached, Hz.
    pub(crate) rate_hz: f64,
    /// Number of views from the renderer.
    pub(crate) views: u64,
    pub(crate) uses: Vec<Use>,
    /// Cores that the probes' process uses on average.
    pub(crate) probe_cores: f64,
    /// Number of messages that all probes read.
    pub(crate) probed: u64,
}

impl Measured {
    /// Returns true if every frame was decided, at the requested rate.
    pub(crate) fn held(&self, wanted_hz: f64) -> bool {
        self.missed == 0 && self.frames > 1 && self.rate_hz > 0.98 * wanted_hz
    }
}

/// Runs a graph for the planned time.
pub(crate) fn measure(plan: &Plan<'_>) -> anyhow::Result<Measured> {
    let folder = tempfile::tempdir()?;
    let name = format!("bench-{}", std::process::id());
    let run = Run::new(&name, run_id_of(&name, monotonic_now_ns()))?;
    remove_run_leftovers(&run)?;
    let file = folder.path().join("graph.toml");
    std::fs::write(&file, toml::to_string(&plan.graph)?)?;
    let mut args = StageArgs::new(&file, &name, run.id());
    args.dataset = Some(std::path::absolute(plan.dataset)?);
    args.checkpoint = Some(std::path::absolute(plan.checkpoint)?);
    args.parent_pid = Some(std::process::id());
    let result = {
        let node = Node::open(&run, "bench")?;
        let mut listener = Listener::open(&node)?;
        let programs = plan.graph.stages.clone();
        let mut stages = Stages { children: Vec::new(), logs: folder.path().to_owned(), programs };
        listen(plan, &args, &run, &mut listener, &mut stages)
    };
    remove_run_leftovers(&run)?;
    result
}

fn listen(
    plan: &Plan<'_>,
    args: &StageArgs,
    run: &Run,
    listener: &mut Listener,
    stages: &mut Stages,
) -> anyhow::Result<Measured> {
    let waiter = Waiter::new(Stop::on_signals()?);
    let take = |listener: &mut Listener, until_ns: u64| -> anyhow::Result<()> {
        ensure!(waiter.wait_until(&[], until_ns.min(monotonic_now_ns() + LOOK_NS))? != Woken::Stopped, "interrupted");
        listener.drain()
    };
    let limit = Duration::from_millis(plan.graph.launcher.start_timeout_ms);
    for batch in [&Stage::START_ORDER[..5], &Stage::START_ORDER[5..]] {
        for &stage in batch {
            stages.start(stage, args)?;
        }
        let begun = Instant::now();
        while !batch.iter().all(|stage| listener.ready.contains_key(stage)) {
            stages.check()?;
            ensure!(begun.elapsed() < limit, "the stages were not ready within {} ms", limit.as_millis());
            take(listener, monotonic_now_ns() + WATCH_NS)?;
        }
    }
    let probes = if plan.probes > 0 { Some(Probes::start(run, plan.probes)?) } else { None };
    let probes_s = || probes.as_ref().map_or(0.0, Probes::cpu_seconds);
    let from_ns = monotonic_now_ns() + plan.warm_up.as_nanos() as u64;
    while monotonic_now_ns() < from_ns {
        take(listener, from_ns)?;
    }
    let (used_before, probes_before, views_before) = (stages.cpu_seconds(), probes_s(), listener.views);
    let to_ns = from_ns + plan.measured.as_nanos() as u64;
    while monotonic_now_ns() < to_ns {
        take(listener, to_ns)?;
    }
    let seconds = (monotonic_now_ns() - from_ns) as f64 / 1e9;
    let (used, views) = (stages.cpu_seconds(), listener.views - views_before);
    let probe_cores = (probes_s() - probes_before) / seconds;
    let uses = stages
        .children
        .iter()
        .zip(used_before.iter().zip(&used))
        .map(|((stage, child), (before, after))| Use {
            stage: *stage,
            cores: (after - before) / seconds,
            resident_bytes: resident_bytes(child.id()),
        })
        .collect();
    let tail_ns = monotonic_now_ns() + TAIL.as_nanos() as u64;
    while monotonic_now_ns() < tail_ns {
        take(listener, tail_ns)?;
    }
    stages.check()?;
    let probed = probes.map_or(Ok(0), Probes::finish)?;
    let used = Used { views, uses, probe_cores, probed };
    Ok(measured(listener, [from_ns, to_ns], used))
}

/// Work of the stages and probes in the measured time.
struct Used {
    views: u64,
    uses: Vec<Use>,
    probe_cores: f64,
    probed: u64,
}

/// Returns the figures of the frames that were captured in an interval.
fn measured(listener: &Listener, [from_ns, to_ns]: [u64; 2], used: Used) -> Measured {
    let Used { views, uses, probe_cores, probed } = used;
    let frames: Vec<&Frame> = listener.frames.values().filter(|f| (from_ns..to_ns).contains(&f.captured_ns)).collect();
    // Frame numbers have no gaps: a missing number is a frame that was not received.
    let (first, last) = (
        listener.frames.iter().find(|(_, f)| f.captured_ns >= from_ns).map_or(0, |(id, _)| *id),
        listener.frames.iter().rfind(|(_, f)| f.captured_ns < to_ns).map_or(0, |(id, _)| *id + 1),
    );
    let decided: Vec<(&Frame, u64)> = frames.iter().filter_map(|f| Some((*f, f.decided_ns?))).collect();
    let (mut all_ns, mut between_ns) = (0, 0);
    let mut hand_overs_ms = BTreeMap::<HandOver, Vec<f64>>::new();
    for (frame, decided_ns) in &decided {
        let Some(gaps) = frame.gaps_ns() else { continue };
        all_ns += decided_ns - frame.captured_ns;
        for (name, gap_ns) in gaps {
            between_ns += gap_ns;
            hand_overs_ms.entry(name).or_default().push(gap_ns as f64 / 1e6);
        }
    }
    let span_ns = frames.last().map_or(0, |f| f.captured_ns) - frames.first().map_or(0, |f| f.captured_ns);
    let count = last.saturating_sub(first) as usize;
    Measured {
        latency_ms: decided.iter().map(|(f, at)| (at - f.captured_ns) as f64 / 1e6).collect(),
        ipc_share: between_ns as f64 / all_ns as f64,
        hand_overs_ms,
        missed: count - decided.len(),
        frames: count,
        rate_hz: count.saturating_sub(1) as f64 / (span_ns as f64 / 1e9),
        views,
        uses,
        probe_cores,
        probed,
    }
}

/// Receives all messages of a run, by polling: wake-ups by each message would take a core from the stages.
struct Listener {
    frames_in: Receiver<ImagePayload<FrameMeta>>,
    posteriors: Receiver<Posterior>,
    unknowns: Receiver<Unknowns>,
    forecasts: Receiver<Forecast>,
    beliefs: Receiver<Belief>,
    actions: Receiver<Action>,
    views_in: Receiver<carff_transport::ImagePayload<carff_messages::ViewMeta>>,
    healths: Vec<Receiver<Health>>,
    frames: BTreeMap<u64, Frame>,
    views: u64,
    ready: BTreeMap<Stage, u32>,
}

impl Listener {
    fn open(node: &Node) -> anyhow::Result<Self> {
        let healths = Stage::ALL.iter().map(|&stage| Ok(node.receiver(topics::health(stage))?.polled()));
        Ok(Self {
            frames_in: node.receiver(&topics::FRAME)?.polled(),
            posteriors: node.receiver(&topics::POSTERIOR)?.polled(),
            unknowns: node.receiver(&topics::UNKNOWN)?.polled(),
            forecasts: node.receiver(&topics::FORECAST)?.polled(),
            beliefs: node.receiver(&topics::BELIEF)?.polled(),
            actions: node.receiver(&topics::ACTION)?.polled(),
            views_in: node.receiver(&topics::VIEW)?.polled(),
            healths: healths.collect::<Result<_, carff_transport::OpenError>>()?,
            frames: BTreeMap::new(),
            views: 0,
            ready: BTreeMap::new(),
        })
    }

    fn drain(&mut self) -> anyhow::Result<()> {
        while let Some(image) = self.frames_in.next()? {
            let header = &image.header;
            let frame = self.frames.entry(header.frame_id).or_default();
            (frame.captured_ns, frame.published_ns) = (header.capture_time_ns, header.publish_time_ns);
        }
        let span = |published_ns: u64, latency_ns: u64| (published_ns.saturating_sub(latency_ns), published_ns);
        while let Some(m) = self.posteriors.next()? {
            if let Some(frame) = self.frames.get_mut(&m.header.frame_id) {
                frame.encoded_ns = Some(span(m.header.publish_time_ns, m.stage_latency_ns));
            }
        }
        while let Some(m) = self.unknowns.next()? {
            if let Some(frame) = self.frames.get_mut(&m.header.frame_id) {
                frame.compared_ns = Some(m.header.publish_time_ns);
            }
        }
        while let Some(m) = self.forecasts.next()? {
            if let Some(frame) = self.frames.get_mut(&m.header.frame_id) {
                frame.forecast_ns.insert(m.header.step, span(m.header.publish_time_ns, m.stage_latency_ns));
            }
        }
        while let Some(m) = self.beliefs.next()? {
            if let Some(frame) = self.frames.get_mut(&m.header.frame_id) {
                frame.probed_ns.insert(m.header.step, span(m.header.publish_time_ns, m.stage_latency_ns));
            }
        }
        while let Some(m) = self.actions.next()? {
            if m.is_decision()
                && let Some(frame) = self.frames.get_mut(&m.based_on_frame)
            {
                frame.decided_ns = Some(m.header.publish_time_ns);
            }
        }
        while self.views_in.next()?.is_some() {
            self.views += 1;
        }
        for receiver in &mut self.healths {
            while let Some(health) = receiver.next()? {
                let ready = health.state().is_ok_and(|s| !matches!(s, HealthState::Starting | HealthState::Faulty));
                if let (true, Ok(stage)) = (ready, health.stage()) {
                    self.ready.insert(stage, health.pid);
                }
            }
        }
        Ok(())
    }
}

/// The stages' processes. Dropping ends them.
struct Stages {
    children: Vec<(Stage, Child)>,
    logs: PathBuf,
    programs: StagesConfig,
}

impl Stages {
    fn start(&mut self, stage: Stage, args: &StageArgs) -> anyhow::Result<()> {
        let folder = std::env::current_exe()?.parent().context("this program has no folder")?.to_owned();
        let program = folder.join(self.programs.program(stage));
        let log = std::fs::File::create(self.log(stage))?;
        let child = Command::new(&program)
            .args(args.to_command_line())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .with_context(|| format!("cannot start {}; build it with `cargo build --release`", program.display()))?;
        self.children.push((stage, child));
        Ok(())
    }

    fn log(&self, stage: Stage) -> PathBuf {
        self.logs.join(format!("{stage}.log"))
    }

    /// Fails if a stage has ended.
    fn check(&mut self) -> anyhow::Result<()> {
        for i in 0..self.children.len() {
            let (stage, child) = &mut self.children[i];
            if let Some(status) = child.try_wait()? {
                let stage = *stage;
                let log = std::fs::read_to_string(self.log(stage)).unwrap_or_default();
                bail!("stage `{stage}` has ended ({status}): {}", log.lines().last().unwrap_or("its log is empty"));
            }
        }
        Ok(())
    }

    /// Returns the processor time of each stage, seconds.
    fn cpu_seconds(&self) -> Vec<f64> {
        self.children.iter().map(|(_, child)| cpu_seconds(child.id())).collect()
    }
}

impl Drop for Stages {
    fn drop(&mut self) {
        // Senders end before their receivers.
        for (_, child) in self.children.iter().rev() {
            ask_to_end(child);
        }
        let deadline = Instant::now() + PATIENCE;
        for (_, child) in self.children.iter_mut().rev() {
            end_by(child, deadline);
        }
    }
}

fn resident_bytes(pid: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let kb = status.lines().find_map(|l| l.strip_prefix("VmRSS:")?.split_whitespace().next()?.parse::<f64>().ok());
    kb.map_or(f64::NAN, |kb| kb * 1024.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The time between stages includes every gap on a frame's way, in both steps. A frame with a missing message has
    /// no gaps.
    #[test]
    fn gaps_add_up() {
        let mut frame = Frame {
            captured_ns: 0,
            published_ns: 10,
            encoded_ns: Some((12, 50)),
            compared_ns: None,
            forecast_ns: [(1, (53, 60)), (2, (85, 90))].into(),
            probed_ns: [(1, (64, 80)), (2, (96, 100))].into(),
            decided_ns: Some(107),
        };
        let names = ["encoder to forecaster", "forecaster to prober", "prober to forecaster", "forecaster to prober"];
        let mut wanted = vec![("camera to encoder", 2)];
        wanted.extend(names.into_iter().zip(3..7));
        wanted.push(("prober to controller", 7));
        assert_eq!(frame.gaps_ns(), Some(wanted));
        // A wait for the comparison is not a gap; a comparison after the belief changes nothing.
        for (compared_ns, gap_ns) in [(62, 2), (110, 4)] {
            frame.compared_ns = Some(compared_ns);
            let gaps = frame.gaps_ns().unwrap();
            assert!(gaps.contains(&("forecaster to prober", gap_ns)), "{gaps:?}");
        }
        frame.probed_ns.remove(&1);
        assert_eq!(frame.gaps_ns(), None);
        assert_eq!(Frame::default().gaps_ns(), None);
    }

    /// A rate is held if no frame was missed and the camera was not late.
    #[test]
    fn a_held_rate_misses_nothing() {
        let measured = |missed, rate_hz| Measured {
            latency_ms: Vec::new(),
            ipc_share: 0.0,
            hand_overs_ms: BTreeMap::new(),
            frames: 100,
            missed,
            rate_hz,
            views: 0,
            uses: Vec::new(),
            probe_cores: 0.0,
            probed: 0,
        };
        assert!(measured(0, 19.9).held(20.0));
        assert!(!measured(1, 20.0).held(20.0));
        assert!(!measured(0, 19.0).held(20.0));
    }
}
