//! `carff probe`: observes a running graph from another terminal, without a configuration and without delaying the
//! graph.

mod belief;
mod echo;
pub(crate) mod image;
mod inline;
mod measure;
mod structure;
mod top;
mod trace;

pub(crate) use inline::{Inline, columns};

use crate::complete;
use crate::session::SessionArgs;
use clap::{Args, Subcommand};
use clap_complete::engine::ArgValueCandidates;
use std::path::PathBuf;
use std::process::ExitCode;

/// The commands of `carff probe`.
#[derive(Clone, Debug, Subcommand)]
pub enum ProbeCommand {
    /// List the run's topics: type, schema version, publishers, subscribers, rate.
    #[command(after_help = "Example:\n  carff probe list --seconds 3")]
    List {
        /// The run, and the time over which rates are measured.
        #[command(flatten)]
        session: SessionArgs,
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
    /// Print the running processes and topics as a graph.
    #[command(
        after_help = "Example: an image of the graph (dot is part of Graphviz)\n  carff probe graph --format dot | dot -Tsvg > graph.svg"
    )]
    Graph {
        /// The run.
        #[command(flatten)]
        session: SessionArgs,
        /// Format of the graph.
        #[arg(long, value_enum, default_value_t)]
        format: structure::GraphFormat,
    },
    /// Show a topic's messages as text or JSON lines.
    #[command(
        after_help = "Example: every tenth belief, for another program\n  carff probe echo belief --json --every 10 | jq .hazard_probability"
    )]
    Echo(echo::EchoArgs),
    /// Measure a topic's rate and jitter, live; on exit print percentiles of the time between messages.
    #[command(after_help = "Example: for ten seconds\n  carff probe hz controller/action --seconds 10")]
    Hz(TopicArgs),
    /// Measure a topic's bytes per second, live; on exit print percentiles of the message size.
    #[command(after_help = "Example:\n  carff probe bw camera/frame --seconds 10")]
    Bw(TopicArgs),
    /// Measure the age of a topic's messages on arrival and since the capture, live; on exit print percentiles.
    #[command(after_help = "Example:\n  carff probe delay controller/action --seconds 10")]
    Delay(TopicArgs),
    /// Write camera frames or rendered views to PNG files, or show them in the terminal.
    #[command(
        after_help = "Example: the next five views as files; a frame in the terminal\n  carff probe image renderer/view -o views --count 5\n  carff probe image camera/frame --count 1"
    )]
    Image(image::ImageArgs),
    /// Show the belief over states, live, with its samples.
    #[command(after_help = "Example: once, for a log\n  carff probe belief --count 1")]
    Belief(belief::BeliefArgs),
    /// Trace one frame: the times at which it entered and left each stage, and the decision.
    #[command(
        after_help = "Example: the next frame; a minute of frames for ui.perfetto.dev; a frame of a recording\n  carff probe trace next\n  carff probe trace next --seconds 60 --perfetto trace.json\n  carff probe trace 5 --recording run.mcap"
    )]
    Trace(trace::TraceArgs),
    /// Show all stages on one screen: state, rate, latency, CPU, memory, restarts, missed deadlines.
    #[command(
        after_help = "Example: once, as plain text\n  carff probe top --once\n  carff probe top --columns stage,state,rate,errors --sort errors"
    )]
    Top(top::TopArgs),
}

/// A topic, and the time limit.
#[derive(Clone, Debug, Args)]
pub struct TopicArgs {
    /// Topic that `carff probe list` shows: `prober/belief`, or `belief` for short.
    #[arg(add = ArgValueCandidates::new(complete::topics))]
    pub topic: String,
    /// Stop after this number of messages.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Runs the command until a stop is requested, the time is over, or the run ends.
pub fn run(command: &ProbeCommand) -> anyhow::Result<ExitCode> {
    match command {
        ProbeCommand::List { session, json } => structure::list(session, *json),
        ProbeCommand::Graph { session, format } => structure::graph(session, *format),
        ProbeCommand::Echo(args) => echo::run(args),
        ProbeCommand::Hz(args) => measure::run(args, measure::Quantity::Rate),
        ProbeCommand::Bw(args) => measure::run(args, measure::Quantity::Bandwidth),
        ProbeCommand::Delay(args) => measure::run(args, measure::Quantity::Delay),
        ProbeCommand::Image(args) => image::run(args),
        ProbeCommand::Belief(args) => belief::run(args),
        ProbeCommand::Trace(args) => trace::run(args),
        ProbeCommand::Top(args) => top::run(args),
    }?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the path of a file in an output folder, and creates the folder if it is missing.
fn file_in(folder: &std::path::Path, name: &str) -> anyhow::Result<PathBuf> {
    use anyhow::Context;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
    Ok(folder.join(name))
}
