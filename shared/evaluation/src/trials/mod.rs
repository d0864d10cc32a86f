//! Trials with known answers: images, baselines and watches. `carff_trials` computes with them.

pub mod baselines;
pub mod lane_images;
pub mod views;
pub mod watches;

use carff_checkpoint::{CheckpointError, FieldProbe, Manifest};
use carff_networks::{encoder::Encoder, mixture::MixtureNet};
use std::path::Path;

/// Models of the decision path.
pub struct Models {
    /// Image to posterior.
    pub encoder: Encoder,
    /// Posterior to mixture.
    pub mixture: MixtureNet,
    /// Hypothesis to state.
    pub probe: FieldProbe,
    /// Description of the checkpoint.
    pub manifest: Manifest,
}

impl Models {
    /// Reads a checkpoint.
    pub fn load(dir: &Path) -> Result<Self, CheckpointError> {
        let manifest = Manifest::load(dir)?;
        Ok(Self {
            encoder: carff_networks::stored::load_encoder(dir, &manifest)?,
            mixture: carff_networks::stored::load_mixture(dir, &manifest)?,
            probe: carff_checkpoint::load_field_probe(dir, &manifest)?,
            manifest,
        })
    }
}
