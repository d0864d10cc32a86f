//! `carff checkpoint`: trained models for other programs.

use carff_base::files::check_writable;
use carff_checkpoint::Manifest;
use std::path::PathBuf;
use std::process::ExitCode;

/// Commands for checkpoints.
#[derive(Debug, clap::Subcommand)]
pub enum CheckpointCommand {
    /// Write the encoder as an ONNX file: `image` (bytes: height, width, 3) to `mean` and `log_variance` (1, 8).
    #[command(after_help = "Example: the shipped encoder
  carff checkpoint onnx configs/checkpoints/approaching-intersection --out encoder.onnx")]
    Onnx(OnnxArgs),
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

/// Runs the command.
pub fn run(command: &CheckpointCommand) -> anyhow::Result<ExitCode> {
    let CheckpointCommand::Onnx(args) = command;
    let out = args.out.clone().unwrap_or_else(|| args.checkpoint.join(carff_inference::FILE));
    check_writable(&out)?;
    let manifest = Manifest::load(&args.checkpoint)?;
    carff_inference::save_encoder_onnx(&args.checkpoint, &manifest, &out)?;
    println!("encoder: {}", out.display());
    Ok(ExitCode::SUCCESS)
}
