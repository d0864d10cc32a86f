//! A stage's environment: configuration, topics, waiting, and health.

use crate::args::{StageArgs, parse};
use crate::health::{Heartbeat, Vitals};
use crate::realtime;
use anyhow::Context;
use carff_base::errors::sentence;
use carff_config::{GraphConfig, LogFormat, LogLevel};
use carff_messages::{Header, HealthState, ImageMeta, Message, Stage};
use carff_transport::{
    ImagePayload, Input, Node, Payload, Publisher, Receiver, Run, Stop, Topic, Waiter, Woken, monotonic_now_ns,
};
use rustix::process::{Signal, getppid, set_parent_process_death_signal};
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

/// Runs a stage: everything around `run`, which opens topics, calls [`StageContext::ready`] and loops.
pub fn main(stage: Stage, run: impl FnOnce(&mut StageContext) -> anyhow::Result<()>) -> ExitCode {
    parse().map_or_else(|error| failed(&error), |args| run_with(stage, args, run))
}

/// Runs a stage as [`main`] does, with given arguments.
pub fn run_with(stage: Stage, args: StageArgs, run: impl FnOnce(&mut StageContext) -> anyhow::Result<()>) -> ExitCode {
    match start(stage, args).and_then(|mut context| context.finish(run)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failed(&*error),
    }
}

