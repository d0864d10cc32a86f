//! The learned models in tch, and their weights.
//!
//! What lives here: the encoder (backbone and head), the pose-conditional decoder, the mixture density network, and how
//! weights lie on disk. What never does: training loops, processes, topics.
//!
//! Tensors are `f32`, images `[N, 3, H, W]` in 0..=1 unless said otherwise.

pub mod adam;
pub mod allocator;
pub mod backbone;
pub mod borrow;
pub mod decoder;
pub mod device;
pub mod encoder;
pub mod mixture;
pub mod stored;
pub mod weights;

/// What goes wrong with models and their files.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// Which file.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is not what it must be.
    #[error("{path}: {what}")]
    Format {
        /// Which file.
        path: std::path::PathBuf,
        /// What is wrong, and what to do.
        what: String,
    },
    /// Tensors that the model needs are missing, unknown or of another shape.
    #[error("the weights do not fit the model: {0}")]
    Mismatch(String),
    /// A setting is out of its range.
    #[error("`{key}` = {value}: {allowed}")]
    Setting {
        /// Which setting.
        key: &'static str,
        /// What it was.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}
