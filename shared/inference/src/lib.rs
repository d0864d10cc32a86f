//! Encoder and mixture density network on the decision path, without libtorch.
//!
//! The encoder is an ONNX graph built from a checkpoint's weights, and ONNX Runtime computes it. The mixture density
//! network is native code. `carff_networks` holds the same networks in tch, for training and as the reference.
//!
//! ONNX Runtime is a shared library that is loaded at run time: see [`library`].
//!
//! ```
//! use carff_checkpoint::Manifest;
//! use carff_inference::MixtureNet;
//! # let dir = std::path::Path::new("../../configs/checkpoints/approaching-intersection");
//! let manifest = Manifest::load(dir)?;
//! let forecaster = MixtureNet::load(dir, &manifest)?;
//! let mixture = forecaster.forecast(&manifest.states[0]);
//! assert!((mixture.weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
//! # Ok::<(), carff_checkpoint::CheckpointError>(())
//! ```

mod encoder;
pub mod library;
mod mixture;
mod onnx;
mod weights;

pub use encoder::Encoder;
pub use mixture::MixtureNet;
pub use onnx::{FILE, encoder_onnx, save_encoder_onnx};

use std::path::PathBuf;

/// Reason why a network cannot be computed.
#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    /// The library cannot be loaded.
    #[error("ONNX Runtime: {what}; fetch it with `make onnxruntime`, or set `stages.encoder.backend = \"tch\"`")]
    Library {
        /// Description of the error, with the library's path.
        what: String,
    },
    /// A weights file cannot be read, or does not fit.
    #[error("{path}: {what}; copy the checkpoint again, or make it with `carff train`")]
    Weights {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        what: String,
    },
    /// A file could not be written.
    #[error("{path}: {source}; check that its folder is writable and has free space")]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The encoder's settings are out of range.
    #[error("`{key}` = {value}: {allowed}")]
    Setting {
        /// Name of the setting.
        key: &'static str,
        /// Value of the setting.
        value: i64,
        /// Allowed values.
        allowed: &'static str,
    },
    /// ONNX Runtime refuses the model or an image.
    #[error("ONNX Runtime: {0}; `stages.encoder.backend = \"tch\"` computes the same encoder with libtorch")]
    Runtime(String),
    /// The image has no pixels.
    #[error("an image of shape {0:?} cannot be encoded: it needs rows, columns and three channels")]
    Image(Vec<usize>),
}

impl<T> From<ort::Error<T>> for InferenceError {
    fn from(error: ort::Error<T>) -> Self {
        Self::Runtime(error.to_string())
    }
}
