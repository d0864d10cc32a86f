//! `carff drive`: closed-loop drives through a scenario, in which the ego moves by its controller's actions.
//!
//! This process is the world: it takes the place of the camera, renders what the ego sees, moves everyone, and judges
//! collisions. The stages run as in `carff launch`. Truth is published on the topic `world/truth`, for observers only.

mod episode;
mod occupancy;
mod results;
mod truth;
mod vehicle;
mod world;

use crate::dataset::find_scenario;
use crate::launch::{LaunchArgs, run_graph};
use crate::supervision::{Ended, Feed};
use anyhow::{Context, ensure};
use carff::terminal::Terminal;
use carff_base::files::{check_distinct, check_writable};
use carff_checkpoint::{CheckpointPlanning, Manifest, ScenarioIdentity};
use carff_config::{CameraSource, GraphConfig};
use carff_decision::Approach;
use carff_messages::{Rule, Stage};
use carff_scenes::{ClosedLoop, Scenario};
use clap::Args;
use occupancy::OccupancyCheck;
use results::{DriveFigures, DriveReport};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use world::World;

/// Deadline of a belief in lock-step, where the world waits for decisions, milliseconds.
const PATIENT_MS: u64 = 60_000;

/// Drive through a scenario.
#[derive(Clone, Debug, Args)]
pub struct DriveArgs {
    /// A scenario file with `closed_loop`, or the name of one in configs/scenarios.
    pub scenario: PathBuf,
    /// Checkpoint folder, trained for the scenario.
    #[arg(long)]
    pub checkpoint: PathBuf,
    /// Name of the ego's route in the scenario's tables `closed_loop`. Default: the first one.
    #[arg(long)]
    pub route: Option<String>,
    /// The rule that the ego drives by.
    #[arg(long, value_enum, default_value_t = DriveRule::Look)]
    pub rule: DriveRule,
    /// Number of episodes.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: u64,
    /// Number of the first episode: an episode depends on its number, the scenario and the seed only.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=1_000_000_000))]
    pub first: u64,
    /// Seed of episodes, sensor noise and draws.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub seed: u64,
    /// Number of other vehicles in every episode, 0 to 3. Default: drawn from the scenario's range.
    #[arg(long, value_parser = clap::value_parser!(u32).range(..=3))]
    pub actors: Option<u32>,
    /// Frames per second of the world's time.
    #[arg(long, default_value_t = 10.0, value_parser = rate)]
    pub frame_rate_hz: f64,
    /// Let time pass as on a clock. Default: lock-step, in which the world waits for the decision on each frame; the
    /// results then do not depend on the machine's speed.
    #[arg(long)]
    pub real_time: bool,
    /// Write the results here, as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write each decision here as one JSON line.
    #[arg(long, value_name = "FILE")]
    pub decisions: Option<PathBuf>,
    /// Write into the checkpoint how often cells of the others' lane are taken where the belief takes them for free and
    /// for taken, at each step. The prober then publishes grids with these rates.
    #[arg(long)]
    pub learn_occupancy: bool,
    /// Set a key of the graph's configuration, for example `run.samples=35`; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Run name.
    #[arg(long, default_value = "drive")]
    pub run: String,
    /// Folder of the stages' programs; default: this program's folder.
    #[arg(long, hide = true)]
    pub stages: Option<PathBuf>,
}

/// The rule that the ego drives by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum DriveRule {
    /// Never drives on.
    #[value(alias = "underconfident")]
    AlwaysHalt,
    /// Never stops.
    #[value(alias = "overconfident")]
    AlwaysAdvance,
    /// The paper's rule: halts where the samples disagree.
    Paper,
    /// Halts where it is while the hazard is too probable.
    Calibrated,
    /// The same threshold; assumes that somebody comes: creeps to the place where others drive.
    #[value(alias = "phantom-car")]
    Phantom,
    /// The same threshold; stops ahead of that place, then creeps.
    Peek,
    /// The same threshold; drives on while a look from further on shows more.
    Look,
    /// A planner that knows the truth.
    Oracle,
}

impl DriveRule {
    /// The controller's rule and approach. The oracle's controller decides too, and is not asked.
    fn settings(self) -> (Rule, Approach) {
        match self {
            Self::AlwaysHalt => (Rule::Underconfident, Approach::Stop),
            Self::AlwaysAdvance => (Rule::Overconfident, Approach::Stop),
            Self::Paper => (Rule::Paper, Approach::Stop),
            Self::Calibrated | Self::Oracle => (Rule::Calibrated, Approach::Stop),
            Self::Phantom => (Rule::Calibrated, Approach::Phantom),
            Self::Peek => (Rule::Calibrated, Approach::Peek),
            Self::Look => (Rule::Calibrated, Approach::Look),
        }
    }
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (1.0..=100.0).contains(&value) => Ok(value),
        _ => Err("it must be a number from 1 to 100".to_owned()),
    }
}

