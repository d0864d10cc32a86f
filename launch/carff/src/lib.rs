//! The commands that observe a run or read a recording: probes, recorder, exports, bridge, metrics.
//!
//! This crate contains commands without a model, and the terminal's output. It never links libtorch, which would make
//! the start of a probe thirty times as expensive.

#![warn(clippy::print_stderr, reason = "`eprintln!` panics where standard error is full: `carff::say` does not")]

#[cfg(feature = "bridge")]
pub mod bridge;
pub mod camera;
mod complete;
pub mod conditions;
#[cfg(feature = "recording")]
pub mod export;
#[cfg(feature = "film")]
mod film;
mod http;
pub mod info;
pub mod layout;
mod log_file;
pub mod log_line;
pub mod metrics;
mod not_built;
pub mod probe;
mod programs;
pub mod provenance;
#[cfg(feature = "recording")]
pub mod record;
pub mod runs;
pub mod session;
pub mod spans;
pub mod terminal;
pub mod view;
mod vitals;

pub use carff_runtime::parse;
pub use not_built::NotBuilt;
pub use programs::become_program;

use anyhow::{Context, anyhow};
use carff_transport::{INTERRUPTED, exit_on_signals, is_interrupted};
use clap::Subcommand;
use std::any::Any;
use std::io::Write;
use std::panic::AssertUnwindSafe;
use std::process::ExitCode;

/// The commands of this crate.
#[derive(Debug, Subcommand)]
pub enum Attach {
    /// Observe a running graph from another terminal.
    #[command(
        subcommand,
        after_help = "Example: list the topics; show all stages
  carff probe list
  carff probe top"
    )]
    Probe(probe::ProbeCommand),
    /// List the living runs.
    #[command(after_help = "Example:
  carff ps
  carff ps --json")]
    Ps(runs::PsArgs),
    /// Check a camera before the first drive.
    #[command(
        subcommand,
        after_help = "Example: what arrives, and what the model sees, as an image file
  carff camera check configs/graphs/approaching-intersection.toml --image check.png"
    )]
    Camera(camera::CameraCommand),
    /// Describe a run to other programs.
    #[command(
        subcommand,
        after_help = "Example: what a program in another language needs to join the only run
  carff run info --json"
    )]
    Run(info::RunCommand),
    /// Stop a run, as Ctrl-C in its terminal does, and wait for its end.
    #[command(after_help = "Example: the only run; the run of a name
  carff stop
  carff stop approaching-intersection")]
    Stop(runs::StopArgs),
    /// Print the log of a run that lives or has ended.
    #[command(after_help = "Example: follow the only run
  carff logs --follow")]
    Logs(runs::LogsArgs),
    /// Open the live window: each forecast scene of an image, from any camera. Images come from a dataset or, with --run,
    /// from a running graph, which the window does not delay.
    #[command(after_help = "Example: on a dataset; on the only running graph, as a file
  carff view --dataset data/approaching-intersection
  carff view --run
  carff view --run --screenshot window.png")]
    View(view::ViewArgs),
    /// Record a running graph into an MCAP file.
    #[command(after_help = "Example: all topics for a minute; only beliefs and actions, in six files of ten minutes
  carff record -o run.mcap --seconds 60
  carff record belief action -o drive.mcap --file-seconds 600 --keep 6

Example: each run that starts, into a file of its own
  carff record --wait -o drive.mcap")]
    #[cfg(feature = "recording")]
    Record(record::RecordArgs),
    /// Record a running graph (not part of this build).
    #[cfg(not(feature = "recording"))]
    #[command(hide = true)]
    Record(NotBuilt),
    /// Export images, tables, a film or a trace from a recording.
    #[command(after_help = "Example:
  carff export run.mcap --png images --csv tables --trace trace.json")]
    #[cfg(feature = "recording")]
    Export(export::ExportArgs),
    /// Export a recording (not part of this build).
    #[cfg(not(feature = "recording"))]
    #[command(hide = true)]
    Export(NotBuilt),
    /// Serve a run's topics over the Foxglove WebSocket protocol, read-only and on loopback by default.
    #[command(
        after_help = "Example: on the vehicle; then a tunnel from the desk, where Foxglove opens ws://localhost:8765
  carff bridge
  ssh -L 8765:localhost:8765 vehicle"
    )]
    #[cfg(feature = "bridge")]
    Bridge(bridge::BridgeArgs),
    /// Serve a run's topics over the Foxglove WebSocket protocol (not part of this build).
    #[cfg(not(feature = "bridge"))]
    #[command(hide = true)]
    Bridge(NotBuilt),
    /// Serve a run's metrics over HTTP for Prometheus, on loopback by default.
    #[command(after_help = "Example:
  carff metrics --listen 127.0.0.1:9464
  curl http://127.0.0.1:9464/metrics
  carff metrics --once")]
    Metrics(metrics::MetricsArgs),
}

