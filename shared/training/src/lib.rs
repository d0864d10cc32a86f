//! How the three models are trained.
//!
//! What lives here: the training file, the posed pictures as tensors, the loops of the pose-conditional VAE, the field
//! and the mixture density network, their progress, and saving and resuming. What never does: the models themselves.

pub mod accuracy;
pub mod config;
pub mod curves;
pub mod features;
pub mod field;
pub mod free;
pub mod mixture;
pub mod pictures;
pub mod pipeline;
pub mod places;
pub mod run;
pub mod vae;

/// Why a training cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The data set cannot be used.
    #[error(transparent)]
    Dataset(#[from] carff_dataset::DatasetError),
    /// A model or a weights file cannot be used.
    #[error(transparent)]
    Model(#[from] carff_models::ModelError),
    /// The field cannot be made or trained so.
    #[error(transparent)]
    Field(#[from] carff_field::FieldError),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] carff_checkpoint::CheckpointError),
    /// The scenario cannot be probed.
    #[error(transparent)]
    Probing(#[from] carff_decision::ProbingError),
    /// The curves cannot be drawn.
    #[error(transparent)]
    Plot(#[from] carff_plots::PlotError),
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
    /// A file could not be read or written.
    #[error("{path}: {source}{}", carff_nearest::beside(path))]
    File {
        /// Which file.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The training file or a saved state is wrong.
    #[error("{path}: {what}")]
    Format {
        /// Which file.
        path: std::path::PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The data set lacks something that this training needs.
    #[error("the data set cannot train this model: {0}")]
    Unfit(String),
    /// The user asked to stop; the state is saved.
    #[error("stopped; the same command goes on from the saved state")]
    Stopped,
}
