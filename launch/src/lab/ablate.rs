//! Options of `carff ablate`.

use std::path::PathBuf;

/// Options of `carff ablate`.
#[derive(Debug, clap::Args)]
pub struct AblateArgs {
    /// The training file, for example configs/training/approaching-intersection-ablation.toml.
    pub config: PathBuf,
    /// Dataset to train on, instead of the training file's.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Train only these variants, by the name of their folder: full, stem, conv-net, unfrozen, transformer, no-pose,
    /// eight-poses, one-pose, own-pose, one-stage.
    #[arg(long)]
    pub only: Vec<String>,
    /// Number of trainings of each variant, with the training file's seed and the numbers after it.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub seeds: u64,
    /// Device of training and scoring: `auto`, `cpu` or `cuda:N`.
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// Folder for ablation.json, README.md, and a folder for each variant. The same command resumes a stopped run.
    #[arg(long)]
    pub out: PathBuf,
}
