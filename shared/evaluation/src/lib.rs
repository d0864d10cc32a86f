//! How well a trained scenario does: accuracy, pictures, planning.
//!
//! What lives here: tables over views, computed with the same library functions that the stages run. What never does:
//! training, processes. Every table says its trials; poses that were never trained on stand apart.

mod birds_eye;
pub mod draws;
pub mod hypotheses;
mod pairs;
mod planning;
mod samples;
pub mod svm;

pub use birds_eye::{BirdsEye, birds_eye};
pub use pairs::{PairMeans, pair_means};
pub use planning::{Count, PlanningTable, SAMPLE_COUNTS, Trial, TrialOutcome, count, planning_table, trial, trials};
pub use samples::{Input, SampleAccuracy, sample_accuracy};

use carff_checkpoint::{CheckpointError, FieldProbe, Manifest};
use carff_models::{encoder::Encoder, mixture::MixtureNet};
use std::path::Path;

/// All that the decision path runs on.
pub struct Models {
    /// Picture to posterior.
    pub encoder: Encoder,
    /// Posterior to mixture.
    pub mixture: MixtureNet,
    /// Hypothesis to state.
    pub probe: FieldProbe,
    /// What was trained, and how.
    pub manifest: Manifest,
}

impl Models {
    /// Reads a checkpoint.
    pub fn load(dir: &Path) -> Result<Self, CheckpointError> {
        let manifest = Manifest::load(dir)?;
        Ok(Self {
            encoder: carff_models::stored::load_encoder(dir, &manifest)?,
            mixture: carff_models::stored::load_mixture(dir, &manifest)?,
            probe: carff_checkpoint::load_field_probe(dir, &manifest)?,
            manifest,
        })
    }
}
