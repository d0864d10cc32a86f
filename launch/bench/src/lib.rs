//! Measures the program's parts, and the whole loop, on the machine at hand.
//!
//! Whatever is compared is measured in one run, in turns, and compared as a ratio of medians. Nothing here is part of
//! the tests: times depend on the machine, and on what else it does. Each benchmark prints a table, and can write its
//! figures as JSON with a description of the machine, and compare them with those of an earlier run.

mod encoder;
mod field;
mod graph;
mod graph_loop;
mod helper;
mod ipc;
mod limits;
mod machine;
mod probes;
pub mod reference;
mod report;
mod scale;
mod stats;

use report::Report;
use std::path::PathBuf;
use std::process::ExitCode;

/// What to measure.
#[derive(Debug, clap::Subcommand)]
pub enum BenchCommand {
    /// The field's kernels against the same model in tensor operations and against the machine's limits.
    #[command(after_help = "Example: on one thread, compared with an earlier run
  carff bench field --threads 1 --baseline docs/performance.json")]
    Field(field::FieldArgs),
    /// Encoder and forecaster, one frame at a time.
    #[command(after_help = "Example: the shipped networks alone
  carff bench encoder --no-vit --json reports/performance.json")]
    Encoder(encoder::EncoderArgs),
    /// From one process to another: this program's topics, bare iceoryx2, Unix sockets, zenoh.
    #[command(after_help = "Example: with the figures as JSON
  carff bench ipc --json reports/performance.json")]
    Ipc(ipc::IpcArgs),
    /// The other process of `ipc`.
    #[command(hide = true)]
    IpcPeer(ipc::PeerArgs),
    /// Camera to action, with all stages alive.
    #[command(after_help = "Example: in a minute
  carff bench loop --quick")]
    Loop(graph_loop::LoopArgs),
    /// How cost grows with samples, horizon, resolution, candidates, stages and probes.
    #[command(after_help = "Example: in a few minutes, with plots
  carff bench scale --quick --plots reports/scale")]
    Scale(scale::ScaleArgs),
    /// A process of `scale`'s chain of stages.
    #[command(hide = true)]
    Relay(scale::RelayArgs),
    /// The process of `scale`'s probes.
    #[command(hide = true)]
    Probes(probes::ProbesArgs),
}

/// Where figures go.
#[derive(Clone, Debug, clap::Args)]
pub struct OutputArgs {
    /// Write the figures here, as JSON. Figures of other benchmarks that the file holds are kept.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Compare with the figures of an earlier run's JSON, as ratios.
    #[arg(long)]
    baseline: Option<PathBuf>,
}

/// Measures, prints, and writes what was asked for.
pub fn run(command: BenchCommand) -> anyhow::Result<ExitCode> {
    let (report, output) = match command {
        BenchCommand::Field(args) => (field::run(&args)?, args.output),
        BenchCommand::Encoder(args) => (encoder::run(&args)?, args.output),
        BenchCommand::Ipc(args) => (ipc::run(&args)?, args.output),
        BenchCommand::Loop(args) => (graph_loop::run(&args)?, args.output),
        BenchCommand::Scale(args) => (scale::run(&args)?, args.output),
        BenchCommand::IpcPeer(args) => {
            ipc::peer(&args)?;
            return Ok(ExitCode::SUCCESS);
        }
        BenchCommand::Relay(args) => {
            scale::relay(&args)?;
            return Ok(ExitCode::SUCCESS);
        }
        BenchCommand::Probes(args) => {
            probes::run(&args)?;
            return Ok(ExitCode::SUCCESS);
        }
    };
    finish(&report, &output)?;
    Ok(ExitCode::SUCCESS)
}

fn finish(report: &Report, output: &OutputArgs) -> anyhow::Result<()> {
    let machine = machine::describe();
    println!("\nmachine: {}", machine::sentence(&machine));
    if let Some(path) = &output.baseline {
        print!("\n{}", report.compared_with(&report::read(path)?));
    }
    if let Some(path) = &output.json {
        report.write(path, &machine)?;
        println!("figures: {}", path.display());
    }
    Ok(())
}
