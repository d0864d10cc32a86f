//! Errors of evaluation.

use std::path::PathBuf;

/// Reason why an evaluation failed.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// The checkpoint cannot be used.
    #[error(transparent)]
    Checkpoint(#[from] carff_checkpoint::CheckpointError),
    /// The planning settings of the checkpoint cannot be used.
    #[error(transparent)]
    Planning(#[from] carff_checkpoint::CheckpointPlanningError),
    /// The known states of the checkpoint cannot be read.
    #[error(transparent)]
    Known(#[from] carff_unknown::KnownError),
    /// The encoder cannot be computed.
    #[error(transparent)]
    Inference(#[from] carff_inference::InferenceError),
    /// The dataset cannot be read or written.
    #[error(transparent)]
    Dataset(#[from] carff_dataset::DatasetError),
    /// The dataset has no trials.
    #[error(transparent)]
    Drives(#[from] carff_dataset::drives::DrivesError),
    /// The scenario cannot be rendered.
    #[error(transparent)]
    Scenario(#[from] carff_scenes::ScenarioError),
    /// An image cannot be drawn.
    #[error(transparent)]
    Plot(#[from] carff_plots::PlotError),
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// Cause given by the system.
        source: std::io::Error,
    },
    /// A file has unexpected contents.
    #[error("{path}: {what}")]
    Format {
        /// The file.
        path: PathBuf,
        /// The problem.
        what: String,
    },
    /// The dataset lacks something that this evaluation needs.
    #[error("the dataset cannot be used: {0}")]
    Unfit(String),
}
