//! `carff checkpoint`: trained models for other programs, and the limits of what a checkpoint knows.

use anyhow::Context;
use carff_base::files::check_writable;
use carff_checkpoint::Manifest;
use carff_scenes::Scenario;
use carff_training::{KnownInput, calibrate_known};
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

/// Runs the command.
pub fn run(command: &CheckpointCommand) -> anyhow::Result<ExitCode> {
    match command {
        CheckpointCommand::Onnx(args) => onnx(args)?,
        CheckpointCommand::Known(args) => known(args)?,
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
    println!("limit {:.2} on {} images, {} areas", known.limit, known.images, known.lanes.areas.len());
    Ok(())
}
