//! Measures the program's parts, and the whole loop, on this machine.
//!
//! Comparisons alternate all variants in one run, and report ratios of medians. No test contains a benchmark, because
//! times depend on the machine and on its load. Each benchmark prints a table. It can also write its figures as JSON,
//! with a description of the machine, and compare them with an earlier run.

mod graph;
mod graph_loop;
mod helper;
mod ipc;
mod machine;
mod probes;
pub mod report;
mod scale;
pub mod stats;
mod tensors;

pub use tensors::{EncoderArgs, FieldArgs, TensorBench};

use report::Report;
use std::path::PathBuf;
use std::process::ExitCode;

/// The benchmarks.
#[derive(Debug, clap::Subcommand)]
pub enum BenchCommand {
    /// Benchmarks against tensor operations.
    #[command(flatten)]
    Tensors(TensorBench),
    /// Benchmarks of processes.
    #[command(flatten)]
    Graph(GraphBench),
}

/// Benchmarks of processes and topics, which need no libtorch.
#[derive(Debug, clap::Subcommand)]
pub enum GraphBench {
    /// Measure payloads between processes: this program's topics, bare iceoryx2, Unix sockets, zenoh, dora.
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

impl GraphBench {
    fn output(&self) -> Option<&OutputArgs> {
        match self {
            Self::Ipc(args) => Some(&args.output),
            Self::Loop(args) => Some(&args.output),
            Self::Scale(args) => Some(&args.output),
            Self::IpcPeer(_) | Self::Relay(_) | Self::Probes(_) => None,
        }
    }
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

impl OutputArgs {
    /// Refuses a file that cannot be written, before the long part.
    pub fn check(&self) -> anyhow::Result<()> {
        self.json.as_deref().map_or(Ok(()), carff_base::files::check_writable).map_err(Into::into)
    }

    /// Prints the machine, and compares and writes the figures of a benchmark as requested.
    pub fn finish(&self, report: &Report) -> anyhow::Result<()> {
        let machine = machine::describe();
        println!("\nmachine: {}", machine::sentence(&machine));
        if let Some(path) = &self.baseline {
            print!("\n{}", report.compared_with(&report::read(path)?));
        }
        if let Some(path) = &self.json {
            report.write(path, &machine)?;
            println!("figures: {}", path.display());
        }
        Ok(())
    }
}

/// Runs a benchmark, prints its tables, and writes its figures if requested.
pub fn run(command: GraphBench) -> anyhow::Result<ExitCode> {
    command.output().map_or(Ok(()), OutputArgs::check)?;
    let (report, output) = match command {
        GraphBench::Ipc(args) => (ipc::run(&args)?, args.output),
        GraphBench::Loop(args) => (graph_loop::run(&args)?, args.output),
        GraphBench::Scale(args) => (scale::run(&args)?, args.output),
        GraphBench::IpcPeer(args) => {
            ipc::peer(&args)?;
            return Ok(ExitCode::SUCCESS);
        }
        GraphBench::Relay(args) => {
            scale::relay(&args)?;
            return Ok(ExitCode::SUCCESS);
        }
        GraphBench::Probes(args) => {
            probes::run(&args)?;
            return Ok(ExitCode::SUCCESS);
        }
    };
    output.finish(&report)?;
    Ok(ExitCode::SUCCESS)
}
