//! `carff checkpoint`: trained models for other programs, and the limits of what a checkpoint knows.

use crate::train::Display;
use anyhow::Context;
use carff_base::files::check_writable;
use carff_base::statistics::percentile_of_sorted;
use carff_checkpoint::Manifest;
use carff_scenes::Scenario;
use carff_training::{BoundInput, KnownInput, MemoryInput, bound_threshold, calibrate_known, learn_memory};
use std::path::PathBuf;
use std::process::ExitCode;

/// Commands for checkpoints.
#[derive(Debug, clap::Subcommand)]
pub enum CheckpointCommand {
    /// Write the encoder as an ONNX file: `image` (bytes: height, width, 3) to `mean` and `log_variance` (1, 8).
    #[command(after_help = "Example: the shipped encoder
  carff checkpoint onnx configs/checkpoints/approaching-intersection --out encoder.onnx")]
    Onnx(OnnxArgs),
    /// Calibrate what the checkpoint takes as known, and write `known.json` into it.
    #[command(after_help = "Example: the shipped checkpoint, on free poses of its scenario
  carff checkpoint known configs/checkpoints/toy --dataset data/toy --scenario configs/scenarios/toy.toml")]
    Known(KnownArgs),
    /// Choose the calibrated rule's threshold so that at most a share of the drives with a hazard is answered with
    /// `advance`, and write it into `planning.json`. Run it after `carff checkpoint known`.
    #[command(after_help = "Example: at most 1 % of the drives, with 95 % confidence
  carff checkpoint bound configs/checkpoints/toy --scenario configs/scenarios/toy.toml")]
    Bound(BoundArgs),
    /// Learn the memory of the belief on drives, and write it into `planning.json`.
    #[command(after_help = "Example: on 200 drives
  carff checkpoint memory configs/checkpoints/toy --scenario configs/scenarios/toy.toml")]
    Memory(MemoryArgs),
}

/// Input and output of an export.
#[derive(Debug, clap::Args)]
pub struct OnnxArgs {
    /// Checkpoint folder.
    checkpoint: PathBuf,
    /// The ONNX file to write. Default: `encoder.onnx` in the checkpoint, where training writes it.
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Input of a calibration.
#[derive(Debug, clap::Args)]
pub struct KnownArgs {
    /// Checkpoint folder.
    checkpoint: PathBuf,
    /// Dataset folder of the checkpoint.
    #[arg(long)]
    dataset: PathBuf,
    /// Scenario file of the dataset: its free poses are used. Default: the dataset's trained poses.
    #[arg(long)]
    scenario: Option<PathBuf>,
    /// Free poses, each with an image of each branch.
    #[arg(long, default_value_t = 300)]
    free_poses: usize,
    /// Threads that render.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// Input of a bound.
#[derive(Debug, clap::Args)]
pub struct BoundArgs {
    /// Checkpoint folder.
    checkpoint: PathBuf,
    /// Scenario file of the checkpoint: its free drives are used.
    #[arg(long)]
    scenario: PathBuf,
    /// Free drives; half of them have the hazard.
    #[arg(long, default_value_t = 2000)]
    drives: usize,
    /// Largest share of advances where the hazard is there, 0 to 1.
    #[arg(long, default_value_t = 0.01, value_parser = share)]
    level: f64,
    /// Probability with which the bound holds, 0 to 1.
    #[arg(long, default_value_t = 0.95, value_parser = share)]
    confidence: f64,
    /// Bound the threshold with the memory, over all frames before the last time step.
    #[arg(long)]
    memory: bool,
    /// Threads that render.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

/// Input of the learning of the memory.
#[derive(Debug, clap::Args)]
pub struct MemoryArgs {
    /// Checkpoint folder.
    checkpoint: PathBuf,
    /// Scenario file of the checkpoint: its drives are used.
    #[arg(long)]
    scenario: PathBuf,
    /// Drives; branches take turns.
    #[arg(long, default_value_t = 200)]
    drives: usize,
}

fn share(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if value > 0.0 && value < 1.0 { Ok(value) } else { Err("must be above 0 and below 1".to_owned()) }
}

/// Runs the command.
pub fn run(command: &CheckpointCommand) -> anyhow::Result<ExitCode> {
    match command {
        CheckpointCommand::Onnx(args) => onnx(args)?,
        CheckpointCommand::Known(args) => known(args)?,
        CheckpointCommand::Bound(args) => bound(args)?,
        CheckpointCommand::Memory(args) => memory(args)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn onnx(args: &OnnxArgs) -> anyhow::Result<()> {
    let out = args.out.clone().unwrap_or_else(|| args.checkpoint.join(carff_inference::FILE));
    check_writable(&out)?;
    let manifest = Manifest::load(&args.checkpoint)?;
    carff_inference::save_encoder_onnx(&args.checkpoint, &manifest, &out)?;
    println!("encoder: {}", out.display());
    Ok(())
}

fn known(args: &KnownArgs) -> anyhow::Result<()> {
    let scenario = args.scenario.as_deref().map(Scenario::load).transpose()?;
    let input = KnownInput {
        checkpoint: &args.checkpoint,
        dataset: &args.dataset,
        scenario: scenario.as_ref(),
        free_poses: args.free_poses,
        threads: args.threads,
    };
    let known = calibrate_known(input, &|_| {}).context("cannot calibrate what the checkpoint knows")?;
    for (side, limits) in [("clear", &known.clear), ("hazard", &known.hazard)] {
        println!("{side}: limit {:.2} on {} images", limits.limit, limits.images);
    }
    println!("this place: at least {:.2} of the view explained", known.least_explained);
    Ok(())
}

fn bound(args: &BoundArgs) -> anyhow::Result<()> {
    let scenario = Scenario::load(&args.scenario)?;
    let display = Display::default();
    let input = BoundInput {
        checkpoint: &args.checkpoint,
        scenario: &scenario,
        drives: args.drives,
        level: args.level,
        confidence: args.confidence,
        remembers: args.memory,
        threads: args.threads,
    };
    let chosen = bound_threshold(input, &|p| display.show(p)).context("cannot bound the threshold")?;
    display.finish();
    let of = |sorted: &[f64], share: f64| percentile_of_sorted(sorted, share).unwrap_or(f64::NAN);
    println!("threshold {:.4}", chosen.planning.threshold(args.memory));
    for (kind, sorted) in [("hazard", &chosen.hazard), ("clear", &chosen.clear)] {
        let [p1, p5, p50, p95, p99] = [0.01, 0.05, 0.5, 0.95, 0.99].map(|share| of(sorted, share));
        println!(
            "{kind}: {} drives, hazard or unknown at 1, 5, 50, 95, 99 %: {p1:.3} {p5:.3} {p50:.3} {p95:.3} {p99:.3}",
            sorted.len()
        );
    }
    Ok(())
}

fn memory(args: &MemoryArgs) -> anyhow::Result<()> {
    let scenario = Scenario::load(&args.scenario)?;
    let display = Display::default();
    let input = MemoryInput { checkpoint: &args.checkpoint, scenario: &scenario, drives: args.drives };
    let learned = learn_memory(input, &|p| display.show(p)).context("cannot learn the memory")?;
    display.finish();
    println!("share of repeated evidence {}, distrust {}", learned.settings.repeated_share, learned.settings.distrust);
    println!("log loss a frame {:.4}, without memory {:.4}", learned.log_loss, learned.without_memory);
    Ok(())
}
