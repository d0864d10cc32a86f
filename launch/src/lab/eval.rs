//! Options of `carff eval`.

use std::path::PathBuf;

/// Options of `carff eval`.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// Folder of the checkpoint.
    pub checkpoint: PathBuf,
    /// Dataset of the evaluation, instead of the training dataset.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Compute only this table; may be given several times.
    #[arg(long, value_enum, value_name = "TABLE")]
    pub only: Vec<TableName>,
    /// Device of the encoder: `auto`, `cpu` or `cuda:N`.
    #[arg(long, default_value = "auto")]
    pub device: String,
    /// Folder of the training run, for its curves. Default: runs/NAME or the checkpoint's parent, where they have
    /// metrics.
    #[arg(long)]
    pub run_dir: Option<PathBuf>,
    /// Threads that render and probe.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: u16,
    /// Seed of sensor noise, draws, folds and free drives.
    #[arg(long, default_value_t = 2)]
    pub seed: u64,
    /// Number of free drives for planning, for the bound and for the memory, half of them with a hazard. They need the scenario file
    /// of the dataset.
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u32).range(0..=100_000))]
    pub free_drives: u32,
    /// Number of free poses for the trials, each with one image of each branch. They need the scenario file of the
    /// dataset.
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u32).range(0..=100_000))]
    pub free_poses: u32,
    /// Folder for results.json, README.md and images; files of an earlier evaluation are overwritten.
    #[arg(long)]
    pub out: PathBuf,
}

/// A table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum TableName {
    /// PSNR matrices from above, and novel views.
    Psnr,
    /// Decoder, support vector machine, state accuracy.
    Encoder,
    /// Accuracy and recall against the number of samples.
    Recall,
    /// Every decision rule, and the reliability of the hazard probability.
    Planning,
    /// Six kinds of trial, with baselines on the same images.
    Trials,
    /// Hazard probability and decisions of horizons 1, 2, 4 and 8.
    Horizon,
    /// Unknown objects, other places, corrupted images, and the bound.
    Robustness,
    /// Density probing and segmentation of rendered views, on the same samples.
    Localisation,
    /// The belief with and without memory, on drives whose camera pans.
    Memory,
    /// Place and speed of vehicles on the others' lane, at any place.
    Vehicles,
    /// Frequency of each outcome where several are open.
    Frequencies,
    /// t-SNE, reconstructions, curves, beliefs, density.
    Images,
}
