//! The supervision of a running graph: starting its stages, watching their health, restarting them, and ending them.
//!
//! | module | content |
//! |---|---|
//! | `process` | the process of a stage, and its log |
//! | [`external`] | the camera of another process |
//! | [`health`] | the state of a stage, from its heartbeats and its topic: a state machine without a clock |
//! | [`restart`] | the restarts that a policy allows |
//! | [`monitor`] | the records of frames and stages that a report is made of |
//! | `service_manager` | notifications for systemd |

pub mod external;
pub mod health;
pub mod monitor;
mod process;
pub mod restart;
mod service_manager;

use crate::NS_PER_MS;
use anyhow::{Context, anyhow, bail, ensure};
use carff::spans::KeptSpans;
use carff::terminal::Terminal;
use carff_config::{CameraSource, GraphConfig, WhenLost};
use carff_messages::{HealthState, Stage};
use carff_observe::RunRecord;
use carff_runtime::StageArgs;
use carff_transport::{Node, Run, Stop, Waiter, Woken, monotonic_now_ns, topics};
use external::ForeignCamera;
use health::{Ailment, HealthLimits, StageHealth};
use monitor::{FrameHistory, Monitor, Records};
use process::StageProcess;
use restart::{RestartBudget, Verdict};
use service_manager::Watchdog;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::ExitStatus;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Polling interval of messages and children: short enough that the smallest buffer (8 images) holds 400 images a
/// second.
const WATCH_NS: u64 = 20_000_000;
/// Interval of the search for leftovers of dead processes: the launcher does not start the probes.
const CLEANUP_NS: u64 = 1_000_000_000;
/// Interval in which the run's files are made young again.
const REFRESH_NS: u64 = 3_600_000_000_000;
/// A longer pause of the launcher itself counts for no stage.
const OWN_PAUSE_NS: u64 = 300_000_000;
/// Multiple of its deadline after which a stage's loop counts as hanging.
const STANDSTILL_DEADLINES: u64 = 10;
/// Number of frame periods that a stage's topic may be quiet.
const QUIET_FRAMES: f64 = 3.0;
/// Source of the launcher's own log lines.
pub(crate) const LAUNCHER: &str = "launcher";
/// A replacement of the camera.
pub(crate) struct Feed {
    /// Stages that are not started, including the camera: the feed sends their messages.
    pub(crate) without: BTreeSet<Stage>,
    /// True if the feed shows its own progress, so that no decisions are printed.
    pub(crate) is_quiet: bool,
    /// Function that runs on its own thread once all stages are ready; the run ends when it returns.
    pub(crate) run: FeedRun,
}

/// Function of a feed: runs until it is done or stopped.
pub(crate) type FeedRun = Box<dyn FnOnce(&Run, &Stop) -> anyhow::Result<()> + Send>;

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

/// Starts the stages of a graph, watches them, restarts those that die or hang, and ends them.
pub(crate) struct Supervisor<'a> {
    monitor: Monitor,
    waiter: Waiter,
    node: &'a Node,
    graph: &'a GraphConfig,
    stages: Vec<Watched>,
    stage_args: StageArgs,
    folder: PathBuf,
    decided: &'a mut dyn FnMut(&FrameHistory),
    terminal: Arc<Terminal>,
    watchdog: Watchdog,
    /// Thread of the feed, once it has started.
    feed: Option<JoinHandle<anyhow::Result<()>>>,
    /// The camera, if another process has it.
    foreign: Option<ForeignCamera>,
    /// Time of the last check of the stages.
    watched_ns: u64,
    /// Time of the next search for leftovers.
    cleanup_ns: u64,
    /// Time of the next refresh of the run's files.
    refresh_ns: u64,
    /// True after the loss of the run's folder was reported.
    files_are_lost: bool,
    /// The lost stage without which the run continues at a halt, and the cause.
    lost: Option<String>,
}

impl<'a> Supervisor<'a> {
    /// Prepares the supervision of a run; no stage starts yet. `decided` is called for each frame with a decision.
    pub(crate) fn new(
        node: &'a Node,
        graph: &'a GraphConfig,
        stages: (PathBuf, StageArgs),
        stop: &Stop,
        terminal: &Arc<Terminal>,
        decided: &'a mut dyn FnMut(&FrameHistory),
    ) -> anyhow::Result<Self> {
        let (folder, stage_args) = stages;
        let run = node.run();
        let spans = KeptSpans::create(run.dir(), run.name()).context("cannot write the run's times")?;
        Ok(Self {
            monitor: Monitor::open(node, graph, spans)?,
            waiter: Waiter::new(stop.clone()),
            node,
            graph,
            stages: Vec::new(),
            stage_args,
            folder,
            decided,
            terminal: terminal.clone(),
            watchdog: Watchdog::from_environment(),
            feed: None,
            foreign: None,
            watched_ns: monotonic_now_ns(),
            cleanup_ns: monotonic_now_ns(),
            refresh_ns: monotonic_now_ns() + REFRESH_NS,
            files_are_lost: false,
            lost: None,
        })
    }

    /// Number of restarts of each stage.
    pub(crate) fn restarts(&self) -> Vec<(Stage, u32)> {
        self.stages.iter().map(|watched| (watched.stage, watched.budget.restarts())).collect()
    }

    /// Takes the records of the run's frames and stages.
    pub(crate) fn take_records(&mut self) -> Records {
        std::mem::take(&mut self.monitor.records)
    }

