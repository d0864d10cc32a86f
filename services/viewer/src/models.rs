//! A checkpoint's models, loaded once, as the stages load them.

use carff_checkpoint::{CheckpointError, FieldProbe, Manifest, load_field_probe, load_policy};
use carff_dataset::Image;
use carff_decision::Policy;
use carff_field::Field;
use carff_messages::{Gaussian, Rule};
use carff_models::{
    borrow,
    encoder::Encoder,
    mixture::MixtureNet,
    stored::{load_encoder, load_mixture},
};
use std::path::{Path, PathBuf};

/// What a checkpoint holds.
pub struct Models {
    /// Its folder.
    pub dir: PathBuf,
    /// What was trained, and how.
    pub manifest: Manifest,
    /// Hypothesis to state.
    pub probe: FieldProbe,
    /// Posterior to mixture, or why there is none.
    pub mixture: Result<MixtureNet, String>,
    /// The rule that decides: calibrated where a threshold was chosen, else the paper's.
    pub policy: Policy,
    /// What each known state is called: its branch and its step.
    pub state_names: Vec<String>,
    encoder: Encoder,
}

impl Models {
    /// Reads a checkpoint; the encoder and the forecaster will use so many threads.
    pub fn load(dir: &Path, threads: usize) -> Result<Self, CheckpointError> {
        carff_models::allocator::keep_large_blocks();
        carff_models::device::set_threads(threads);
        let manifest = Manifest::load(dir)?;
        let mixture = match load_mixture(dir, &manifest) {
            // A part that training has not made yet leaves its function out; one that is damaged is an error.
            Err(error @ CheckpointError::Missing { .. }) => Err(error.to_string()),
            other => Ok(other?),
        };
        let policy = load_policy(Rule::Calibrated, None, dir).unwrap_or(Policy { rule: Rule::Paper, threshold: 1.0 });
        let scenario = &manifest.scenario;
        let steps = scenario.timestamps.max(1);
        let name = |state: usize| format!("{} t{}", scenario.branches[state / steps], state % steps);
        let models = Self {
            dir: dir.to_owned(),
            probe: load_field_probe(dir, &manifest)?,
            mixture,
            policy,
            state_names: (0..scenario.state_count()).map(name).collect(),
            encoder: load_encoder(dir, &manifest)?,
            manifest,
        };
        // Once on a grey image, so that the first one is as fast as the others.
        models.encode(&Image::filled(128, 128, [128; 3]));
        Ok(models)
    }

    /// The posterior of an image, as the encoder stage computes it; `None` for an image of no or wrong size.
    pub fn encode(&self, image: &Image) -> Option<Gaussian> {
        borrow::with_image(image.view()?, |image| self.encoder.encode_bytes(image)).flatten()
    }

    /// The field.
    pub fn field(&self) -> &Field {
        self.probe.field()
    }

    /// Corners of the region that matters, metres, world space.
    pub fn bounds_m(&self) -> [[f64; 3]; 2] {
        self.field().config().bounds_m.map(|corner| corner.map(f64::from))
    }

    /// What a state is called; `unknown` for none of the known ones.
    pub fn state_name(&self, state: Option<usize>) -> &str {
        state.and_then(|s| self.state_names.get(s)).map_or("unknown", String::as_str)
    }

    /// The state of a branch at a step; `None` when there is none.
    pub fn state(&self, branch: usize, timestamp: usize) -> Option<usize> {
        let scenario = &self.manifest.scenario;
        let there = branch < scenario.branches.len() && timestamp < scenario.timestamps;
        there.then(|| branch * scenario.timestamps + timestamp)
    }

    /// Whether the hazard action is right in a state.
    pub fn is_hazard(&self, state: usize) -> bool {
        self.probe.layout().hazard_states().get(state).copied().unwrap_or(false)
    }

    /// Steps that the checkpoint was calibrated to look ahead.
    pub fn horizon(&self) -> u32 {
        let recorded = self.manifest.training.pointer("/calibration/horizon").and_then(serde_json::Value::as_u64);
        recorded.map_or(2, |h| h.clamp(1, u64::from(carff_messages::MAX_HORIZON)) as u32)
    }

    /// The dataset that it was trained on, as the training file names it.
    pub fn trained_on(&self) -> Option<PathBuf> {
        self.manifest.training.pointer("/dataset").and_then(serde_json::Value::as_str).map(PathBuf::from)
    }
}
