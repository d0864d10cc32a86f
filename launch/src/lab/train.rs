//! Options of `carff train`.

use std::path::PathBuf;

/// Options of `carff train`.
#[derive(Debug, clap::Args)]
pub struct TrainArgs {
    /// The training file, for example configs/training/approaching-intersection.toml.
    pub config: PathBuf,
    /// Dataset to train on, instead of the training file's.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Folder for the finished checkpoint, instead of the training file's.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Run only one training phase; the phases before it must be finished.
    #[arg(long, alias = "stage", value_enum)]
    pub phase: Option<PhaseName>,
    /// Device of the VAE and the mixture density network: `auto`, `cpu` or `cuda:N`. The field is trained on the CPU.
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// Folder for saved states, metrics and curves.
    #[arg(long)]
    pub run_dir: Option<PathBuf>,
    /// Replace a finished checkpoint, and remove saved states of another configuration.
    #[arg(long)]
    pub force: bool,
}

/// A training phase.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum PhaseName {
    /// The pose-conditional VAE.
    Vae,
    /// The latent-conditioned field.
    Nerf,
    /// The mixture density network.
    Mdn,
}
