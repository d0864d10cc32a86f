//! The training file of `carff train`.

use crate::{TrainingError, augmentation::Augmentation};
use carff_checkpoint::shapes::{DecoderConfig, EncoderConfig, MixtureConfig};
use carff_dataset::sensor::SensorNoise;
use carff_decision::Feedback;
use carff_field::TrainerConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// One training, from images to a checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingConfig {
    /// Folder of the dataset, relative to the working directory; `--dataset` overrides it.
    pub dataset: PathBuf,
    /// Scenario file from which the dataset is rendered when its folder is missing.
    #[serde(default)]
    pub scenario: Option<PathBuf>,
    /// Folder of the finished checkpoint; `--out` overrides it.
    pub out: PathBuf,
    /// Seed of all random numbers, except those with a seed of their own.
    pub seed: u64,
    /// Seed of the split of the poses into held-out (10 %), calibration (10 %) and other poses.
    pub split_seed: u64,
    /// Threads of the training.
    #[serde(default = "two")]
    pub threads: i32,
    /// Weights of the frozen backbone (safetensors); random weights if absent.
    #[serde(default)]
    pub pretrained_backbone: Option<PathBuf>,
    /// Shape of the encoder.
    #[serde(default)]
    pub encoder: EncoderConfig,
    /// Shape of the decoder.
    #[serde(default)]
    pub decoder: DecoderConfig,
    /// Shape of the mixture density network.
    #[serde(default)]
    pub mixture: MixtureConfig,
    /// Free poses in addition to those of the dataset.
    #[serde(default)]
    pub free_poses: FreePoses,
    /// Augmentation of the encoder's training images.
    #[serde(default)]
    pub augmentation: Augmentation,
    /// Training of the pose-conditional VAE.
    #[serde(default)]
    pub vae: VaeTraining,
    /// Structure of the field. Its bounds and the scale of its latents come from the data.
    #[serde(default)]
    pub field: carff_field::FieldConfig,
    /// Training of the field.
    #[serde(default)]
    pub nerf: FieldTraining,
    /// Training of the mixture density network.
    #[serde(default)]
    pub mdn: MdnTraining,
    /// Choice of the threshold of the calibrated rule.
    #[serde(default)]
    pub calibration: CalibrationConfig,
}

/// Choice of the threshold of the calibrated rule.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationConfig {
    /// Free poses of the scenario file, each with an image of each branch; they share no pose with training or
    /// evaluation. A dataset without a scenario file uses its calibration poses.
    pub free_poses: usize,
    /// Trials of each image of the calibration poses, with fresh sensor noise.
    pub repeats: usize,
    /// Sensor noise.
    pub sensor: SensorNoise,
    /// Samples of each step.
    pub samples: usize,
    /// Steps that are looked ahead.
    pub horizon: u32,
    /// Input of each further step of the look-ahead. Set it, as `horizon`, to the value of the graph file.
    pub feedback: Feedback,
}

impl Default for CalibrationConfig {
    fn default() -> Self {
        let (sensor, feedback) = (SensorNoise::default(), Feedback::State);
        Self { free_poses: 120, repeats: 5, sensor, samples: 10, horizon: 2, feedback }
    }
}

/// Free poses in addition to those of the dataset. Only encoder and forecaster train on them, so that they do not
/// memorise poses; decoder, field and all figures use the dataset's poses. For a dataset that was rendered from the
/// scenario file, the poses are drawn from the ranges of the scenario's cameras and rendered. For any other dataset
/// they are drawn between its poses, and a field that is trained only for this purpose renders their images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FreePoses {
    /// Number of poses; 0 turns them off.
    pub count: usize,
    /// Number of further poses on the ego's roof, anywhere on the first route of the scenario's closed-loop drives up to
    /// its stop line, with the ego at the camera. The scenario needs a table `closed_loop`.
    pub on_path: usize,
    /// Number of further poses for each appearance of the scenario file with the role `trained`: the dynamic vehicle
    /// has this appearance in their images, and those of every second appearance have a trained roadside object too. A
    /// dataset without a scenario file has none.
    pub per_appearance: usize,
    /// Seed of the draw.
    pub seed: u64,
    /// Steps of the field that renders them for a dataset without a scenario file; 0 turns them off for such datasets.
    pub field_steps: u64,
}

impl Default for FreePoses {
    fn default() -> Self {
        Self { count: 0, on_path: 0, per_appearance: 0, seed: 0, field_steps: 8000 }
    }
}

fn two() -> i32 {
    2
}