/// Drives all episodes, prints their figures and writes them.
pub fn run(args: &DriveArgs) -> anyhow::Result<ExitCode> {
    args.json.as_deref().map_or(Ok(()), check_writable)?;
    args.decisions.as_deref().map_or(Ok(()), check_writable)?;
    let file = find_scenario(&args.scenario)?;
    check_distinct([file.as_path()], args.json.as_deref().into_iter().chain(args.decisions.as_deref()))?;
    let drives = ClosedLoop::new(Scenario::load(&file)?, args.route.as_deref())?;
    let manifest = Manifest::load(&args.checkpoint)?;
    let scenario = drives.scenario();
    manifest.check_scenario(&args.checkpoint, &ScenarioIdentity::of(scenario.info(), scenario.cameras().len()))?;
    let folder = tempfile::tempdir().context("cannot create a temporary folder")?;
    let graph_file = folder.path().join("drive.toml");
    let graph = graph_text(args, &file, &drives)?;
    std::fs::write(&graph_file, graph).with_context(|| format!("cannot write {}", graph_file.display()))?;
    let graph = GraphConfig::load_with(&graph_file, &args.set)?;
    ensure!(
        graph.camera.source == CameraSource::FreeDrives,
        "`camera.source` cannot be set: the world is the camera of a drive"
    );

    let terminal = Arc::new(Terminal::new());
    let results = Arc::new(Mutex::new(Vec::new()));
    let occupancy = Arc::new(Mutex::new(OccupancyCheck::new(drives.scenario().info().step_s)));
    let (identity, route) = (drives.scenario().info().name.clone(), drives.config().name.clone());
    let world = World {
        episodes: args.first..args.first + args.episodes,
        seed: args.seed,
        actors: args.actors,
        frame_rate_hz: args.frame_rate_hz,
        is_real_time: args.real_time,
        horizon: graph.run.horizon,
        is_oracle: args.rule == DriveRule::Oracle,
        noise: graph.camera.noise,
        results: results.clone(),
        occupancy: occupancy.clone(),
        terminal: terminal.clone(),
        drives,
    };
    let launch = LaunchArgs {
        graph: graph_file,
        checkpoint: Some(args.checkpoint.clone()),
        set: args.set.clone(),
        run: Some(args.run.clone()),
        stages: args.stages.clone(),
        decisions: args.decisions.clone(),
        ..LaunchArgs::default()
    };
    let run = Box::new(move |run: &_, stop: &_| world.run(run, stop));
    let feed = Feed { without: [Stage::Camera].into(), is_quiet: true, run };
    let (ended, outcome) = run_graph(&launch, Some(feed), &terminal)?;
    let results = std::mem::take(&mut *results.lock().unwrap_or_else(std::sync::PoisonError::into_inner));
    let frames = outcome.records.frames.values();
    let latencies_ns: Vec<u64> = frames.filter(|f| f.action.is_some()).map(|f| f.latency_ns).collect();
    let figures = DriveFigures::of(&results, &latencies_ns);
    terminal.line(&figures.to_string());
    if let Some(path) = &args.json {
        let rule = clap::ValueEnum::to_possible_value(&args.rule);
        let report = DriveReport {
            figures,
            scenario: identity,
            route,
            rule: rule.map(|value| value.get_name().to_owned()),
            seed: args.seed,
            actors: args.actors,
            frame_rate_hz: args.frame_rate_hz,
            real_time: args.real_time,
            interrupted: ended == Ended::Interrupted,
            origin: outcome.origin,
            occupancy: occupancy.lock().unwrap_or_else(std::sync::PoisonError::into_inner).figures(),
            drives: results,
        };
        let text = serde_json::to_string_pretty(&report)? + "\n";
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
        terminal.line(&format!("JSON: {}", path.display()));
    }
    if args.learn_occupancy && ended != Ended::Interrupted {
        save_rates(&occupancy.lock().unwrap_or_else(std::sync::PoisonError::into_inner), &args.checkpoint)?;
        terminal.line(&format!("rates of the occupancy grid: written into {}", args.checkpoint.display()));
    }
    terminal.check()?;
    Ok(ExitCode::SUCCESS)
}

/// Writes the rates of the occupancy grid into the checkpoint.
fn save_rates(check: &OccupancyCheck, checkpoint: &Path) -> anyhow::Result<()> {
    let old = CheckpointPlanning::load(checkpoint)?;
    Ok(CheckpointPlanning { occupancy: Some(check.rates(old.occupancy)?), ..old }.save(checkpoint)?)
}

/// Returns the graph file of a drive.
fn graph_text(args: &DriveArgs, scenario: &Path, drives: &ClosedLoop) -> anyhow::Result<String> {
    let absolute = |path: &Path| std::path::absolute(path).map(|path| path.display().to_string());
    let (rule, approach) = args.rule.settings();
    let step_frames = drives.scenario().info().step_s.map_or(1.0, |step_s| (step_s * args.frame_rate_hz).round());
    let mut graph = toml::Table::try_from(json!({
        "run": {
            "name": args.run,
            "seed": args.seed,
            // Not read: the world renders its images.
            "dataset": "data",
            "scenario": absolute(&scenario.with_extension(""))?,
            "checkpoint": absolute(&args.checkpoint)?,
            "frame_rate_hz": args.frame_rate_hz,
        },
        "camera": { "source": "free-drives", "frames_per_timestamp": step_frames.clamp(1.0, 1000.0) as u32 },
        "controller": {
            "rule": rule,
            "approach": approach,
            "advance_mps": drives.config().speed_mps,
            "others_mps": drives.config().actor_speed_mps[1],
        },
        "launcher": { "keep_frames": 10_000_000 },
    }))?;
    if !args.real_time
        && let Some(controller) = graph.get_mut("controller").and_then(toml::Value::as_table_mut)
    {
        controller.insert("deadline_ms".to_owned(), (PATIENT_MS as i64).into());
    }
    Ok(toml::to_string(&graph)?)
}