/// Reports an error that ends the stage.
fn failed(error: &(dyn std::error::Error + 'static)) -> ExitCode {
    // Standard error may be closed.
    let _ = writeln!(std::io::stderr(), "ERROR {}", sentence(error));
    ExitCode::FAILURE
}

/// Returns a span for the work on a frame: log lines contain frame and step until it is dropped. It exists at the level
/// `debug`; at higher levels it costs nothing.
#[must_use = "the span ends when it is dropped"]
pub fn frame_span(header: &Header) -> tracing::span::EnteredSpan {
    tracing::debug_span!("frame", frame = header.frame_id, step = header.step).entered()
}

fn start(stage: Stage, args: StageArgs) -> anyhow::Result<StageContext> {
    die_with_parent(args.parent_pid)?;
    let graph = GraphConfig::load(&args.graph)?;
    init_log(graph.stage(stage).log, graph.launcher.log_format);
    StageContext::new(stage, args, graph)
}

/// Environment of a stage.
#[derive(Debug)]
pub struct StageContext {
    /// Configuration of the graph, with the stage's own as one field.
    pub graph: GraphConfig,
    /// Arguments of the stage.
    pub args: StageArgs,
    /// Folder of the dataset.
    pub dataset: PathBuf,
    /// Folder of the trained models.
    pub checkpoint: PathBuf,
    /// Number of threads that it may use.
    pub threads: usize,
    stage: Stage,
    deadline_ns: u64,
    waiter: Waiter,
    vitals: Arc<Vitals>,
    begun: bool,
    /// The latest refusal and its number of repetitions.
    refused: (String, u64),
    /// Reason why the source of a camera delivers nothing.
    stalled: Option<String>,
    // Fields are dropped in this order: the last heartbeat is sent before the node closes.
    heartbeat: Option<Heartbeat>,
    node: Node,
}

impl StageContext {
    /// Joins the run and starts the heartbeat. [`main`] calls this; tests call it in their own process.
    pub fn new(stage: Stage, args: StageArgs, graph: GraphConfig) -> anyhow::Result<Self> {
        // This comes first, so that all threads inherit the settings.
        realtime::schedule(graph.stage(stage));
        let stop = Stop::on_signals().context("cannot handle signals")?;
        let run = Run::new(args.run.as_deref().unwrap_or(&graph.run.name), args.run_id)?;
        let node = Node::open(&run, stage.name())?;
        let vitals = Arc::new(Vitals::new());
        let counters = node.counters().clone();
        let heartbeat = Heartbeat::start(&run, stage, graph.run.seed, vitals.clone(), counters)?;
        // The heartbeat keeps its own priority: a stage that yields to all others must not seem to hang.
        realtime::renice(graph.stage_nice(stage));
        Ok(Self {
            dataset: graph.resolve(args.dataset.as_ref().unwrap_or(&graph.run.dataset)),
            checkpoint: graph.resolve(args.checkpoint.as_ref().unwrap_or(&graph.run.checkpoint)),
            threads: graph.stage(stage).threads as usize,
            stage,
            deadline_ns: graph.stage_deadline_ms(stage) * 1_000_000,
            waiter: Waiter::new(stop),
            vitals,
            begun: false,
            refused: (String::new(), 0),
            stalled: None,
            heartbeat: Some(heartbeat),
            node,
            graph,
            args,
        })
    }

    /// Returns the run's seed.
    pub fn seed(&self) -> u64 {
        self.graph.run.seed
    }

    /// Opens a topic for receiving. Call this before [`StageContext::ready`].
    pub fn input<P: Payload>(&self, topic: &Topic<P>) -> anyhow::Result<Receiver<P>> {
        let receiver = self.node.receiver(topic)?;
        Ok(if self.graph.run.busy_polling { receiver.polled() } else { receiver })
    }

    /// Opens a topic of messages for sending.
    pub fn output<M: Message>(&self, topic: &Topic<M>) -> anyhow::Result<Publisher<M>> {
        Ok(self.node.publisher(topic)?)
    }

    /// Opens a topic of images of at most `max_bytes` each for sending.
    pub fn image_output<M: ImageMeta>(
        &self,
        topic: &Topic<ImagePayload<M>>,
        max_bytes: usize,
    ) -> anyhow::Result<Publisher<ImagePayload<M>>> {
        Ok(self.node.image_publisher(topic, max_bytes)?)
    }

    /// Reports that all topics are open and all models loaded, before any work is done. The launcher waits for it.
    pub fn ready(&mut self) {
        // Memory is reserved before the first message: if shared memory fills up later, no ready stage is affected.
        if let Err(error) = self.node.run().reserve_shared_memory() {
            tracing::warn!(%error, "shared memory cannot be reserved; if it fills up, a stage may be killed");
        }
        realtime::settle(self.graph.stage(self.stage));
        self.vitals.set_state(HealthState::Ok);
        self.vitals.progress();
        if let Some(heartbeat) = &self.heartbeat {
            heartbeat.beat();
        }
        tracing::info!(threads = self.threads, "ready");
    }

    /// Sleeps until an input has a message; returns false if the stage must end. If a started input is quiet for longer
    /// than its topic's deadline, the stage's health becomes stale.
    pub fn wait(&mut self, inputs: &[&dyn Input]) -> anyhow::Result<bool> {
        let patience = inputs.iter().map(|i| i.deadline()).min().unwrap_or(Duration::from_secs(1));
        loop {
            match self.wait_until(inputs, monotonic_now_ns() + patience.as_nanos() as u64)? {
                Woken::Input => return Ok(true),
                Woken::Stopped => return Ok(false),
                Woken::Timeout if self.begun => self.vitals.set_state(HealthState::Stale),
                Woken::Timeout => {}
            }
        }
    }

    /// Sleeps until an input has a message, a time on the monotonic clock (nanoseconds), or a stop.
    pub fn wait_until(&mut self, inputs: &[&dyn Input], deadline_ns: u64) -> anyhow::Result<Woken> {
        self.vitals.set_waiting(true);
        let woken = self.waiter.wait_until(inputs, deadline_ns);
        self.vitals.set_waiting(false);
        Ok(woken?)
    }

    /// Sleeps until a time on the monotonic clock, nanoseconds; false when the stage shall end.
    pub fn pause_until(&mut self, until_ns: u64) -> anyhow::Result<bool> {
        while monotonic_now_ns() < until_ns {
            if self.wait_until(&[], until_ns)? == Woken::Stopped {
                return Ok(false);
            }
        }
        Ok(!self.is_stopped())
    }

    /// Reports whether the stage shall end, for loops that compute for long without waiting.
    pub fn is_stopped(&self) -> bool {
        self.waiter.stop().is_stopped()
    }

    /// Records that the work on a frame, started at `started_ns`, is done. Returns its duration, nanoseconds.
    pub fn worked(&mut self, header: &Header, started_ns: u64) -> u64 {
        let latency_ns = monotonic_now_ns().saturating_sub(started_ns);
        self.begun = true;
        if self.stalled.take().is_some() {
            tracing::info!(frame = header.frame_id, "delivers again");
        }
        self.vitals.worked(header, latency_ns);
        self.vitals.set_state(if latency_ns > self.deadline_ns { HealthState::Slow } else { HealthState::Ok });
        tracing::trace!(frame = header.frame_id, step = header.step, latency_us = latency_ns / 1000, "worked");
        latency_ns
    }

    /// Returns the number of inputs dropped so far because they were invalid.
    pub fn invalid_count(&self) -> u64 {
        self.node.counters().invalid()
    }

    /// Counts and logs an error after which the stage continues.
    pub fn error(&mut self, error: &anyhow::Error) {
        self.vitals.count_error();
        tracing::error!("{}", sentence(&**error));
    }

    /// Counts an input that cannot be used, and reports the stage as faulty until its next output. A repeated reason is
    /// logged less and less often.
    pub fn refuse(&mut self, error: &anyhow::Error) {
        self.vitals.count_error();
        self.vitals.set_state(HealthState::Faulty);
        self.vitals.progress();
        let reason = sentence(&**error);
        let (last, count) = &mut self.refused;
        *count = if *last == reason { *count + 1 } else { 1 };
        if count.is_power_of_two() {
            tracing::error!(count, "{reason}");
        }
        *last = reason;
    }

    /// Reports that the source of the stage's outputs delivers nothing, with the reason, until its next output.
    pub fn stalled(&mut self, reason: &str) {
        self.vitals.set_state(HealthState::Stale);
        self.vitals.progress();
        if self.stalled.as_deref() != Some(reason) {
            tracing::warn!("{reason}");
            self.stalled = Some(reason.to_owned());
        }
    }

    fn finish(&mut self, run: impl FnOnce(&mut Self) -> anyhow::Result<()>) -> anyhow::Result<()> {
        let result = run(self);
        self.vitals.set_state(if result.is_ok() { HealthState::Done } else { HealthState::Faulty });
        drop(self.heartbeat.take());
        tracing::debug!(stage = %self.stage, ok = result.is_ok(), "ends");
        result
    }
}

/// Asks the system to end this process with its parent, so that a killed launcher leaves no stage behind.
fn die_with_parent(parent_pid: Option<u32>) -> anyhow::Result<()> {
    let Some(expected) = parent_pid else { return Ok(()) };
    set_parent_process_death_signal(Some(Signal::TERM)).context("cannot watch the parent process")?;
    // The parent may have died before the line above took effect.
    let parent = getppid().map_or(0, |pid| pid.as_raw_nonzero().get() as u32);
    anyhow::ensure!(parent == expected, "the launcher (process {expected}) has ended");
    Ok(())
}

/// Logs each event as one line on standard error: `LEVEL message fields`, or a JSON object. The launcher adds time and
/// stage.
fn init_log(level: LogLevel, format: LogFormat) {
    let level: tracing::Level = level.name().parse().unwrap_or(tracing::Level::INFO);
    let log = tracing_subscriber::fmt()
        .with_max_level(level)
        .with_writer(std::io::stderr)
        // A line that cannot be written would be reported on the same full output, which panics.
        .log_internal_errors(false)
        .with_ansi(false)
        .with_target(false)
        .without_time();
    // It only fails if a log is already set up; that log then stays.
    let _ = match format {
        LogFormat::Text => log.try_init(),
        LogFormat::Json => log.json().flatten_event(true).with_span_list(false).try_init(),
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At the default level a frame's span is not created; at `debug` it is, and its log lines contain frame and step.
    #[test]
    fn frames_have_spans_where_they_are_asked_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log");
        let logged = |level: tracing::Level| {
            let file = Arc::new(std::fs::File::create(&path).unwrap());
            let log = tracing_subscriber::fmt().with_max_level(level).with_ansi(false).without_time().with_writer(file);
            tracing::subscriber::with_default(log.finish(), || {
                let span = frame_span(&Header::of_frame(41, 1, 1).at_step(2));
                tracing::error!("odd");
                assert_eq!(span.is_disabled(), level < tracing::Level::DEBUG);
            });
            std::fs::read_to_string(&path).unwrap()
        };
        let text = logged(tracing::Level::INFO);
        assert!(!text.contains("frame{") && text.contains("odd"), "{text}");
        let text = logged(tracing::Level::DEBUG);
        assert!(text.contains("frame{frame=41 step=2}") && text.contains("odd"), "{text}");
    }

    /// Causes that a message contains are not repeated; others are added.
    #[test]
    fn errors_do_not_repeat_themselves() {
        let cause = std::io::Error::other("disk on fire");
        let error = anyhow::Error::new(cause).context("cannot read x: disk on fire").context("no weights");
        assert_eq!(sentence(&*error), "no weights: cannot read x: disk on fire");
    }
}