/// Training of the pose-conditional VAE (paper section 3.2, with terms that prevent posterior collapse).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VaeTraining {
    /// Passes over the training images.
    pub epochs: usize,
    /// Number of times that each pass uses the images of the dataset's own poses, which are few compared with those of
    /// free poses: once for encoder and decoder, and further times for the encoder only.
    pub own_passes: usize,
    /// Number of other poses at which each input's state is reconstructed from its latent, as small images: the encoder
    /// sees pose c, the decoder is asked for pose c'' (paper section 3.1, with one pose). Images of free poses are
    /// reconstructed at poses of the dataset. With one pose, most seeds end with a latent that shows no state. 0: each
    /// image is reconstructed at its own pose.
    pub other_poses: usize,
    /// Steps in which the encoder learns together with a field, through the error of the field's rays, in place of
    /// `epochs` with the decoder: one stage, as in NeRF-VAE (Kosiorek et al. 2021). The field that ships is trained
    /// afterwards in any case. 0: two stages, as in the paper.
    pub one_stage_steps: usize,
    /// Further passes that train only the decoder, over the images of the dataset's own poses. While the encoder
    /// learns, the decoder follows moving latents.
    pub decoder_epochs: usize,
    /// Images of each step.
    pub batch: usize,
    /// Images of a step that the decoder reconstructs, where they are of the dataset's own poses. The decoder costs
    /// twelve times as much as the head, but does not learn from a few images a step.
    pub decoder_batch: usize,
    /// Initial learning rate; it decays to 2 % of this value along a cosine.
    pub learning_rate: f64,
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Dropout before the head's hidden layer.
    pub dropout: f64,
    /// Weight of the KL term when it is fully on (per dimension sum, against the weighted squared error).
    pub kl_weight: f64,
    /// Share of the training before the KL term starts.
    pub kl_delay: f64,
    /// Share of the training in which the KL term rises linearly to its full weight.
    pub kl_ramp: f64,
    /// Weight of the squared error of the reconstruction.
    pub reconstruction_weight: f64,
    /// Target of the decoder: the residual over the pose's mean image (`true`), or the image, as in the paper
    /// (`false`).
    pub residual: bool,
    /// Weight of pixels that differ from the pose's mean image by more than 12 of 255; other pixels have the weight 1.
    pub foreground_weight: f64,
    /// Weight of the contrastive term between views of one state; 0 turns it off.
    pub contrastive_weight: f64,
    /// Temperature of the contrastive term.
    pub contrastive_temperature: f64,
    /// Weight of the state term: cross-entropy of a linear read-out of the sampled latent against the equivalent states
    /// of the view; 0 turns it off.
    pub state_weight: f64,
}

impl Default for VaeTraining {
    fn default() -> Self {
        Self {
            epochs: 100,
            own_passes: 1,
            other_poses: 0,
            one_stage_steps: 0,
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

/// Training of the field (paper section 3.3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FieldTraining {
    /// Rays a step.
    pub rays: usize,
    /// Share of the rays through pixels that change among the states, 0..=1.
    pub changed_share: f32,
    /// Share of rays whose latent is a draw instead of a mean, at the end of the ramp, 0..=1.
    pub resampled_share: f64,
    /// Share of the training in which the resampled share rises from 0.
    pub resampled_ramp: f64,
    /// True if a pixel covers its own width, false if it covers a point. With `true`, `point_width_m` of the field
    /// becomes the median width of the images' pixels in the middle of the bounds.
    pub wide_pixels: bool,
    /// The optimiser; `steps` is the length of the training.
    pub trainer: TrainerConfig,
}

impl Default for FieldTraining {
    fn default() -> Self {
        Self {
            rays: 4096,
            changed_share: 0.34,
            resampled_share: 0.7,
            resampled_ramp: 0.3,
            wide_pixels: false,
            trainer: TrainerConfig::default(),
        }
    }
}

/// Training of the mixture density network (paper section 3.4).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MdnTraining {
    /// Optimiser steps.
    pub steps: usize,
    /// Pairs of a view and a view of the next time step, for each optimiser step.
    pub batch: usize,
    /// Initial learning rate; it decays to 2 % of this value along a cosine.
    pub learning_rate: f64,
    /// Standard deviation of the noise on the input mean, in units of the input posterior's own deviation.
    pub input_noise: f64,
    /// Standard deviation of the noise on the input's log-variance.
    pub variance_noise: f64,
    /// Draws from the target posterior of each pair; the loss is the mean over their likelihoods.
    pub target_draws: usize,
}

impl Default for MdnTraining {
    fn default() -> Self {
        Self { steps: 4000, batch: 256, learning_rate: 1e-3, input_noise: 1.0, variance_noise: 0.0, target_draws: 1 }
    }
}

impl VaeTraining {
    /// Passes that train encoder and decoder together.
    pub fn joint_epochs(&self) -> usize {
        if self.one_stage_steps > 0 { 0 } else { self.epochs }
    }

