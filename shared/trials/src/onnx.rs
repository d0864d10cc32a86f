//! The encoder in ONNX Runtime, for trials.

use crate::EvaluationError;
use carff_checkpoint::{Encodes, Manifest};
use carff_inference::{Encoder, InferenceError};
use carff_messages::Gaussian;
use ndarray::ArrayView3;
use std::cell::RefCell;
use std::path::Path;

/// The encoder of the stage, behind a shared reference.
pub struct OnnxEncoder {
    encoder: RefCell<Encoder>,
    failed: RefCell<Option<InferenceError>>,
}

impl OnnxEncoder {
    /// Reads the encoder of a checkpoint, to run on all cores.
    pub fn load(dir: &Path, manifest: &Manifest) -> Result<Self, EvaluationError> {
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let encoder = Encoder::load(dir, manifest, threads)?;
        Ok(Self { encoder: RefCell::new(encoder), failed: RefCell::default() })
    }

    /// Returns the first error of the images since the encoder was read.
    pub fn finish(self) -> Result<(), EvaluationError> {
        self.failed.into_inner().map_or(Ok(()), |error| Err(error.into()))
    }
}

impl Encodes for OnnxEncoder {
    fn posterior_of(&self, image: ArrayView3<'_, u8>) -> Option<Gaussian> {
        let encoded = self.encoder.borrow_mut().encode(image);
        encoded.map_err(|error| self.failed.borrow_mut().get_or_insert(error).to_string()).ok()
    }
}
