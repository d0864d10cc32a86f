//! What is judged: a checkpoint, a data set that shows its scenario, and what the encoder makes of its pictures.

use crate::{About, ResultsError};
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::{CheckpointError, FieldProbe, Manifest, ScenarioIdentity};
use carff_dataset::{
    Image, PoseRole,
    drives::DriveKind,
    sensor::{SensorNoise, apply_noise_into},
};
use carff_messages::Gaussian;
use carff_models::{
    decoder::Decoder,
    encoder::{Encoder, pictures_from_bytes},
    mixture::MixtureNet,
    stored::{load_decoder, load_encoder_on, load_mixture},
};
use carff_random::Key;
use carff_training::{pictures::Pictures, run::Progress};
use serde_json::Value;
use std::path::{Path, PathBuf};
use tch::{Device, Tensor};

/// How to evaluate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EvalOptions {
    /// Where the encoder computes.
    pub device: Device,
    /// Threads.
    pub threads: usize,
    /// Seed of sensor noise, draws and folds.
    pub seed: u64,
}

/// A checkpoint on a data set.
pub struct Subject {
    /// The checkpoint's folder.
    pub checkpoint: PathBuf,
    /// What was trained, and how.
    pub manifest: Manifest,
    /// Picture to posterior.
    pub encoder: Encoder,
    /// Posterior and pose to picture.
    pub decoder: Decoder,
    /// Posterior to mixture, or why there is none.
    pub mixture: Result<MixtureNet, String>,
    /// Hypothesis to state, or why there is none.
    pub probe: Result<FieldProbe, String>,
    /// The data set.
    pub pictures: Pictures,
    /// The posterior of each picture as it is.
    pub posteriors: Vec<Gaussian>,
    /// Threshold of the calibrated rule, where one was chosen.
    pub threshold: Option<f64>,
    /// Folder of the training run, where it is at hand: its curves are drawn.
    pub run_dir: Option<PathBuf>,
    /// Of each free drive the picture whose decision counts, as it is, and what is right: whoever can render them fills
    /// them in.
    pub free_drives: Vec<(Image, DriveKind)>,
    /// How to evaluate.
    pub options: EvalOptions,
}

/// Pictures between two words of progress.
const BATCH: usize = 8;

impl Subject {
    /// Reads both, and takes every picture through the encoder.
    pub fn load(
        checkpoint: &Path,
        dataset: &Path,
        options: EvalOptions,
        on_progress: &dyn Fn(&Progress),
    ) -> Result<Self, ResultsError> {
        let manifest = Manifest::load(checkpoint)?;
        let pictures = Pictures::open(dataset, manifest.split.seed)?;
        let given = ScenarioIdentity::of(&pictures.scenario, pictures.dataset.view_count());
        manifest.check_scenario(checkpoint, &given)?;
        let encoder = load_encoder_on(checkpoint, &manifest, options.device)?;
        let mut subject = Self {
            checkpoint: checkpoint.to_owned(),
            decoder: load_decoder(checkpoint, &manifest)?,
            mixture: or_why(load_mixture(checkpoint, &manifest))?,
            probe: or_why(carff_checkpoint::load_field_probe(checkpoint, &manifest))?,
            posteriors: Vec::with_capacity(pictures.images.len()),
            threshold: CheckpointPlanning::load(checkpoint).ok().map(|p| p.hazard_threshold),
            manifest,
            encoder,
            pictures,
            run_dir: None,
            free_drives: Vec::new(),
            options,
        };
        let total = subject.pictures.images.len();
        let all: Vec<usize> = (0..total).collect();
        for chunk in all.chunks(BATCH) {
            for &i in chunk {
                let image = &subject.pictures.images[i];
                let posterior = subject.encoder.encode(&as_tensor(&image.rgb, image));
                subject.posteriors.extend(posterior);
            }
            let done = subject.posteriors.len();
            on_progress(&Progress { stage: "encoding", done, total, line: String::new() });
        }
        Ok(subject)
    }

    /// Sensor noise of a camera in use, as the threshold was chosen under.
    pub fn noise(&self) -> SensorNoise {
        let recorded = self.manifest.training.pointer("/calibration/sensor").cloned();
        recorded.and_then(|v| serde_json::from_value(v).ok()).unwrap_or_default()
    }

    /// A picture with sensor noise, `[1, 3, H, W]` in 0..=1. The same for the same picture.
    pub fn noisy_input(&self, picture: usize) -> Tensor {
        let image = &self.pictures.images[picture];
        let key = Key { seed: self.options.seed, frame: picture as u64, step: 0x7265_6361, sample: 0 };
        let mut noisy = image.rgb.clone();
        if apply_noise_into(&image.rgb, &mut noisy, &self.noise(), key).is_err() {
            // Only settings out of range are refused, which a checkpoint does not have.
            noisy.copy_from_slice(&image.rgb);
        }
        as_tensor(&noisy, image)
    }

    /// Steps that are looked ahead.
    pub fn horizon(&self) -> u32 {
        self.manifest.training.pointer("/calibration/horizon").and_then(Value::as_u64).map_or(2, |h| h as u32)
    }

    /// Whether the decoder draws the residual over the pose's mean picture.
    pub fn residual(&self) -> bool {
        self.manifest.training.pointer("/vae/residual").and_then(Value::as_bool).unwrap_or(true)
    }

    /// What a state is called: its branch and its step.
    pub fn state_name(&self, state: usize) -> String {
        let scenario = &self.manifest.scenario;
        let steps = scenario.timestamps.max(1);
        let branch = scenario.branches.get(state / steps).map_or("?", String::as_str);
        format!("{branch} t{}", state % steps)
    }

    /// Whether two states look the same from above.
    pub fn same_from_above(&self, a: usize, b: usize) -> bool {
        self.pictures.scenario.bev_view.is_some_and(|view| self.pictures.equivalence.same(view, a, b))
    }

    /// What the results say of it.
    pub fn about(&self) -> About {
        let scenario = &self.manifest.scenario;
        let poses = ROLES.iter().map(|(role, name)| ((*name).to_owned(), self.pictures.split.views(*role).len()));
        About {
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            scenario: scenario.name.clone(),
            branches: scenario.branches.clone(),
            timestamps: scenario.timestamps,
            checkpoint: self.checkpoint.display().to_string(),
            dataset: self.pictures.dataset.dir().display().to_string(),
            pictures: self.pictures.images.len(),
            poses: poses.collect(),
            training_seed: self.manifest.seed,
            split_seed: self.manifest.split.seed,
            seed: self.options.seed,
        }
    }
}

/// Bytes of a picture of the size of `image` as `[1, 3, H, W]` in 0..=1.
fn as_tensor(rgb: &[u8], image: &Image) -> Tensor {
    let sides = [1, i64::from(image.height_px), i64::from(image.width_px), 3];
    pictures_from_bytes(&Tensor::from_slice(rgb).view(sides))
}

/// The parts of the poses, and what results call them.
pub const ROLES: [(PoseRole, &str); 3] =
    [(PoseRole::Rest, "trained"), (PoseRole::Calibration, "calibration"), (PoseRole::Unseen, "unseen")];

/// A part that training has not made yet is a reason to leave tables out; one that is damaged is an error.
fn or_why<T>(part: Result<T, CheckpointError>) -> Result<Result<T, String>, CheckpointError> {
    match part {
        Err(CheckpointError::Missing { part, stage, .. }) => {
            Ok(Err(format!("the checkpoint has no {part} (`carff train --stage {stage}` makes it)")))
        }
        other => other.map(Ok),
    }
}