    /// Total number of passes, including those of only the decoder.
    pub fn all_epochs(&self) -> usize {
        self.joint_epochs() + self.decoder_epochs
    }
}

impl std::str::FromStr for TrainingConfig {
    type Err = String;

    /// Reads and checks the text of a training file; the error has the line and the key.
    fn from_str(text: &str) -> Result<Self, String> {
        let config: Self = toml::from_str(text).map_err(|e| carff_base::names::explained(&e.to_string()))?;
        config.validate()?;
        Ok(config)
    }
}

impl TrainingConfig {
    /// Reads a training file; the error has the file, the line and the key.
    ///
    /// ```
    /// use carff_training::TrainingConfig;
    /// let config: TrainingConfig =
    ///     "dataset = 'data/toy'\nout = 'runs/toy'\nseed = 1\nsplit_seed = 7\n[vae]\nepochs = 20".parse()?;
    /// assert_eq!((config.vae.epochs, config.vae.batch), (20, 30));
    /// # Ok::<(), String>(())
    /// ```
    pub fn load(path: &Path) -> Result<Self, TrainingError> {
        let text = std::fs::read_to_string(path).map_err(|source| TrainingError::File { path: path.into(), source })?;
        text.parse().map_err(|what| TrainingError::Format { path: path.into(), what })
    }

    /// Checks that settings are in range and consistent; the error names the key.
    pub fn validate(&self) -> Result<(), String> {
        let counts = [
            ("vae.epochs", self.vae.epochs, 1, 10_000),
            ("vae.own_passes", self.vae.own_passes, 1, 100),
            ("vae.other_poses", self.vae.other_poses, 0, 64),
            ("vae.one_stage_steps", self.vae.one_stage_steps, 0, 1_000_000),
            ("vae.decoder_epochs", self.vae.decoder_epochs, 0, 10_000),
            ("vae.batch", self.vae.batch, 2, 4096),
            ("vae.decoder_batch", self.vae.decoder_batch, 1, 4096),
            ("nerf.rays", self.nerf.rays, 32, 1 << 20),
            ("calibration.free_poses", self.calibration.free_poses, 1, 100_000),
            ("calibration.repeats", self.calibration.repeats, 1, 1000),
            ("calibration.samples", self.calibration.samples, 1, 64),
            ("calibration.horizon", self.calibration.horizon as usize, 1, 8),
            ("mdn.steps", self.mdn.steps, 1, 1_000_000),
            ("mdn.batch", self.mdn.batch, 2, 65_536),
            ("mdn.target_draws", self.mdn.target_draws, 1, 256),
            ("free_poses.count", self.free_poses.count, 0, 10_000),
            ("free_poses.on_path", self.free_poses.on_path, 0, 10_000),
            ("free_poses.per_appearance", self.free_poses.per_appearance, 0, 10_000),
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
            ("mdn.variance_noise", self.mdn.variance_noise, 10.0),
            ("augmentation.shift", self.augmentation.shift, 0.5),
            ("augmentation.zoom", self.augmentation.zoom, 0.5),
            ("augmentation.rotation_deg", self.augmentation.rotation_deg, 45.0),
            ("augmentation.weather", self.augmentation.weather, 1.0),
        ];
        for (key, value, high) in numbers {
            if !(0.0..=high).contains(&value) {
                return Err(format!("`{key}` = {value}: 0 to {high} are allowed"));
            }
        }
        if self.vae.residual && !self.decoder.pose_condition {
            return Err(
                "`vae.residual` = true gives the decoder the pose, `decoder.pose_condition` = false does not: \
                        set `vae.residual` to false"
                    .into(),
            );
        }
        if self.vae.one_stage_steps > 0 && self.vae.decoder_epochs == 0 {
            return Err("`vae.one_stage_steps` trains no decoder: set `vae.decoder_epochs` to 1 or more".into());
        }
        if self.vae.other_poses > 0 && !self.decoder.pose_condition {
            return Err("`vae.other_poses` asks the decoder for poses: set `decoder.pose_condition` to true".into());
        }
        self.augmentation.validate_weather()?;
        self.field.validate().map_err(|e| format!("[field] {e}"))?;
        self.calibration.sensor.validate().map_err(|e| format!("[calibration.sensor] {e}"))?;
        self.augmentation.sensor.validate().map_err(|e| format!("[augmentation.sensor] {e}"))
    }
}
