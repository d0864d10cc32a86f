//! The training file: what `carff train` reads.

use crate::{TrainingError, field::FieldTraining};
use carff_checkpoint::shapes::{DecoderConfig, EncoderConfig, MixtureConfig};
use carff_dataset::sensor::SensorNoise;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// One training, from pictures to a checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingConfig {
    /// The data set's folder, relative to the working directory; `--dataset` wins.
    pub dataset: PathBuf,
    /// The scenario file to render the data set from when its folder is missing.
    #[serde(default)]
    pub scenario: Option<PathBuf>,
    /// Where the finished checkpoint goes; `--out` wins.
    pub out: PathBuf,
    /// Seed of everything random.
    pub seed: u64,
    /// Seed of the split of the poses into unseen (10 %), calibration (10 %) and the rest.
    pub split_seed: u64,
    /// Threads that training uses.
    #[serde(default = "two")]
    pub threads: i32,
    /// Weights of the frozen backbone (safetensors); none: random.
    #[serde(default)]
    pub pretrained_backbone: Option<PathBuf>,
    /// The encoder's shape.
    #[serde(default)]
    pub encoder: EncoderConfig,
    /// The decoder's shape.
    #[serde(default)]
    pub decoder: DecoderConfig,
    /// The mixture density network's shape.
    #[serde(default)]
    pub mixture: MixtureConfig,
    /// Poses besides those of the data set.
    #[serde(default)]
    pub free_poses: FreePoses,
    /// What the pictures go through before the encoder sees them in training.
    #[serde(default)]
    pub augmentation: Augmentation,
    /// The pose-conditional VAE's training.
    #[serde(default)]
    pub vae: VaeTraining,
    /// The field's structure. Its bounds and the scale of its latents come from the data.
    #[serde(default)]
    pub field: carff_field::FieldConfig,
    /// The field's training.
    #[serde(default)]
    pub nerf: FieldTraining,
    /// The mixture density network's training.
    #[serde(default)]
    pub mdn: MdnTraining,
    /// How the calibrated rule's threshold is chosen.
    #[serde(default)]
    pub calibration: CalibrationConfig,
}

/// How the calibrated rule's threshold is chosen, on the calibration poses alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationConfig {
    /// Times that each picture is taken, with fresh sensor noise.
    pub repeats: usize,
    /// Sensor noise.
    pub sensor: SensorNoise,
    /// Samples a step.
    pub samples: usize,
    /// Steps looked ahead.
    pub horizon: u32,
}

impl Default for CalibrationConfig {
    fn default() -> Self {
        Self { repeats: 5, sensor: SensorNoise::default(), samples: 10, horizon: 2 }
    }
}

/// Poses besides those of the data set. Encoder and forecaster train on them too, so that they do not know poses by heart;
/// decoder, field and all figures do not. For a data set that the scenario has made they are drawn from the ranges of the
/// scenario's cameras and rendered. For any other they are drawn between the data set's own, and a field that is trained for
/// this alone shows what they see.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FreePoses {
    /// How many; 0 leaves them out.
    pub count: usize,
    /// Seed of the draw.
    pub seed: u64,
    /// Steps of the field that shows them for a data set that the scenario has not made; 0 leaves them out there.
    pub field_steps: u64,
}

impl Default for FreePoses {
    fn default() -> Self {
        Self { count: 0, seed: 0, field_steps: 8000 }
    }
}

fn two() -> i32 {
    2
}

/// What the pictures go through before the encoder sees them in training. The decoder's target is always the clean one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Altered copies of each picture, besides one with sensor noise alone. With a frozen backbone their features are
    /// computed once and kept.
    pub copies: usize,
    /// Further copies of the pictures that the data set's own poses are trained with: the first as it is, the others
    /// altered. There are few of them beside those of freely drawn poses.
    pub own_copies: usize,
    /// Sensor noise and colour errors, on every copy.
    pub sensor: SensorNoise,
    /// Largest shift, as a share of the picture's side.
    pub shift: f64,
    /// Largest relative change of scale.
    pub zoom: f64,
    /// Largest rotation about the optical axis, degrees.
    pub rotation_deg: f64,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            copies: 11,
            own_copies: 0,
            sensor: SensorNoise { sigma: 2.0, gain_sigma: 0.04, channel_gain_sigma: 0.02, channel_offset_sigma: 2.0 },
            shift: 0.1,
            zoom: 0.15,
            rotation_deg: 5.0,
        }
    }
}

