//! Measures the program's parts, and the whole loop, on this machine.
//!
//! Comparisons alternate all variants in one run, and report ratios of medians. No test contains a benchmark, because
//! times depend on the machine and on its load. Each benchmark prints a table. It can also write its figures as JSON,
//! with a description of the machine, and compare them with an earlier run.

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

/// The benchmarks.
#[derive(Debug, clap::Subcommand)]
pub enum BenchCommand {
    /// Compare the field's kernels with the same model in tensor operations and with the machine's limits.
    #[command(after_help = "Example: on one thread, compared with an earlier run
  carff bench field --threads 1 --baseline docs/performance.json")]
    Field(field::FieldArgs),
    /// Measure encoder and forecaster, one frame at a time.
    #[command(after_help = "Example: only the shipped networks
  carff bench encoder --no-vit --json reports/performance.json")]
    Encoder(encoder::EncoderArgs),
    /// Measure payloads between processes: this program's topics, bare iceoryx2, Unix sockets, zenoh.
    #[command(after_help = "Example: with the figures as JSON
  carff bench ipc --json reports/performance.json")]
    Ipc(ipc::IpcArgs),
    /// Run the receiving process of `ipc`.
    #[command(hide = true)]
    IpcPeer(ipc::PeerArgs),
    /// Measure the time from camera to action with all stages.
    #[command(after_help = "Example: in a minute
  carff bench loop --quick")]
    Loop(graph_loop::LoopArgs),
    /// Measure the growth of cost with samples, horizon, resolution, candidates, stages and probes.
    #[command(after_help = "Example: in a few minutes, with plots
  carff bench scale --quick --plots reports/scale")]
    Scale(scale::ScaleArgs),
    /// Run a process of `scale`'s chain of stages.
    #[command(hide = true)]
    Relay(scale::RelayArgs),
    /// Run the process of `scale`'s probes.
    #[command(hide = true)]
    Probes(probes::ProbesArgs),
}

/// Output of the figures.
#[derive(Clone, Debug, clap::Args)]
pub struct OutputArgs {
    /// Write the figures to this JSON file. Its figures of other benchmarks are kept.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Compare with the figures in an earlier run's JSON file, as ratios.
    #[arg(long)]
    baseline: Option<PathBuf>,
}

/// Runs a benchmark, prints its tables, and writes its figures if requested.
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
