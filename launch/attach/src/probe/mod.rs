//! `carff probe`: looking at a running graph from another terminal, without a config and without disturbing it.

mod belief;
mod echo;
pub(crate) mod image;
mod inline;
mod measure;
pub(crate) mod session;
mod structure;
mod top;
mod trace;

pub use session::SessionArgs;

use carff_transport::TopicId;
use clap::{Args, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;

/// What to look at.
#[derive(Clone, Debug, Subcommand)]
pub enum ProbeCommand {
    /// The topics of the run: type, schema version, who sends, who receives, messages a second.
    #[command(after_help = "Example:\n  carff probe list --seconds 3")]
    List {
        /// Which run, and for how long the rates are counted.
        #[command(flatten)]
        session: SessionArgs,
        /// As JSON.
        #[arg(long)]
        json: bool,
    },
    /// Processes and topics as a graph, from what runs.
    #[command(
        after_help = "Example: a picture of what runs (dot is Graphviz's)\n  carff probe graph --format dot | dot -Tsvg > graph.svg"
    )]
    Graph {
        /// Which run.
        #[command(flatten)]
        session: SessionArgs,
        /// How it is written.
        #[arg(long, value_enum, default_value_t)]
        format: structure::GraphFormat,
    },
    /// A topic's messages, as text or JSON lines.
    #[command(
        after_help = "Example: every tenth belief, for another program\n  carff probe echo belief --json --every 10 | jq .hazard_probability"
    )]
    Echo(echo::EchoArgs),
    /// A topic's rate and its jitter, live; on exit percentiles of the time between messages.
    #[command(after_help = "Example: ten seconds of it\n  carff probe hz controller/action --seconds 10")]
    Hz(TopicArgs),
    /// A topic's bytes a second, live; on exit percentiles of the message's size.
    #[command(after_help = "Example:\n  carff probe bw camera/frame --seconds 10")]
    Bw(TopicArgs),
    /// Age of a topic's messages on arrival, and time from the camera's capture to here, live; on exit percentiles.
    #[command(after_help = "Example:\n  carff probe delay controller/action --seconds 10")]
    Delay(TopicArgs),
    /// Camera frames or rendered views, to PNG files, or into the terminal, as well as it can show them.
    #[command(
        after_help = "Example: the next five views, as files; and a frame, here\n  carff probe image renderer/view -o views --count 5\n  carff probe image camera/frame --count 1"
    )]
    Image(image::ImageArgs),
    /// The belief over states, live, with the samples behind it.
    #[command(after_help = "Example: one look, for a log\n  carff probe belief --count 1")]
    Belief(belief::BeliefArgs),
    /// One frame's way: when it entered and left each stage, and what was decided.
    #[command(
        after_help = "Example: the next frame, and a minute of frames for ui.perfetto.dev\n  carff probe trace next\n  carff probe trace next --seconds 60 --perfetto trace.json"
    )]
    Trace(trace::TraceArgs),
    /// Stages, state, rate, latency, CPU, memory, restarts, missed deadlines: a full-screen view.
    #[command(after_help = "Example: once, without a terminal of its own\n  carff probe top --once")]
    Top(top::TopArgs),
}

/// A topic, and how long to look at it.
#[derive(Clone, Debug, Args)]
pub struct TopicArgs {
    /// The topic: `prober/belief`, or `belief` for short.
    pub topic: TopicId,
    /// Which run, and for how long.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Looks, until it is told to stop, the time is over, or the run ends.
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

/// A file of an output folder, which is made when it is missing.
fn file_in(folder: &std::path::Path, name: &str) -> anyhow::Result<PathBuf> {
    use anyhow::Context;
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    Ok(folder.join(name))
}
