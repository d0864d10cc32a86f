//! `carff launch`: starts a graph, watches it, prints its decisions, ends it, and writes a report.

use crate::health::{Ailment, Limits, StageHealth};
use crate::monitor::{FrameRecord, Monitor};
use crate::planning::{self, Planning};
use crate::process::StageProcess;
use crate::report::{self, RunOutcome};
use crate::service_manager::{self, Watchdog};
use crate::supervise::{RestartBudget, Verdict};
use anyhow::{Context, anyhow, bail, ensure};
use carff::terminal::Terminal;
use carff_checkpoint::{Manifest, ScenarioIdentity};
use carff_config::{CameraSource, GraphConfig, WhenLost};
use carff_dataset::Dataset;
use carff_messages::{ActionCode, Observability, Stage};
use carff_observe::{RunLock, RunRecord};
use carff_runtime::StageArgs;
use carff_scenes::{Extras, Scenario};
use carff_transport::{
    Node, Run, Stop, Waiter, Woken, check_space, monotonic_now_ns, remove_run_leftovers, run_id_of, runtime_dir, topics,
};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{ExitCode, ExitStatus};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

/// Start order of the stages: subscribers before publishers, the camera last.
const START_ORDER: [Stage; 6] =
    [Stage::Controller, Stage::Renderer, Stage::Prober, Stage::Forecaster, Stage::Encoder, Stage::Camera];
/// Polling interval of messages and children: short enough that the smallest buffer (8 images) holds 400 images a
/// second.
const WATCH_NS: u64 = 20_000_000;
/// Interval of the search for leftovers of dead processes: the launcher does not start the probes.
const CLEANUP_NS: u64 = 1_000_000_000;
/// A longer pause of the launcher itself counts for no stage.
const OWN_PAUSE_NS: u64 = 300_000_000;
/// Multiple of its deadline after which a stage's loop counts as hanging.
const STANDSTILL_DEADLINES: u64 = 10;
/// Number of frame periods that a stage's topic may be quiet.
const QUIET_FRAMES: f64 = 3.0;
/// Exit code after Ctrl-C, as in shells: 128 plus the signal's number.
pub(crate) const INTERRUPTED: u8 = 130;
/// Source of the launcher's own log lines.
pub(crate) const LAUNCHER: &str = "launcher";
/// Assumed bytes of a frame in the check of shared memory, before the image size is known.
pub(crate) const FRAME_BYTES: usize = 1 << 17;

/// Start a graph.
#[derive(Clone, Debug, clap::Args)]
pub struct LaunchArgs {
    /// The graph file, as in configs/graphs.
    pub graph: PathBuf,
    /// Dataset folder; replaces the graph file's.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Checkpoint folder; replaces the graph file's.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Stop after this many frames.
    #[arg(long)]
    pub frames: Option<u64>,
    /// Number of drives; replaces the graph file's.
    #[arg(long)]
    pub drives: Option<u32>,
    /// Write the report here, as JSON.
    #[arg(long)]
    pub report: Option<PathBuf>,
    /// Run name; replaces the graph file's. Two concurrent runs need two names.
    #[arg(long)]
    pub run: Option<String>,
    /// Folder of the stages' programs; default: this program's folder.
    #[arg(long, hide = true)]
    pub stages: Option<PathBuf>,
}

/// A replacement of the camera.
pub(crate) struct Feed {
    /// Stages that are not started, including the camera: the feed sends their messages.
    pub(crate) without: BTreeSet<Stage>,
    /// Function that runs on its own thread once all stages are ready; the run ends when it returns.
    pub(crate) run: FeedRun,
}

/// Function of a feed: runs until it is done or stopped.
pub(crate) type FeedRun = Box<dyn FnOnce(&Run, &Stop) -> anyhow::Result<()> + Send>;

/// Launches a graph. Ends when the camera is done (exit code 0), on Ctrl-C (130), or with an error when a stage is
/// lost.
pub fn run(args: &LaunchArgs) -> anyhow::Result<ExitCode> {
    let terminal = Arc::new(Terminal::new());
    let (ended, outcome) = run_graph(args, None, &terminal)?;
    if ended == Ended::Interrupted {
        terminal.log(LAUNCHER, "INFO interrupted: all stages have ended");
        return Ok(ExitCode::from(INTERRUPTED));
    }
    report(args, &Arc::new(outcome), &terminal)
}

