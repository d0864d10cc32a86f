//! The encoder in ONNX Runtime.

use crate::{InferenceError, library, onnx};
use carff_checkpoint::Manifest;
use carff_messages::{Gaussian, LATENT_DIM};
use ndarray::ArrayView3;
use ort::{
    session::{Session, builder::GraphOptimizationLevel},
    value::TensorRef,
};
use std::path::Path;

/// The encoder of a checkpoint: from one image to a Gaussian over the scene latent.
///
/// Equal images give equal bits in every run on one machine, with any number of threads.
#[derive(Debug)]
pub struct Encoder {
    session: Session,
}

impl Encoder {
    /// Reads the encoder of a checkpoint, to run on `threads` threads.
    pub fn load(dir: &Path, manifest: &Manifest, threads: usize) -> Result<Self, InferenceError> {
        let model = onnx::encoder_onnx(dir, manifest)?;
        let session = Session::builder(&library::load()?)?
            .with_optimization_level(GraphOptimizationLevel::All)?
            .with_intra_threads(threads.max(1))?
            .with_deterministic_compute(true)?
            // Threads wait by spinning during an image, and sleep until the next one.
            .with_config_entry("session.force_spinning_stop", "1")?
            .commit_from_memory(&model)?;
        Ok(Self { session })
    }

    /// Returns the posterior of an image (height, width, channel). Bytes that lie one after the other are read in
    /// place.
    pub fn encode(&mut self, image: ArrayView3<'_, u8>) -> Result<Gaussian, InferenceError> {
        if image.is_empty() || image.shape()[2] != 3 {
            return Err(InferenceError::Image(image.shape().to_vec()));
        }
        let rows = image.as_standard_layout();
        let bytes = rows.as_slice().ok_or_else(|| InferenceError::Image(image.shape().to_vec()))?;
        let input = TensorRef::from_array_view((image.shape(), bytes))?;
        let outputs = self.session.run(ort::inputs![input])?;
        let row = |i: usize| -> Result<[f32; LATENT_DIM], InferenceError> {
            let (_, values) = outputs[i].try_extract_tensor::<f32>()?;
            values.try_into().map_err(|_| InferenceError::Runtime(format!("{} values in place of 8", values.len())))
        };
        Ok(Gaussian { mean: row(0)?, log_variance: row(1)? })
    }
}
