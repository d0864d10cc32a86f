//! What attaches to a run from outside, or reads what was taken home of one: probes, recorder, exports, bridge, metrics.
//!
//! What lives here: the commands that need no model, and what the terminal shows. What never does: a model, and whatever
//! links libtorch, which would make a probe's start thirty times as dear.

pub mod bridge;
pub mod export;
mod film;
pub mod log_line;
pub mod metrics;
pub mod probe;
pub mod record;
mod spans;
pub mod terminal;
pub mod view;
mod vitals;

use anyhow::Context;
use clap::Subcommand;
use std::any::Any;
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode};

/// The commands of this room.
#[derive(Debug, Subcommand)]
pub enum Attach {
    /// Look at a running graph from another terminal.
    #[command(
        subcommand,
        after_help = "Example: what runs, and how each stage does
  carff probe list
  carff probe top"
    )]
    Probe(probe::ProbeCommand),
    /// Open the live window: each hypothesis from any camera.
    #[command(after_help = "Example: on the run that lives, or on a checkpoint alone
  carff view
  carff view --checkpoint configs/checkpoints/approaching-intersection")]
    View(view::ViewArgs),
    /// Record a running graph into an MCAP file.
    #[command(
        after_help = "Example: a minute of everything; actions and beliefs alone, in files of 10 minutes of which 6 are kept
  carff record -o run.mcap --seconds 60
  carff record belief action -o drive.mcap --file-seconds 600 --keep 6"
    )]
    Record(record::RecordArgs),
    /// Make pictures, tables, a film, or a trace of a recording.
    #[command(after_help = "Example:
  carff export run.mcap --png pictures --csv tables --trace trace.json")]
    Export(export::ExportArgs),
    /// Serve a run's topics over the Foxglove WebSocket protocol, read-only, on this machine alone.
    #[command(
        after_help = "Example: on the vehicle, and through a tunnel to the desk, where Foxglove opens ws://localhost:8765
  carff bridge
  ssh -L 8765:localhost:8765 vehicle"
    )]
    Bridge(bridge::BridgeArgs),
    /// Serve a run's numbers over HTTP, for Prometheus, on this machine alone.
    #[command(after_help = "Example:
  carff metrics --listen 127.0.0.1:9464
  curl http://127.0.0.1:9464/metrics
  carff metrics --once")]
    Metrics(metrics::MetricsArgs),
}

impl Attach {
    /// Does what is asked for.
    pub fn run(&self) -> anyhow::Result<ExitCode> {
        match self {
            Self::Probe(command) => probe::run(command),
            Self::View(args) => view::run(args),
            Self::Record(args) => record::run(args),
            Self::Export(args) => export::run(args),
            Self::Bridge(args) => bridge::run(args),
            Self::Metrics(args) => metrics::run(args),
        }
    }
}

/// A program's exit code; an error is told in one sentence.
pub fn exit_code(result: anyhow::Result<ExitCode>) -> ExitCode {
    result.unwrap_or_else(|error| {
        eprintln!("error: {}", carff_stage::describe(&error));
        ExitCode::FAILURE
    })
}

/// Runs a program to its end. Where standard output's reader has seen enough (`| head`), that is an end like any other
/// program's: without a word, with exit code 141.
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

/// `println!` panics with these words where nobody reads.
fn says_closed_pipe(payload: &(dyn Any + Send)) -> bool {
    payload
        .downcast_ref::<String>()
        .is_some_and(|text| text.starts_with("failed printing to stdout") && text.contains("Broken pipe"))
}

/// Becomes another program of ours, which lies beside this one; returns when it cannot be started.
pub fn become_program(name: &str, args: &[OsString]) -> anyhow::Result<ExitCode> {
    let program = std::env::current_exe()?.with_file_name(name);
    let error = Command::new(&program).args(args).exec();
    Err(error).with_context(|| format!("cannot start {}; build it with `make build`", program.display()))
}
