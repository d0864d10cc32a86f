//! The networks in tch and their weights: encoder, pose-conditional decoder, mixture density network.
//!
//! The crate reads and writes weights, also those that others published (feature `import`). It holds no training loop, no
//! process and no topic.
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
