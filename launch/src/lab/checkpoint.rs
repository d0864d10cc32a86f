//! Options of `carff checkpoint`.

use std::path::PathBuf;

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
    pub checkpoint: PathBuf,
    /// The ONNX file to write. Default: `encoder.onnx` in the checkpoint, where training writes it.
    #[arg(long)]
    pub out: Option<PathBuf>,
}

/// Input of a calibration.
#[derive(Debug, clap::Args)]
pub struct KnownArgs {
    /// Checkpoint folder.
    pub checkpoint: PathBuf,
    /// Dataset folder of the checkpoint.
    #[arg(long)]
    pub dataset: PathBuf,
    /// Scenario file of the dataset: its free poses are used. Default: the dataset's trained poses.
    #[arg(long)]
    pub scenario: Option<PathBuf>,
    /// Free poses, each with an image of each branch.
    #[arg(long, default_value_t = 300)]
    pub free_poses: usize,
    /// Threads that render.
    #[arg(long, default_value_t = 2)]
    pub threads: usize,
}

/// Input of a bound.
#[derive(Debug, clap::Args)]
pub struct BoundArgs {
    /// Checkpoint folder.
    pub checkpoint: PathBuf,
    /// Scenario file of the checkpoint: its free drives are used.
    #[arg(long)]
    pub scenario: PathBuf,
    /// Free drives; half of them have the hazard.
    #[arg(long, default_value_t = 2000)]
    pub drives: usize,
    /// Largest share of advances where the hazard is there, 0 to 1.
    #[arg(long, default_value_t = 0.01, value_parser = share)]
    pub level: f64,
    /// Probability with which the bound holds, 0 to 1.
    #[arg(long, default_value_t = 0.95, value_parser = share)]
    pub confidence: f64,
    /// Bound the threshold with the memory, over all frames before the last time step.
    #[arg(long)]
    pub memory: bool,
    /// Threads that render.
    #[arg(long, default_value_t = 2)]
    pub threads: usize,
}

/// Input of the learning of the memory.
#[derive(Debug, clap::Args)]
pub struct MemoryArgs {
    /// Checkpoint folder.
    pub checkpoint: PathBuf,
    /// Scenario file of the checkpoint: its drives are used.
    #[arg(long)]
    pub scenario: PathBuf,
    /// Drives; branches take turns.
    #[arg(long, default_value_t = 200)]
    pub drives: usize,
    /// Threads that render.
    #[arg(long, default_value_t = 2)]
    pub threads: usize,
}

fn share(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if value > 0.0 && value < 1.0 { Ok(value) } else { Err("must be above 0 and below 1".to_owned()) }
}
