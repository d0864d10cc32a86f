//! Options of the benchmarks against tensor operations. `carff-lab` runs them.

use crate::OutputArgs;
use std::path::PathBuf;

/// Benchmarks against tensor operations, which need libtorch.
#[derive(Debug, clap::Subcommand)]
pub enum TensorBench {
    /// Compare the field's kernels with the same model in tensor operations and with the machine's limits.
    #[command(after_help = "Example: on one thread, compared with an earlier run
  carff bench field --threads 1 --baseline docs/performance.json")]
    Field(FieldArgs),
    /// Measure encoder and forecaster, one frame at a time.
    #[command(after_help = "Example: only the shipped networks
  carff bench encoder --no-vit --json reports/performance.json")]
    Encoder(EncoderArgs),
}

impl TensorBench {
    /// Output of the figures.
    pub fn output(&self) -> &OutputArgs {
        match self {
            Self::Field(args) => &args.output,
            Self::Encoder(args) => &args.output,
        }
    }
}

/// Compare the field's kernels with the same model in tensor operations and with the machine's limits.
#[derive(Clone, Debug, clap::Args)]
pub struct FieldArgs {
    /// Folder of the checkpoint whose field is measured.
    #[arg(long, default_value = "configs/checkpoints/approaching-intersection")]
    pub checkpoint: PathBuf,
    /// Number of threads. Default: all cores.
    #[arg(long)]
    pub threads: Option<usize>,
    /// Side of the bird's-eye view, pixels.
    #[arg(long, default_value_t = 128)]
    pub side_px: u32,
    /// Measure fewer rounds.
    #[arg(long)]
    pub quick: bool,
    /// Output of the figures.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// Measure encoder and forecaster, one frame at a time.
#[derive(Clone, Debug, clap::Args)]
pub struct EncoderArgs {
    /// Checkpoint folder.
    #[arg(long, default_value = "configs/checkpoints/approaching-intersection")]
    pub checkpoint: PathBuf,
    /// Leave out the vision transformer, which takes 1.3 GB and seconds per frame.
    #[arg(long)]
    pub no_vit: bool,
    /// Measure fewer rounds.
    #[arg(long)]
    pub quick: bool,
    /// Output of the figures.
    #[command(flatten)]
    pub output: OutputArgs,
}
