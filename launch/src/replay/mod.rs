//! `carff replay`: sends a recording through a graph again.

mod compare;
mod feed;

use crate::launch::{LaunchArgs, run_graph};
use crate::supervision::{Ended, Feed};
use anyhow::{Context, bail, ensure};
use carff::terminal::Terminal;
use carff_messages::Stage;
use carff_recording::{Reader, RecordingAbout};
use carff_transport::TopicId;
use clap::Args;
use compare::{COMPARED, Carried, Replayed};
use feed::{NO_INPUT, Pace, Player, has_input};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, Mutex};

/// Replay a recording.
#[derive(Clone, Debug, Args)]
pub struct ReplayArgs {
    /// The recording.
    pub recording: PathBuf,
    /// Speed factor.
    #[arg(long, value_parser = positive, conflicts_with = "step")]
    pub rate: Option<f64>,
    /// Send one frame for each press of Enter.
    #[arg(long)]
    pub step: bool,
    /// Start this many seconds after the beginning.
    #[arg(long, value_parser = positive)]
    pub from: Option<f64>,
    /// Stop this many seconds after the beginning.
    #[arg(long, value_parser = positive)]
    pub to: Option<f64>,
    /// Topics to send from the recording, separated by commas. Default: only `camera/frame`, and with it `ego/motion`
    /// where it was recorded. The stages that publish them, and all stages before those, are not started. `all`: no
    /// stage is started.
    #[arg(long, value_parser = only)]
    pub only: Option<Only>,
    /// Send one frame at a time and wait for its decision; then compare every posterior, forecast, belief and decision
    /// with the recorded ones.
    #[arg(long, conflicts_with_all = ["rate", "step", "only"])]
    pub verify: bool,
    /// Run name; replaces the recorded one.
    #[arg(long)]
    pub run: Option<String>,
    /// Graph file; replaces the recorded one.
    #[arg(long)]
    pub graph: Option<PathBuf>,
    /// Dataset folder; replaces the recorded one.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Checkpoint folder; replaces the recorded one.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Folder of the stages' programs; default: this program's folder.
    #[arg(long, hide = true)]
    pub stages: Option<PathBuf>,
}

/// Topics that the recording supplies.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Only(pub BTreeSet<TopicId>);

fn only(text: &str) -> Result<Only, String> {
    if text == "all" {
        return Ok(Only(TopicId::FLOW.into()));
    }
    let topics = text.split(',').map(|name| name.trim().parse::<TopicId>().map_err(|e| e.to_string()));
    let topics = topics.collect::<Result<BTreeSet<_>, _>>()?;
    if topics.iter().any(|topic| !TopicId::FLOW.contains(topic)) {
        return Err("heartbeats are not replayed".to_owned());
    }
    Ok(Only(topics))
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        _ => Err("it must be a number, at least 0".to_owned()),
    }
}

/// The stages in the order of the data flow, without the renderer, which is a branch of it.
const WAY: [Stage; 5] = [Stage::Camera, Stage::Encoder, Stage::Forecaster, Stage::Prober, Stage::Controller];

/// Returns the stages that are not started for these topics: their publishers, and all stages before them.
fn replaced(topics: &BTreeSet<TopicId>) -> BTreeSet<Stage> {
    let last = WAY.iter().rposition(|&stage| topics.contains(&TopicId::of_stage(stage))).unwrap_or(0);
    let mut stages: BTreeSet<Stage> = WAY[..=last].iter().copied().collect();
    if topics.contains(&TopicId::VIEW) {
        stages.insert(Stage::Renderer);
    }
    stages
}

