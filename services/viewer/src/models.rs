//! A checkpoint's models, loaded once, with encoder and forecaster in libtorch.

use carff_checkpoint::{CheckpointError, FieldProbe, Manifest, TrainedWith, load_field_probe, load_policy};
use carff_dataset::Image;
use carff_decision::Policy;
use carff_field::Field;
use carff_messages::{Gaussian, Rule};
use carff_networks::{
    borrow,
    encoder::Encoder,
    mixture::MixtureNet,
    stored::{load_encoder, load_mixture},
};
use std::path::{Path, PathBuf};

/// The models of a checkpoint.
pub struct SessionModels {
    /// The checkpoint's folder.
    pub dir: PathBuf,
    /// Contents and training of the checkpoint.
    pub manifest: Manifest,
    /// Settings of the training that the session takes over.
    pub trained: TrainedWith,
    /// Probe that finds the state of a latent.
    pub probe: FieldProbe,
    /// Network from posterior to mixture, or the reason why there is none.
    pub mixture: Result<MixtureNet, String>,
    /// The rule that decides: calibrated if the checkpoint has a threshold, else the paper's.
    pub policy: Policy,
    /// Name of each known state: its branch and its time step.
    pub state_names: Vec<String>,
    encoder: Encoder,
}

impl SessionModels {
    /// Reads a checkpoint; `threads` is the number of threads of encoder and forecaster.
    pub fn load(dir: &Path, threads: usize) -> Result<Self, CheckpointError> {
        carff_networks::allocator::keep_large_blocks();
        carff_networks::device::set_threads(threads);
        let manifest = Manifest::load(dir)?;
        let mixture = match load_mixture(dir, &manifest) {
            // A missing part disables its function; a damaged part is an error.
            Err(error @ CheckpointError::Missing { .. }) => Err(error.to_string()),
            other => Ok(other?),
        };
        let policy = load_policy(Rule::Calibrated, None, dir, false).unwrap_or(Policy::new(Rule::Paper, 1.0));
        let scenario = &manifest.scenario;
        let steps = scenario.timestamps.max(1);
        let name = |state: usize| format!("{} t{}", scenario.branches[state / steps], state % steps);
        let models = Self {
            dir: dir.to_owned(),
            trained: manifest.trained_with(dir)?,
            probe: load_field_probe(dir, &manifest)?,
            mixture,
            policy,
            state_names: (0..scenario.state_count()).map(name).collect(),
            encoder: load_encoder(dir, &manifest)?,
            manifest,
        };
        // One grey image warms the encoder up, so that the first real image is as fast as later ones.
        models.encode(&Image::filled(128, 128, [128; 3]));
        Ok(models)
    }

    /// Returns the posterior of an image, computed in libtorch; `None` for an image of the wrong size.
    pub fn encode(&self, image: &Image) -> Option<Gaussian> {
        borrow::with_image(image.view()?, |image| self.encoder.encode_bytes(image)).flatten()
    }

    /// Returns the field.
    pub fn field(&self) -> &Field {
        self.probe.field()
    }

    /// Returns the corners of the region of interest, metres, world space.
    pub fn bounds_m(&self) -> [[f64; 3]; 2] {
        self.field().config().bounds_m.map(|corner| corner.map(f64::from))
    }

    /// Returns the name of a state; `unknown` for `None`.
    pub fn state_name(&self, state: Option<usize>) -> &str {
        state.and_then(|s| self.state_names.get(s)).map_or("unknown", String::as_str)
    }

    /// Returns the state of a branch at a time step; `None` if there is none.
    pub fn state(&self, branch: usize, timestamp: usize) -> Option<usize> {
        let scenario = &self.manifest.scenario;
        let there = branch < scenario.branches.len() && timestamp < scenario.timestamps;
        there.then(|| branch * scenario.timestamps + timestamp)
    }

    /// Returns true if the hazard action is right in a state.
    pub fn is_hazard(&self, state: usize) -> bool {
        self.probe.layout().hazard_states().get(state).copied().unwrap_or(false)
    }
}