/// Prints and writes the report of a finished run.
fn report(args: &LaunchArgs, outcome: &Arc<RunOutcome>, terminal: &Terminal) -> anyhow::Result<ExitCode> {
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let planning = evaluate(outcome, &stop, terminal)?;
    if stop.is_stopped() {
        return Ok(ExitCode::from(INTERRUPTED));
    }
    let tables = planning.as_ref().map(Planning::tables).transpose()?.unwrap_or_default();
    let report = report::json(outcome, tables);
    let text = format!("{}\n{}", summary(&report), planning.as_ref().map_or("", Planning::text));
    terminal.line(&text);
    if let Some(path) = &args.report {
        write(path, &(serde_json::to_string_pretty(&report)? + "\n"))?;
        let page = path.with_extension("txt");
        write(&page, &text)?;
        terminal.line(&format!("report: {}\nJSON: {}", page.display(), path.display()));
        if let Some(planning) = &planning {
            let strip = path.with_extension("png");
            planning.write_filmstrip(&strip)?;
            terminal.line(&format!("filmstrip: {}", strip.display()));
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Starts a graph, and watches it to its end.
pub(crate) fn run_graph(
    args: &LaunchArgs,
    feed: Option<Feed>,
    terminal: &Arc<Terminal>,
) -> anyhow::Result<(Ended, RunOutcome)> {
    let graph = GraphConfig::load(&args.graph)?;
    terminal.set_log_format(graph.launcher.log_format);
    for warning in graph.warnings() {
        terminal.log(LAUNCHER, &format!("WARN {}: {warning}", args.graph.display()));
    }
    let name = args.run.clone().unwrap_or_else(|| graph.run.name.clone());
    let run = Run::new(&name, run_id_of(&name, monotonic_now_ns()))?;
    let dataset = graph.resolve(args.dataset.as_ref().unwrap_or(&graph.run.dataset));
    let checkpoint = graph.resolve(args.checkpoint.as_ref().unwrap_or(&graph.run.checkpoint));
    let absolute = |path: &Path| std::path::absolute(path).map(|p| p.display().to_string());
    let record = RunRecord {
        pid: std::process::id(),
        run_id: run.id(),
        graph: absolute(&args.graph)?,
        dataset: absolute(&dataset)?,
        checkpoint: absolute(&checkpoint)?,
        started_unix_s: SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs(),
    };
    let lock = RunLock::take(&runtime_dir(), &name, &record, "--run")?;
    lock.sweep(&run, "--run")?;

    // A feed brings its own images.
    if feed.is_none() {
        provide_dataset(&graph, args, &dataset, terminal)?;
        refuse_another_scenario(&graph, &dataset, &checkpoint)?;
    }
    // From here on Ctrl-C ends the run in order. Before, no stage runs, and the process may simply end.
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let view_bytes = carff_messages::rgb_bytes(graph.renderer.width_px, graph.renderer.height_px);
    check_space(Path::new("/dev/shm"), "the graph", topics::graph_bytes(FRAME_BYTES, view_bytes))?;

    let mut stage_args = StageArgs::new(&args.graph, &name, run.id());
    stage_args.dataset = Some(dataset.clone());
    stage_args.checkpoint = Some(checkpoint.clone());
    (stage_args.drives, stage_args.frames) = (args.drives, args.frames);
    stage_args.parent_pid = Some(std::process::id());
    let folder = match &args.stages {
        Some(folder) => folder.clone(),
        None => std::env::current_exe()?.parent().context("this program has no folder")?.to_owned(),
    };

    let result = {
        let node = Node::open(&run, "launcher")?;
        let mut launcher = Launcher {
            monitor: Monitor::open(&node, &graph)?,
            waiter: Waiter::new(stop.clone()),
            node: &node,
            graph: &graph,
            stages: Vec::new(),
            stage_args,
            folder,
            drives: args.drives.unwrap_or(graph.camera.drives),
            terminal: terminal.clone(),
            watchdog: Watchdog::from_environment(),
            feed: None,
            watched_ns: monotonic_now_ns(),
            cleanup_ns: monotonic_now_ns(),
            lost: None,
        };
        let result = launcher.drive(&run, &stop, feed);
        terminal.status(String::new());
        launcher.shut_down();
        result.map(|ended| {
            let outcome = RunOutcome {
                run: name,
                graph: args.graph.display().to_string(),
                seed: graph.run.seed,
                dataset,
                checkpoint,
                restarts: launcher.stages.iter().map(|s| (s.stage, s.budget.restarts())).collect(),
                records: std::mem::take(&mut launcher.monitor.records),
                invalid: node.counters().invalid(),
            };
            (ended, outcome)
        })
    };
    // All stages are dead and reaped, and the lock is held: remaining files belong to no process.
    remove_run_leftovers(&run)?;
    result
}

/// Computes the planning tables on a separate thread, so that Ctrl-C still ends the program. Returns none after Ctrl-C,
/// and for a run without drives.
fn evaluate(outcome: &Arc<RunOutcome>, stop: &Stop, terminal: &Terminal) -> anyhow::Result<Option<Planning>> {
    let theirs = Arc::clone(outcome);
    let work = std::thread::spawn(move || planning::evaluate(&theirs));
    let started_ns = monotonic_now_ns();
    while !work.is_finished() {
        if stop.is_stopped() {
            return Ok(None);
        }
        let seconds = (monotonic_now_ns() - started_ns) / 1_000_000_000;
        terminal.status(format!("planning table over every eligible view: {seconds} s"));
        std::thread::sleep(Duration::from_millis(50));
    }
    terminal.status(String::new());
    work.join().map_err(|_| anyhow!("the computation of the planning table failed"))?
}

/// End of a run that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ended {
    /// The camera or its feed has sent everything.
    Done,
    /// A user interrupted the run.
    Interrupted,
}

/// A stage with its process and health.
#[derive(Debug)]
struct Watched {
    stage: Stage,
    process: Option<StageProcess>,
    budget: RestartBudget,
    health: StageHealth,
    restart_at_ns: Option<u64>,
}

struct Launcher<'a> {
    monitor: Monitor,
    waiter: Waiter,
    node: &'a Node,
    graph: &'a GraphConfig,
    stages: Vec<Watched>,
    stage_args: StageArgs,
    folder: PathBuf,
    drives: u32,
    terminal: Arc<Terminal>,
    watchdog: Watchdog,
    /// Thread of the feed, once it has started.
    feed: Option<JoinHandle<anyhow::Result<()>>>,
    /// Time of the last check of the stages.
    watched_ns: u64,
    /// Time of the next search for leftovers.
    cleanup_ns: u64,
    /// The lost stage without which the run continues at a halt, and the cause.
    lost: Option<String>,
}

impl Launcher<'_> {
    /// Starts everything and watches it to its end.
    fn drive(&mut self, run: &Run, stop: &Stop, feed: Option<Feed>) -> anyhow::Result<Ended> {
        let (camera, listeners) = START_ORDER.split_last().context("there are stages")?;
        let wanted = |stage: &Stage| feed.as_ref().is_none_or(|feed| !feed.without.contains(stage));
        let listeners: Vec<Stage> = listeners.iter().copied().filter(wanted).collect();
        for &stage in &listeners {
            self.start(stage)?;
        }
        if self.until_ready(&listeners)? == Ended::Interrupted {
            return Ok(Ended::Interrupted);
        }
        match feed {
            None => self.start(*camera)?,
            Some(feed) => {
                let (run, stop) = (run.clone(), stop.clone());
                let thread = std::thread::Builder::new().name("feed".into());
                self.feed = Some(thread.spawn(move || (feed.run)(&run, &stop)).context("cannot start the feed")?);
            }
        }
        let mut is_ready = false;
        loop {
            if self.step()? == Woken::Stopped {
                return match self.lost.take() {
                    Some(lost) => Err(anyhow!(lost)),
                    None => Ok(Ended::Interrupted),
                };
            }
            if self.watch()? || self.is_fed()? {
                self.collect()?;
                return Ok(Ended::Done);
            }
            if !is_ready && self.stages.iter().all(|w| w.health.was_ready()) {
                is_ready = true;
                service_manager::ready();
            }
            self.show_status();
        }
    }

    /// Returns true if the feed has ended.
    fn is_fed(&mut self) -> anyhow::Result<bool> {
        match self.feed.take_if(|feed| feed.is_finished()) {
            None => Ok(false),
            Some(feed) => {
                feed.join().map_err(|_| anyhow!("the feed failed"))??;
                Ok(true)
            }
        }
    }

    fn start(&mut self, stage: Stage) -> anyhow::Result<()> {
        // A restarted camera continues after its last frame.
        let first_frame = if stage == Stage::Camera { self.monitor.records.frame_count() } else { 0 };
        let args = StageArgs { first_frame, ..self.stage_args.clone() };
        let process = StageProcess::start(stage, &self.folder, &args, &self.terminal)?;
        let (pid, now_ns) = (process.pid(), monotonic_now_ns());
        match self.stages.iter_mut().find(|w| w.stage == stage) {
            Some(watched) => {
                (watched.process, watched.restart_at_ns) = (Some(process), None);
                watched.health.restarted(pid, now_ns);
            }
            None => self.stages.push(Watched {
                stage,
                process: Some(process),
                budget: RestartBudget::new(self.graph.stage(stage).restart),
                health: StageHealth::started(self.limits(stage), pid, now_ns),
                restart_at_ns: None,
            }),
        }
        Ok(())
    }

    fn limits(&self, stage: Stage) -> Limits {
        const NS_PER_MS: u64 = 1_000_000;
        let (graph, launcher) = (self.graph, &self.graph.launcher);
        let hang_ns = launcher.hang_timeout_ms * NS_PER_MS;
        let frame_ns = 1e9 / graph.run.frame_rate_hz;
        let deadline_ns = graph.stage_deadline_ms(stage) * NS_PER_MS;
        let topic = match stage {
            Stage::Camera => topics::FRAME.deadline,
            Stage::Encoder => topics::POSTERIOR.deadline,
            Stage::Forecaster => topics::FORECAST.deadline,
            Stage::Prober => topics::BELIEF.deadline,
            Stage::Renderer => topics::VIEW.deadline,
            Stage::Controller => topics::ACTION.deadline,
        };
        // The controller has its own rate.
        let frames_ns = if stage == Stage::Controller { 0.0 } else { QUIET_FRAMES * frame_ns };
        Limits {
            start_ns: launcher.start_timeout_ms * NS_PER_MS,
            silence_ns: topics::health(stage).deadline.as_nanos() as u64,
            hang_ns,
            standstill_ns: hang_ns.max(STANDSTILL_DEADLINES * deadline_ns),
            quiet_ns: (topic.as_nanos() as u64).max(frames_ns as u64),
        }
    }

    fn until_ready(&mut self, stages: &[Stage]) -> anyhow::Result<Ended> {
        loop {
            if self.step()? == Woken::Stopped {
                return Ok(Ended::Interrupted);
            }
            self.watch()?;
            let waiting: Vec<&str> = self
                .stages
                .iter()
                .filter(|w| stages.contains(&w.stage) && !w.health.was_ready())
                .map(|w| w.stage.name())
                .collect();
            if waiting.is_empty() {
                return Ok(Ended::Done);
            }
            self.terminal.status(format!("starting: {}", waiting.join(", ")));
        }
    }

    /// Sleeps until the next check, and reads all messages.
    fn step(&mut self) -> anyhow::Result<Woken> {
        let woken = self.waiter.wait_until(&[], monotonic_now_ns() + WATCH_NS)?;
        self.collect()?;
        self.watchdog.alive();
        Ok(woken)
    }

    fn collect(&mut self) -> anyhow::Result<()> {
        let (terminal, graph, drives) = (&self.terminal, self.graph, self.drives);
        Ok(self.monitor.drain(|frame| terminal.line(&decision_line(frame, graph, drives, terminal)))?)
    }

    /// Checks the stages: kills those that hang, restarts those that died, by policy. Returns true when the camera is
    /// done.
    fn watch(&mut self) -> anyhow::Result<bool> {
        let now_ns = monotonic_now_ns();
        let pause_ns = now_ns.saturating_sub(std::mem::replace(&mut self.watched_ns, now_ns));
        if pause_ns > OWN_PAUSE_NS {
            self.stages.iter_mut().for_each(|w| w.health.forgive(pause_ns));
        }
        let mut ended = BTreeMap::new();
        for watched in &mut self.stages {
            if let Some(status) = watched.process.as_mut().map(StageProcess::ended).transpose()?.flatten() {
                ended.insert(watched.stage, status);
            }
        }
        // The last messages of a dead process are read before it is judged.
        if !ended.is_empty() {
            self.collect()?;
        }
        for watched in &mut self.stages {
            let records = &self.monitor.records;
            if let Some(health) = records.stages.get(&watched.stage).and_then(|s| s.last) {
                watched.health.heard(&health, now_ns);
            }
            if let Some(&at_ns) = records.spoke_ns.get(&watched.stage) {
                watched.health.spoke(at_ns);
            }
        }
        for i in 0..self.stages.len() {
            let watched = &mut self.stages[i];
            let stage = watched.stage;
            if let Some(status) = ended.get(&stage) {
                if stage == Stage::Camera && status.success() {
                    watched.health.done();
                    return Ok(true);
                }
                let cause = watched.process.take().and_then(|p| p.last_error()).unwrap_or_else(|| how(*status));
                self.judge(i, &cause, now_ns)?;
            } else if let Some(ailment) = watched.health.ailment(now_ns) {
                if let Some(mut process) = watched.process.take() {
                    process.kill();
                }
                let advice = match ailment {
                    Ailment::NotReady { .. } => ": see its log, or raise `launcher.start_timeout_ms`",
                    _ => "",
                };
                self.judge(i, &format!("{ailment}{advice}"), now_ns)?;
            } else if watched.restart_at_ns.is_some_and(|at_ns| now_ns >= at_ns)
                && let Err(error) = self.start(stage)
            {
                self.judge(i, &carff_base::errors::sentence(&*error), now_ns)?;
            }
        }
        if now_ns >= self.cleanup_ns {
            self.cleanup_ns = now_ns + CLEANUP_NS;
            self.node.cleanup_dead();
        }
        Ok(false)
    }

    /// Handles the end of a stage: a restart by its policy, a run without it, or an error.
    fn judge(&mut self, index: usize, cause: &str, now_ns: u64) -> anyhow::Result<()> {
        // The dead process has been reaped: its ports can be freed for its successor.
        self.node.cleanup_dead();
        let watched = &mut self.stages[index];
        let stage = watched.stage;
        ensure!(watched.health.was_ready(), "stage `{stage}` did not start: {cause}");
        if let Verdict::RestartAt(at_ns) = watched.budget.died(now_ns) {
            watched.restart_at_ns = Some(at_ns);
            watched.health.died();
            self.terminal.log(
                LAUNCHER,
                &format!(
                    "WARN stage {stage} died ({cause}): restart {} in {} ms",
                    watched.budget.restarts(),
                    (at_ns - now_ns) / 1_000_000
                ),
            );
            return Ok(());
        }
        watched.restart_at_ns = None;
        watched.health.lost();
        let lost = match watched.budget.restarts() {
            0 => format!("stage `{stage}` is lost: {cause}"),
            n => format!("stage `{stage}` is lost after {n} restarts: {cause}"),
        };
        match (stage, self.graph.launcher.when_lost) {
            // No decision depends on the renderer.
            (Stage::Renderer, _) => self.terminal.log(LAUNCHER, &format!("ERROR {lost}: continuing without views")),
            (Stage::Controller, _) | (_, WhenLost::End) => bail!(lost),
            (_, WhenLost::Halt) => {
                self.terminal.log(LAUNCHER, &format!("ERROR {lost}: the safe action applies until the run is stopped"));
                self.lost = Some(lost);
            }
        }
        Ok(())
    }

    fn show_status(&self) {
        let (records, now_ns) = (&self.monitor.records, monotonic_now_ns());
        let restarts: u32 = self.stages.iter().map(|s| s.budget.restarts()).sum();
        let stages: Vec<String> =
            self.stages.iter().map(|w| format!("{} {}", w.stage, w.health.state(now_ns))).collect();
        self.terminal.status(format!(
            "frames {} skipped {} restarts {restarts} | {}",
            records.frame_count(),
            records.skipped(),
            stages.join(", ")
        ));
    }

    /// Ends the stages, the camera first, each within the time limit; kills those that do not end.
    fn shut_down(&mut self) {
        service_manager::stopping();
        // The same stop ends the feed; the feed leaves the run before the stages do.
        if let Some(feed) = self.feed.take() {
            self.waiter.stop().stop();
            if let Ok(Err(error)) = feed.join() {
                self.terminal.log(LAUNCHER, &format!("ERROR {}", carff_base::errors::sentence(&*error)));
            }
        }
        let limit = Duration::from_millis(self.graph.launcher.stop_timeout_ms);
        let deadline_ns = monotonic_now_ns() + limit.as_nanos() as u64;
        // In the order of the data flow: publishers before subscribers.
        self.stages.reverse();
        for process in self.stages.iter().filter_map(|w| w.process.as_ref()) {
            process.terminate();
        }
        for watched in &mut self.stages {
            let Some(mut process) = watched.process.take() else { continue };
            while matches!(process.ended(), Ok(None)) {
                if monotonic_now_ns() >= deadline_ns {
                    self.terminal.log(LAUNCHER, &format!("WARN stage {} did not end in time: killed", watched.stage));
                    process.kill();
                    break;
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        // Their last heartbeats contain the final counts. A failure here has no consequences.
        if let Err(error) = self.collect() {
            self.terminal.log(LAUNCHER, &format!("ERROR {}", carff_base::errors::sentence(&*error)));
        }
    }
}

/// Renders the dataset if it is missing and the graph names its scenario.
fn provide_dataset(graph: &GraphConfig, args: &LaunchArgs, dataset: &Path, terminal: &Terminal) -> anyhow::Result<()> {
    let complete = std::fs::read_dir(dataset)
        .is_ok_and(|entries| entries.flatten().any(|e| e.file_name().to_string_lossy().starts_with("transforms")));
    if complete || graph.camera.source == CameraSource::Folder {
        return Ok(());
    }
    ensure!(
        args.dataset.is_none() || !dataset.exists(),
        "{} contains no dataset (no transforms.json)",
        dataset.display()
    );
    match graph.scenario_path() {
        Some(scenario) if args.dataset.is_none() => {
            let (missing, from) = (dataset.display(), scenario.display());
            terminal.log(LAUNCHER, &format!("INFO {missing} is missing: rendering it from {from}"));
            crate::dataset::render(&Scenario::load(&scenario)?, dataset, Extras::None).map(drop)
        }
        _ => bail!(
            "dataset {} is missing: pass --dataset, or name its scenario in the graph file (`run.scenario`){}",
            dataset.display(),
            carff_base::names::beside(dataset)
        ),
    }
}

/// Refuses a checkpoint of another scenario, whose decisions would be confident and wrong. The stage that needs a
/// missing checkpoint reports it.
fn refuse_another_scenario(graph: &GraphConfig, dataset: &Path, checkpoint: &Path) -> anyhow::Result<()> {
    if graph.camera.source == CameraSource::Folder || !checkpoint.join(carff_checkpoint::files::MANIFEST).exists() {
        return Ok(());
    }
    let manifest = Manifest::load(checkpoint)?;
    let dataset = Dataset::open(dataset)?;
    match dataset.scenario() {
        Some(scenario) => {
            Ok(manifest.check_scenario(checkpoint, &ScenarioIdentity::of(scenario, dataset.view_count()))?)
        }
        None => Ok(()),
    }
}

fn how(status: ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt;
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("exit code {code}"),
        (None, Some(signal)) => format!("killed by signal {signal}"),
        (None, None) => "unknown end".to_owned(),
    }
}

fn decision_line(frame: &FrameRecord, graph: &GraphConfig, drives: u32, terminal: &Terminal) -> String {
    let action = match frame.action {
        Some(ActionCode::Advance) => terminal.alarm("advance", false),
        _ => terminal.alarm("HALT   ", true),
    };
    let place = if frame.drive >= 0 {
        format!(
            "drive {:>3}/{drives}  t{} frame {:>2}/{}  view {:>3}  {:<8}",
            frame.drive + 1,
            frame.timestamp,
            frame.frame_in_drive % graph.camera.frames_per_timestamp as i32 + 1,
            graph.camera.frames_per_timestamp,
            frame.view,
            frame.observability.map_or("unknown", Observability::name)
        )
    } else {
        format!("frame {:>6}", frame.frame_id)
    };
    format!("{place}  hazard {:.2}  {action}  {:>6.1} ms", frame.hazard_probability, frame.latency_ns as f64 / 1e6)
}

fn summary(report: &Value) -> String {
    let latency = &report["latency_ms"]["camera_to_action"];
    let ms = |key: &str| latency[key].as_f64().map_or("-".to_owned(), |v| format!("{v:.1}"));
    format!(
        "{} frames, {} decisions, {} actions, {} skipped, {} restarts; camera to action: p50 {} ms, p99 {} ms, max {} ms",
        report["frames"],
        report["decisions"],
        report["actions"],
        report["skipped"],
        report["restarts"],
        ms("p50"),
        ms("p99"),
        ms("max")
    )
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    let context = || format!("cannot write {}", path.display());
    if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).with_context(context)?;
    }
    std::fs::write(path, text).with_context(context)
}
