//! The commands that observe a run or read a recording: probes, recorder, exports, bridge, metrics.
//!
//! This crate contains commands without a model, and the terminal's output. It never links libtorch, which would make
//! the start of a probe thirty times as expensive.

#[cfg(feature = "bridge")]
pub mod bridge;
#[cfg(feature = "recording")]
pub mod export;
#[cfg(feature = "film")]
mod film;
pub mod log_line;
pub mod metrics;
mod not_built;
pub mod probe;
#[cfg(feature = "recording")]
pub mod record;
mod spans;
pub mod terminal;
pub mod view;
mod vitals;

pub use not_built::NotBuilt;

use anyhow::Context;
use clap::Subcommand;
use std::any::Any;
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode};

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
    /// Open the live window: each forecast scene from any camera.
    #[command(after_help = "Example: on the running graph, or on a checkpoint only
  carff view
  carff view --checkpoint configs/checkpoints/approaching-intersection")]
    View(view::ViewArgs),
    /// Record a running graph into an MCAP file.
    #[command(after_help = "Example: all topics for a minute; only beliefs and actions, in six files of ten minutes
  carff record -o run.mcap --seconds 60
  carff record belief action -o drive.mcap --file-seconds 600 --keep 6")]
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
            Self::View(args) => view::run(args),
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

/// Returns a program's exit code, and prints an error as one sentence.
pub fn exit_code(result: anyhow::Result<ExitCode>) -> ExitCode {
    result.unwrap_or_else(|error| {
        eprintln!("error: {}", carff_base::errors::sentence(&*error));
        ExitCode::FAILURE
    })
}

/// Runs a program to its end. If the reader of standard output closes the pipe (`| head`), the program ends like others
/// do: without a message and with exit code 141.
pub fn until_read(program: impl FnOnce() -> ExitCode) -> ExitCode {
    let told = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if !says_closed_pipe(info.payload()) {
            told(info);
        }
    }));
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(program)).unwrap_or_else(|payload| {
        if says_closed_pipe(&*payload) { ExitCode::from(141) } else { std::panic::resume_unwind(payload) }
    })
}

/// Returns true for the panic of `println!` on a closed pipe.
fn says_closed_pipe(payload: &(dyn Any + Send)) -> bool {
    payload
        .downcast_ref::<String>()
        .is_some_and(|text| text.starts_with("failed printing to stdout") && text.contains("Broken pipe"))
}

/// Replaces this process with another program of this project from the same folder; returns if that fails.
pub fn become_program(name: &str, args: &[OsString]) -> anyhow::Result<ExitCode> {
    let program = std::env::current_exe()?.with_file_name(name);
    let error = Command::new(&program).args(args).exec();
    Err(error).with_context(|| format!("cannot start {}; build it with `make build`", program.display()))
}
