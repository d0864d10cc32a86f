//! The learned models in tch, and their weights.
//!
//! This crate contains the encoder (backbone and head), the pose-conditional decoder, the mixture density network, and
//! the storage of weights. It does not contain training loops, processes or topics.
//!
//! Tensors are `f32`, and images are `[N, 3, H, W]` in 0..=1, unless stated otherwise.

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

/// Errors of models and their files.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// Path of the file.
        path: std::path::PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file's contents are not valid.
    #[error("{path}: {what}")]
    Format {
        /// Path of the file.
        path: std::path::PathBuf,
        /// Description of the error, with a remedy.
        what: String,
    },
    /// Tensors that the model needs are missing, unknown or of another shape.
    #[error("the weights do not fit the model: {0}")]
    Mismatch(String),
    /// A setting is out of range.
    #[error("`{key}` = {value}: {allowed}")]
    Setting {
        /// Name of the setting.
        key: &'static str,
        /// Value of the setting.
        value: String,
        /// Allowed values.
        allowed: &'static str,
    },
    /// libtorch reported an error.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}