    /// Starts everything and watches it to its end.
    pub(crate) fn drive(&mut self, run: &Run, stop: &Stop, feed: Option<Feed>) -> anyhow::Result<Ended> {
        let (camera, listeners) = Stage::START_ORDER.split_last().context("there are stages")?;
        let wanted = |stage: &Stage| feed.as_ref().is_none_or(|feed| !feed.without.contains(stage));
        let listeners: Vec<Stage> = listeners.iter().copied().filter(wanted).collect();
        for &stage in &listeners {
            self.start(stage)?;
        }
        if self.until_ready(&listeners)? == Ended::Interrupted {
            return Ok(Ended::Interrupted);
        }
        match feed {
            None if self.graph.camera.source == CameraSource::External => self.expect_camera()?,
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
            if self.watch()? || self.is_fed()? || self.watch_camera()? {
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
                feed.join().map_err(|_| {
                    anyhow!("the thread that sends the recording has failed: report it, with the lines above")
                })??;
                Ok(true)
            }
        }
    }

    /// Waits for the camera of another process, and reports how it joins.
    fn expect_camera(&mut self) -> anyhow::Result<()> {
        let camera = ForeignCamera::expect(self.node, self.graph, self.limits(Stage::Camera).quiet_ns)?;
        self.terminal.log(LAUNCHER, &ForeignCamera::invitation(self.node.run()));
        self.foreign = Some(camera);
        Ok(())
    }

    /// Watches the camera of another process. Returns true when the run has all the frames that it was to have.
    fn watch_camera(&mut self) -> anyhow::Result<bool> {
        let Some(camera) = &mut self.foreign else { return Ok(false) };
        if let Some(line) = camera.watch(self.node, &self.monitor.records)? {
            self.terminal.log(LAUNCHER, &line);
        }
        Ok(camera.is_complete(self.stage_args.frames))
    }

    fn start(&mut self, stage: Stage) -> anyhow::Result<()> {
        // A restarted camera continues after its last frame.
        let first_frame = if stage == Stage::Camera { self.monitor.records.frame_count() } else { 0 };
        let args = StageArgs { first_frame, ..self.stage_args.clone() };
        let program = match stage {
            Stage::Camera => self.graph.camera.source.program().unwrap_or_default().to_owned(),
            other => self.graph.stages.program(other),
        };
        let process = StageProcess::start(stage, &self.folder.join(program), &args, &self.terminal)?;
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

    fn limits(&self, stage: Stage) -> HealthLimits {
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
        HealthLimits {
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
        Ok(self.monitor.drain(&mut *self.decided)?)
    }

    /// Checks the stages: kills those that hang, restarts those that died, by policy. Returns true when the camera is
    /// done.
    fn watch(&mut self) -> anyhow::Result<bool> {
        let now_ns = monotonic_now_ns();
        let pause_ns = now_ns.saturating_sub(std::mem::replace(&mut self.watched_ns, now_ns));
        if pause_ns > OWN_PAUSE_NS {
            self.stages.iter_mut().for_each(|w| w.health.forgive(pause_ns));
            self.foreign.iter_mut().for_each(|camera| camera.forgive(pause_ns));
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
            self.guard_folder(now_ns);
        }
        Ok(false)
    }

    /// Keeps cleaners of temporary files from the run's folder, and reports its loss once.
    fn guard_folder(&mut self, now_ns: u64) {
        let run = self.node.run();
        if now_ns >= self.refresh_ns {
            self.refresh_ns = now_ns + REFRESH_NS;
            run.refresh();
        }
        let is_lost = has_lost_files(run);
        if is_lost && !self.files_are_lost {
            self.terminal.log(LAUNCHER, &format!("ERROR {}", lost_files(run)));
        }
        self.files_are_lost = is_lost;
    }

    /// Handles the end of a stage: a restart by its policy, a run without it, or an error.
    fn judge(&mut self, index: usize, cause: &str, now_ns: u64) -> anyhow::Result<()> {
        // The dead process has been reaped: its ports can be freed for its successor.
        self.node.cleanup_dead();
        let watched = &mut self.stages[index];
        let stage = watched.stage;
        ensure!(watched.health.was_ready(), "stage `{stage}` did not start: {cause}");
        ensure!(!has_lost_files(self.node.run()), "stage `{stage}` is lost: {cause}; {}", lost_files(self.node.run()));
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
        let foreign = self.foreign.iter().map(|camera| (Stage::Camera, camera.state()));
        let other = self.stages.iter().map(|w| (w.stage, w.health.state(now_ns))).chain(foreign);
        let other: Vec<_> =
            other.filter(|(_, state)| *state != HealthState::Ok).map(|(s, state)| format!("{s} {state}")).collect();
        let latest = records.frames.values().rev().find_map(|f| Some((f.action?, f.hazard_probability)));
        self.terminal.status(format!(
            "frame {}{} | skipped {}, restarts {restarts} | {}",
            records.frame_count(),
            latest.map_or(String::new(), |(action, hazard)| format!("  hazard {hazard:.2} {}", action.name())),
            records.skipped(),
            if other.is_empty() { "all stages ok".to_owned() } else { other.join(", ") }
        ));
    }

    /// Ends the stages, the camera first, each within the time limit; kills those that do not end.
    pub(crate) fn shut_down(&mut self) {
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

/// Returns true if another process cannot find this run: its record, its folder or files in it are gone.
fn has_lost_files(run: &Run) -> bool {
    !RunRecord::path(run.dir(), run.name()).exists() || run.has_lost(std::process::id())
}

fn lost_files(run: &Run) -> String {
    format!(
        "files of the run are gone ({0} and {0}.run), so that probes see nothing and no stage can restart: keep cleaners \
         of temporary files from them (systemd: a line `x {1}` in /etc/tmpfiles.d/carff.conf), and start the run again",
        run.folder().display(),
        run.dir().display()
    )
}

fn how(status: ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt;
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("exit code {code}"),
        (None, Some(signal)) => format!("killed by signal {signal}"),
        (None, None) => "unknown end".to_owned(),
    }
}