impl Attach {
    /// Runs the command.
    pub fn run(&self) -> anyhow::Result<ExitCode> {
        match self {
            Self::Probe(command) => probe::run(command),
            Self::Ps(args) => runs::ps(args),
            Self::Camera(command) => camera::run(command),
            Self::Run(command) => info::run(command),
            Self::Stop(args) => runs::stop(args),
            Self::Logs(args) => runs::logs(args),
            Self::View(_) => view::run(),
            #[cfg(feature = "recording")]
            Self::Record(args) => record::run(args),
            #[cfg(not(feature = "recording"))]
            Self::Record(args) => args.run("carff record"),
            #[cfg(feature = "recording")]
            Self::Export(args) => export::run(args),
            #[cfg(not(feature = "recording"))]
            Self::Export(args) => args.run("carff export"),
            #[cfg(feature = "bridge")]
            Self::Bridge(args) => bridge::run(args),
            #[cfg(not(feature = "bridge"))]
            Self::Bridge(args) => args.run("carff bridge"),
            Self::Metrics(args) => metrics::run(args),
        }
    }
}

/// Exit code of a program whose reader has closed the pipe, as of one that SIGPIPE ends.
const CLOSED_PIPE: u8 = 141;

fn is_closed_pipe(error: &anyhow::Error) -> bool {
    let is_closed = |error: &std::io::Error| error.kind() == std::io::ErrorKind::BrokenPipe;
    error.chain().any(|cause| cause.downcast_ref().is_some_and(is_closed))
}

/// Lets a signal end each phase that waits for no stop, with the exit code [`INTERRUPTED`]. A program that becomes another
/// one does not call it: a signal that it takes while it becomes the other would be lost.
pub fn end_on_signals() -> anyhow::Result<()> {
    exit_on_signals().context("cannot handle signals")
}

/// Runs a program to its end, and returns its exit code. An error is printed as one sentence. After a signal that a stop
/// has taken, the code is [`INTERRUPTED`].
pub fn run_program(program: impl FnOnce() -> anyhow::Result<ExitCode>) -> ExitCode {
    let print_panic = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if failed_output(info.payload()).is_none() {
            print_panic(info);
        }
    }));
    let result = std::panic::catch_unwind(AssertUnwindSafe(program)).unwrap_or_else(|payload| {
        match failed_output(&*payload) {
            // The reader has closed the pipe (`| head`): no message, and the shell's exit code for it.
            Some(cause) if cause.contains("Broken pipe") => Ok(ExitCode::from(CLOSED_PIPE)),
            Some(cause) => Err(anyhow!("cannot write to standard output: {cause}")),
            None => std::panic::resume_unwind(payload),
        }
    });
    let interrupted = is_interrupted();
    match result {
        Ok(ExitCode::SUCCESS) if interrupted => ExitCode::from(INTERRUPTED),
        Ok(code) => code,
        // Some commands write to standard output without `println!`.
        Err(error) if is_closed_pipe(&error) => ExitCode::from(CLOSED_PIPE),
        Err(error) => {
            // Standard error may be full or closed as well.
            let _ = writeln!(std::io::stderr(), "error: {}", carff_base::errors::sentence(&*error));
            if interrupted { ExitCode::from(INTERRUPTED) } else { ExitCode::FAILURE }
        }
    }
}

/// Prints a line on standard error. Standard error may be full or closed, which must not end the work.
pub fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Returns the cause if a panic is that of `println!` on a standard output that takes no more.
fn failed_output(payload: &(dyn Any + Send)) -> Option<&str> {
    payload.downcast_ref::<String>()?.strip_prefix("failed printing to stdout: ")
}