/// Replays a recording. The exit code is 1 if a comparison found a difference.
pub fn run(args: &ReplayArgs) -> anyhow::Result<ExitCode> {
    let topics = args.only.clone().map_or_else(|| [TopicId::FRAME].into(), |only| only.0);
    ensure!(!topics.is_empty(), "name at least one topic with --only");
    ensure!(!args.step || has_input(), NO_INPUT);
    let (about, sent) = check(args, &topics)?;
    let folder = tempfile::tempdir().context("cannot create a temporary folder")?;
    // The recorded configuration, or the original file if it is unchanged: error messages then name that file.
    let graph = match (&args.graph, &about) {
        (Some(graph), _) => graph.clone(),
        (None, Some(about)) if std::fs::read_to_string(&about.graph).is_ok_and(|text| text == about.graph_text) => {
            PathBuf::from(&about.graph)
        }
        (None, Some(about)) => write_graph(folder.path(), &about.graph_text)?,
        (None, None) => bail!(
            "{} has no metadata `carff`, because another tool rewrote it: name its graph file with --graph",
            args.recording.display()
        ),
    };
    let recorded = |folder: fn(&RecordingAbout) -> &String| about.as_ref().map(|about| PathBuf::from(folder(about)));
    let launch = LaunchArgs {
        graph,
        dataset: args.dataset.clone().or_else(|| recorded(|about| &about.dataset)),
        checkpoint: args.checkpoint.clone().or_else(|| recorded(|about| &about.checkpoint)),
        run: args.run.clone().or_else(|| about.as_ref().map(|about| about.run.clone())),
        stages: args.stages.clone(),
        verbose: true,
        ..LaunchArgs::default()
    };
    let pace = match (args.verify, args.step, args.rate) {
        (true, ..) => Pace::AfterEachDecision,
        (_, true, _) => Pace::OnEnter,
        (.., rate) => Pace::Rate(rate.unwrap_or(1.0)),
    };
    let terminal = Arc::new(Terminal::new());
    let replayed = Arc::new(Mutex::new(Replayed::default()));
    let player = Player {
        recording: args.recording.clone(),
        topics: sent,
        pace,
        from_ns: args.from.map_or(0, |s| (s * 1e9) as u64),
        to_ns: args.to.map_or(u64::MAX, |s| (s * 1e9) as u64),
        terminal: terminal.clone(),
        replayed: args.verify.then(|| replayed.clone()),
    };
    let run = Box::new(move |run: &_, stop: &_| player.play(run, stop));
    let feed = Feed { without: replaced(&topics), is_quiet: false, run };
    let (ended, outcome) = run_graph(&launch, Some(feed), &terminal)?;
    if ended == Ended::Interrupted || !args.verify {
        return Ok(ExitCode::SUCCESS);
    }
    let replayed = std::mem::take(&mut *replayed.lock().unwrap_or_else(std::sync::PoisonError::into_inner));
    let comparison = replayed.compare(&args.recording, Carried::of(&outcome.graph))?;
    println!("{comparison}");
    Ok(if comparison.is_same() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Checks that the recording has the topics of the replay. Returns its metadata, and the topics that it sends: of all
/// topics, those that it has.
fn check(args: &ReplayArgs, topics: &BTreeSet<TopicId>) -> anyhow::Result<(Option<RecordingAbout>, BTreeSet<TopicId>)> {
    let mut reader = Reader::open(&args.recording)?;
    let mut sent = topics.clone();
    // No stage of the graph publishes the motion of the vehicle, on which an approach rests.
    if topics.contains(&TopicId::FRAME) && reader.has(TopicId::EGO_MOTION) {
        sent.insert(TopicId::EGO_MOTION);
    }
    if TopicId::FLOW.iter().all(|topic| topics.contains(topic)) && topics.iter().any(|topic| reader.has(*topic)) {
        sent.retain(|topic| reader.has(*topic));
    }
    reader.select(sent.iter().copied())?;
    ensure!(
        !args.verify || COMPARED.iter().any(|topic| reader.has(*topic)),
        "{} has nothing to compare: it has no messages on {}; record these topics, or omit --verify",
        args.recording.display(),
        COMPARED.map(|topic| format!("`{topic}`")).join(", ")
    );
    if args.from.is_some() || args.to.is_some() {
        check_range(args, &sent)?;
    }
    Ok((reader.about().cloned(), sent))
}

/// Checks that at least one of the topics has a message between `--from` and `--to`.
fn check_range(args: &ReplayArgs, topics: &BTreeSet<TopicId>) -> anyhow::Result<()> {
    let (from_s, to_s) = (args.from.unwrap_or(0.0), args.to.unwrap_or(f64::INFINITY));
    let mut reader = Reader::open(&args.recording)?.without_images();
    reader.select(topics.iter().copied())?;
    let mut last_s = 0.0;
    while let Some(entry) = reader.next()? {
        last_s = entry.wall_time_ns.saturating_sub(reader.first_ns()) as f64 / 1e9;
        if (from_s..=to_s).contains(&last_s) {
            return Ok(());
        }
    }
    let file = args.recording.display();
    bail!("{file} has no message to replay from {from_s} s to {to_s} s; its last one is at {last_s:.1} s")
}

fn write_graph(folder: &Path, text: &str) -> anyhow::Result<PathBuf> {
    let path = folder.join("graph.toml");
    std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Publishers of replayed topics are not started, and no stage before them.
    #[test]
    fn senders_are_replaced() {
        let of = |text: &str| replaced(&only(text).unwrap().0);
        assert_eq!(of("camera/frame"), [Stage::Camera].into());
        assert_eq!(of("prober/belief"), [Stage::Camera, Stage::Encoder, Stage::Forecaster, Stage::Prober].into());
        assert_eq!(of("view"), [Stage::Camera, Stage::Renderer].into());
        assert_eq!(of("all").len(), Stage::ALL.len());
        assert!(only("prober/beleif").is_err() && only("health/camera").is_err());
    }
}
