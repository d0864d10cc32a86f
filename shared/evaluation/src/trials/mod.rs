//! Trials: the models on images with known answers.

pub mod birds_eye;
pub mod hypotheses;
pub mod planning;
pub mod samples;

use carff_belief::Probe;
use carff_checkpoint::{CheckpointError, Manifest};
use carff_models::{encoder::Encoder, mixture::MixtureNet};
use std::path::Path;

/// Models of the decision path.
pub struct Models {
    /// Image to posterior.
    pub encoder: Encoder,
    /// Posterior to mixture.
    pub mixture: MixtureNet,
    /// Hypothesis to state.
    pub probe: Probe,
    /// Description of the checkpoint.
    pub manifest: Manifest,
}

impl Models {
    /// Reads a checkpoint.
    pub fn load(dir: &Path) -> Result<Self, CheckpointError> {
        let manifest = Manifest::load(dir)?;
        Ok(Self {
            encoder: carff_models::stored::load_encoder(dir, &manifest)?,
            mixture: carff_models::stored::load_mixture(dir, &manifest)?,
            probe: Probe::load(dir, &manifest)?,
            manifest,
        })
    }
}
