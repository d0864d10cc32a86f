//! Commands of `carff-lab`, the program that computes with libtorch: their options, and its start.

mod ablate;
mod backbone;
mod checkpoint;
mod eval;
mod train;

pub use ablate::AblateArgs;
pub use backbone::{BackboneCommand, ImportArgs};
pub use checkpoint::{BoundArgs, CheckpointCommand, KnownArgs, MemoryArgs, OnnxArgs};
pub use eval::{EvalArgs, TableName};
pub use train::{PhaseName, TrainArgs};

use std::process::ExitCode;

/// The program, in the same folder.
pub const PROGRAM: &str = "carff-lab";

/// Commands that compute with libtorch.
#[derive(Debug, clap::Subcommand)]
pub enum LabCommand {
    /// Train a scenario's models; continues an earlier run that stopped.
    #[command(after_help = "Example: train the shipped models into your own folder
  carff train configs/training/approaching-intersection.toml --out runs/mine/checkpoint --run-dir runs/mine")]
    Train(TrainArgs),
    /// Evaluate a checkpoint: every table and image, as JSON and one page.
    #[command(after_help = "Example: only the planning table
  carff eval configs/checkpoints/approaching-intersection --only planning --out reports/results")]
    Eval(EvalArgs),
    /// Train the encoder with one change at a time, and tabulate; continues an earlier run that stopped.
    #[command(after_help = "Example: two of the variants
  carff ablate configs/training/approaching-intersection-ablation.toml --only full --only stem --out reports/ablation")]
    Ablate(AblateArgs),
    /// Convert published weights of an image backbone for training.
    #[command(
        subcommand,
        after_help = "Example: a vision transformer, as timm and Hugging Face publish them
  carff backbone import model.safetensors --out runs/vit.safetensors"
    )]
    Backbone(BackboneCommand),
    /// Export trained models for other programs.
    #[command(
        subcommand,
        after_help = "Example: the encoder as an ONNX file
  carff checkpoint onnx configs/checkpoints/approaching-intersection --out encoder.onnx"
    )]
    Checkpoint(CheckpointCommand),
}

/// Replaces this process with `carff-lab`, which gets the same arguments; returns if that fails.
pub fn start() -> anyhow::Result<ExitCode> {
    carff::become_program(PROGRAM, &std::env::args_os().skip(1).collect::<Vec<_>>())
}