/// Training of the pose-conditional VAE (paper section 3.2, with the terms that keep its latent alive).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VaeTraining {
    /// Passes over the training pictures.
    pub epochs: usize,
    /// How often each of them takes the pictures of the data set's own poses, which are few beside those of freely drawn
    /// poses: once for encoder and decoder, further for the encoder alone.
    pub own_passes: usize,
    /// Further passes in which the decoder learns alone, over the pictures of the data set's own poses: while the encoder
    /// learns, the decoder runs after latents that move.
    pub decoder_epochs: usize,
    /// Pictures a step.
    pub batch: usize,
    /// How many of them the decoder reconstructs, where they are of the data set's own poses: it costs twelve times as
    /// much as the head, but of a few pictures a step it learns nothing.
    pub decoder_batch: usize,
    /// Learning rate at the start; it falls to 2 % of it along a cosine.
    pub learning_rate: f64,
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Dropout before the head's hidden layer.
    pub dropout: f64,
    /// Weight of the KL term when it is fully on (per dimension sum, against the weighted squared error).
    pub kl_weight: f64,
    /// Share of the training before the KL term sets in.
    pub kl_delay: f64,
    /// Share of the training in which it rises linearly to its full weight.
    pub kl_ramp: f64,
    /// Weight of the squared error of the reconstruction.
    pub reconstruction_weight: f64,
    /// Whether the decoder learns the residual over the pose's mean picture (`true`) or the picture itself, as in the
    /// paper.
    pub residual: bool,
    /// Weight of pixels that differ from the pose's mean picture by more than 12 of 255; others weigh 1.
    pub foreground_weight: f64,
    /// Weight of the contrastive term between views of one state; 0 leaves it out.
    pub contrastive_weight: f64,
    /// Temperature of the contrastive term.
    pub contrastive_temperature: f64,
    /// Weight of the state term: cross-entropy of a linear read-out of the sampled latent against the states that look
    /// the same in that view; 0 leaves it out.
    pub state_weight: f64,
}

impl Default for VaeTraining {
    fn default() -> Self {
        Self {
            epochs: 100,
            own_passes: 1,
            decoder_epochs: 0,
            batch: 30,
            decoder_batch: 30,
            learning_rate: 1e-3,
            weight_decay: 0.05,
            dropout: 0.3,
            kl_weight: 0.01,
            kl_delay: 0.1,
            kl_ramp: 0.3,
            reconstruction_weight: 5.0,
            residual: true,
            foreground_weight: 10.0,
            contrastive_weight: 0.0,
            contrastive_temperature: 0.2,
            state_weight: 1.0,
        }
    }
}

/// Training of the mixture density network (paper section 3.4).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MdnTraining {
    /// Optimiser steps.
    pub steps: usize,
    /// Pairs of a view and a neighbouring view of the next step, a step.
    pub batch: usize,
    /// Learning rate at the start; it falls to 2 % of it along a cosine.
    pub learning_rate: f64,
    /// Standard deviation of the noise on the input mean, in units of the input posterior's own deviation.
    pub input_noise: f64,
}

impl Default for MdnTraining {
    fn default() -> Self {
        Self { steps: 4000, batch: 256, learning_rate: 1e-3, input_noise: 1.0 }
    }
}

impl VaeTraining {
    /// Passes in all, those of the decoder alone among them.
    pub fn all_epochs(&self) -> usize {
        self.epochs + self.decoder_epochs
    }
}

