//! Errors of training.

/// Reason why a training failed.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The dataset cannot be used.
    #[error(transparent)]
    Dataset(#[from] carff_dataset::DatasetError),
    /// A model or a weights file cannot be used.
    #[error(transparent)]
    Model(#[from] carff_networks::ModelError),
    /// The field cannot be made or trained with these settings.
    #[error(transparent)]
    Field(#[from] carff_field::FieldError),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] carff_checkpoint::CheckpointError),
    /// The scenario cannot be probed.
    #[error(transparent)]
    Probing(#[from] carff_decision::ProbingError),
    /// The models cannot be evaluated.
    #[error(transparent)]
    Evaluation(#[from] carff_evaluation::EvaluationError),
    /// The encoder cannot be exported.
    #[error(transparent)]
    Inference(#[from] carff_inference::InferenceError),
    /// The curves cannot be drawn.
    #[error(transparent)]
    Plot(#[from] carff_plots::PlotError),
    /// libtorch refused an operation.
    #[error("libtorch refused an operation: {0}; if a device has too little memory, pass `--device cpu`")]
    Torch(#[from] tch::TchError),
    /// A file could not be read or written.
    #[error(
        "{path}: {source}{}; check that the path is right, who may read and write it, and the free space",
        carff_base::names::beside(path)
    )]
    File {
        /// The file.
        path: std::path::PathBuf,
        /// Cause given by the system.
        source: std::io::Error,
    },
    /// The training file or a saved state is wrong.
    #[error("{path}: {what}")]
    Format {
        /// The file.
        path: std::path::PathBuf,
        /// The problem.
        what: String,
    },
    /// The scenario file cannot be read, or has no room for a camera.
    #[error(transparent)]
    Scenario(#[from] carff_scenes::ScenarioError),
    /// The checkpoint's thresholds cannot be read or written.
    #[error(transparent)]
    Planning(#[from] carff_checkpoint::CheckpointPlanningError),
    /// The checkpoint's limits of known images cannot be read or written.
    #[error(transparent)]
    Known(#[from] carff_unknown::KnownError),
    /// The checkpoint or the number of drives does not suffice for the request.
    #[error("{0}")]
    Insufficient(String),
    /// The dataset lacks something that this training needs.
    #[error("the dataset cannot train this model: {0}")]
    Unfit(String),
    /// A phase that the requested one continues is not finished.
    #[error("training phase {phase} has {done} of {total} steps: finish it with `carff train --phase {phase}`")]
    Unfinished {
        /// Name of the phase.
        phase: String,
        /// Steps done.
        done: usize,
        /// Number of steps.
        total: usize,
    },
    /// The user asked to stop; the state is saved.
    #[error("stopped; the same command resumes from the saved state")]
    Stopped,
}
