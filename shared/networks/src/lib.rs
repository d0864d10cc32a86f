//! The networks in tch and their weights: encoder, pose-conditional decoder, mixture density network.
//!
//! The crate reads and writes weights, also those that others published (feature `import`). It holds no training loop,
//! no process and no topic.
//!
//! Tensors are `f32` and images `[N, 3, H, W]` in 0..=1, unless a function states otherwise.

pub mod adam;
pub mod allocator;
pub mod backbone;
pub mod borrow;
pub mod decoder;
pub mod device;
pub mod encoder;
pub mod mixture;
#[cfg(feature = "import")]
pub mod pretrained;
pub mod stored;
pub mod weights;

/// Errors of models and their files.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file could not be read or written.
    #[error("{path}: {source}; check that the path is right, who may read and write it, and the free space")]
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
    #[error(
        "the weights do not fit the model: {0}; use weights of this network, or the settings that they were trained \
         with"
    )]
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
    #[error("libtorch refused an operation: {0}; if a device has too little memory, pass `--device cpu`")]
    Torch(#[from] tch::TchError),
}