impl TrainingConfig {
    /// Reads a training file; the error shows file, line and key.
    pub fn load(path: &Path) -> Result<Self, TrainingError> {
        let text = std::fs::read_to_string(path).map_err(|source| TrainingError::File { path: path.into(), source })?;
        let config: Self = toml::from_str(&text).map_err(|e| {
            let what = carff_nearest::explained(&e.to_string());
            TrainingError::Format { path: path.into(), what }
        })?;
        config.validate().map_err(|what| TrainingError::Format { path: path.into(), what })?;
        Ok(config)
    }

    /// Checks that settings are in range and agree; the error names the key.
    pub fn validate(&self) -> Result<(), String> {
        let counts = [
            ("vae.epochs", self.vae.epochs, 1, 10_000),
            ("vae.own_passes", self.vae.own_passes, 1, 100),
            ("vae.decoder_epochs", self.vae.decoder_epochs, 0, 10_000),
            ("vae.batch", self.vae.batch, 2, 4096),
            ("vae.decoder_batch", self.vae.decoder_batch, 1, 4096),
            ("nerf.rays", self.nerf.rays, 32, 1 << 20),
            ("calibration.repeats", self.calibration.repeats, 1, 1000),
            ("calibration.samples", self.calibration.samples, 1, 64),
            ("calibration.horizon", self.calibration.horizon as usize, 1, 8),
            ("mdn.steps", self.mdn.steps, 1, 1_000_000),
            ("mdn.batch", self.mdn.batch, 2, 65_536),
            ("free_poses.count", self.free_poses.count, 0, 10_000),
            ("free_poses.field_steps", self.free_poses.field_steps as usize, 0, 1_000_000),
            ("augmentation.copies", self.augmentation.copies, 0, 64),
            ("augmentation.own_copies", self.augmentation.own_copies, 0, 64),
            ("threads", self.threads.max(0) as usize, 1, 256),
        ];
        for (key, value, low, high) in counts {
            if !(low..=high).contains(&value) {
                return Err(format!("`{key}` = {value}: {low} to {high} are allowed"));
            }
        }
        let numbers = [
            ("vae.learning_rate", self.vae.learning_rate, 1.0),
            ("vae.weight_decay", self.vae.weight_decay, 1.0),
            ("vae.dropout", self.vae.dropout, 0.95),
            ("vae.kl_weight", self.vae.kl_weight, 1e3),
            ("vae.kl_delay", self.vae.kl_delay, 1.0),
            ("vae.kl_ramp", self.vae.kl_ramp, 1.0),
            ("vae.reconstruction_weight", self.vae.reconstruction_weight, 1e6),
            ("vae.foreground_weight", self.vae.foreground_weight, 1e4),
            ("vae.contrastive_weight", self.vae.contrastive_weight, 1e3),
            ("vae.contrastive_temperature", self.vae.contrastive_temperature, 10.0),
            ("vae.state_weight", self.vae.state_weight, 1e3),
            ("nerf.changed_share", f64::from(self.nerf.changed_share), 1.0),
            ("nerf.resampled_share", self.nerf.resampled_share, 1.0),
            ("nerf.resampled_ramp", self.nerf.resampled_ramp, 1.0),
            ("mdn.learning_rate", self.mdn.learning_rate, 1.0),
            ("mdn.input_noise", self.mdn.input_noise, 10.0),
            ("augmentation.shift", self.augmentation.shift, 0.5),
            ("augmentation.zoom", self.augmentation.zoom, 0.5),
            ("augmentation.rotation_deg", self.augmentation.rotation_deg, 45.0),
        ];
        for (key, value, high) in numbers {
            if !(0.0..=high).contains(&value) {
                return Err(format!("`{key}` = {value}: 0 to {high} are allowed"));
            }
        }
        if self.vae.residual && !self.decoder.pose_condition {
            return Err(
                "`vae.residual` = true tells the decoder the pose, `decoder.pose_condition` = false does not: \
                        set `vae.residual` to false"
                    .into(),
            );
        }
        self.field.validate().map_err(|e| format!("[field] {e}"))?;
        self.calibration.sensor.validate().map_err(|e| format!("[calibration.sensor] {e}"))?;
        self.augmentation.sensor.validate().map_err(|e| format!("[augmentation.sensor] {e}"))
    }
}
