//! The field's structure, and the options of rendering and training: documented structs that are also the file format.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Numbers in one scene latent.
pub const LATENT_DIM: usize = 8;

/// Widest hidden layer of the density and the colour network.
pub(crate) const MAX_HIDDEN_WIDTH: usize = 256;
/// Most cells along the side of the occupancy grid.
pub(crate) const MAX_GRID_RESOLUTION: usize = 512;

/// The reason why a field or a trainer cannot be made or loaded.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum FieldError {
    /// A value of the configuration is out of its range.
    #[error("field configuration: `{key}` is {value}; allowed: {allowed}")]
    Config {
        /// Name of the value.
        key: &'static str,
        /// Its value.
        value: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// Tensors do not fit the configuration.
    #[error("tensors do not fit the field configuration: {}", .differences.join("; "))]
    Tensors {
        /// One entry for each key that is missing, unknown, of another shape or not finite.
        differences: Vec<String>,
    },
}

/// Structure of a field. Two fields with equal configurations have tensors of equal names and shapes.
#[derive(Serialize, Deserialize, JsonSchema, Clone, PartialEq, Debug)]
#[serde(deny_unknown_fields, default)]
pub struct FieldConfig {
    /// The bounds of the scene, [[x0, y0, z0], [x1, y1, z1]], metres, world space. They map to the inner half of the
    /// unit cube along the longest axis; space outside is contracted smoothly.
    pub bounds_m: [[f32; 3]; 2],
    /// Half extent of an axis is at least this share of the longest one, so that grid cells stay close to cubes. 0..=1.
    pub min_axis_ratio: f32,
    /// Levels of the hash grid, 1..=16.
    pub levels: usize,
    /// Features of one table entry: 2, 4 or 8.
    pub features_per_level: usize,
    /// Binary logarithm of the most entries that a level may have, 8..=22.
    pub log2_table_size: u32,
    /// Cells along the cube's side at the coarsest level, 2..=4096.
    pub base_resolution: u32,
    /// Cells along the cube's side at the finest level, at least `base_resolution`.
    pub max_resolution: u32,
    /// Neurons of each hidden layer of the density and the colour network; a multiple of 4, 8..=256.
    pub hidden_width: usize,
    /// Features that the density network passes to the colour network in addition to the raw density; this plus one
    /// is a multiple of 4.
    pub geometry_features: usize,
    /// Degree of the spherical harmonics that encode the viewing direction, 1..=4 (degree squared numbers).
    pub direction_degree: usize,
    /// Neurons of the hidden layer of the background network; a multiple of 4.
    pub background_width: usize,
    /// Added to the raw density before the exponential: density = exp(raw + offset), 1/metre.
    pub density_offset: f32,
    /// Cells along the side of the occupancy grid; a multiple of 8, 8..=512. A trained field has twice as many as it
    /// was trained with.
    pub occupancy_resolution: usize,
    /// Samples of a ray that crosses the bounds along their longest side: sets the step inside the bounds.
    pub samples_across: f32,
    /// The step is at least this times the distance from the camera.
    pub cone_angle: f32,
    /// Rays start this far from the camera, metres.
    pub near_m: f32,
    /// Rays end at this distance, metres; the background is beyond.
    pub far_m: f32,
    /// Above 0, samples of rays are as wide as their pixel at that distance, and levels of the grid with narrower cells
    /// count less. Points without a ray are this wide, metres. At 0 all levels count in full.
    pub point_width_m: f32,
    /// Subtracted from each latent before use.
    pub latent_mean: [f32; LATENT_DIM],
    /// Multiplies each latent after the mean is subtracted: brings latents to unit scale.
    pub latent_scale: [f32; LATENT_DIM],
}

impl Default for FieldConfig {
    fn default() -> Self {
        Self {
            bounds_m: [[-20.0, -20.0, 0.0], [20.0, 20.0, 6.0]],
            min_axis_ratio: 0.5,
            levels: 8,
            features_per_level: 4,
            log2_table_size: 16,
            base_resolution: 16,
            max_resolution: 512,
            hidden_width: 64,
            geometry_features: 15,
            direction_degree: 3,
            background_width: 32,
            density_offset: -3.0,
            occupancy_resolution: 96,
            samples_across: 256.0,
            cone_angle: 1.0 / 256.0,
            near_m: 0.2,
            far_m: 150.0,
            point_width_m: 0.0,
            latent_mean: [0.0; LATENT_DIM],
            latent_scale: [1.0; LATENT_DIM],
        }
    }
}

fn check(ok: bool, key: &'static str, value: impl std::fmt::Debug, allowed: &'static str) -> Result<(), FieldError> {
    if ok { Ok(()) } else { Err(FieldError::Config { key, value: format!("{value:?}"), allowed }) }
}

impl FieldConfig {
    /// Checks every value; the error names the first that is out of range.
    ///
    /// ```
    /// use carff_field::FieldConfig;
    /// let config = FieldConfig { levels: 4, ..FieldConfig::default() };
    /// assert!(config.validate().is_ok());
    /// let error = FieldConfig { levels: 0, ..config }.validate().unwrap_err();
    /// assert_eq!(error.to_string(), "field configuration: `levels` is 0; allowed: 1..=16");
    /// ```
    pub fn validate(&self) -> Result<(), FieldError> {
        let [low, high] = self.bounds_m;
        let box_ok = (0..3).all(|i| low[i].is_finite() && high[i].is_finite() && high[i] - low[i] > 1e-3);
        check(box_ok, "bounds_m", self.bounds_m, "finite, each upper corner above the lower one")?;
        check((0.0..=1.0).contains(&self.min_axis_ratio), "min_axis_ratio", self.min_axis_ratio, "0..=1")?;
        check((1..=16).contains(&self.levels), "levels", self.levels, "1..=16")?;
        check(
            matches!(self.features_per_level, 2 | 4 | 8),
            "features_per_level",
            self.features_per_level,
            "2, 4 or 8",
        )?;
        check(
            (self.levels * self.features_per_level).is_multiple_of(4),
            "levels",
            self.levels,
            "levels * features_per_level a multiple of 4",
        )?;
        check((8..=22).contains(&self.log2_table_size), "log2_table_size", self.log2_table_size, "8..=22")?;
        check((2..=4096).contains(&self.base_resolution), "base_resolution", self.base_resolution, "2..=4096")?;
        check(
            (self.base_resolution..=65536).contains(&self.max_resolution),
            "max_resolution",
            self.max_resolution,
            "base_resolution..=65536",
        )?;
        check(
            self.hidden_width.is_multiple_of(4) && (8..=MAX_HIDDEN_WIDTH).contains(&self.hidden_width),
            "hidden_width",
            self.hidden_width,
            "a multiple of 4 in 8..=256",
        )?;
        check(
            self.geometry_features % 4 == 3 && self.geometry_features <= 63,
            "geometry_features",
            self.geometry_features,
            "3, 7, 11, ... 63",
        )?;
        check((1..=4).contains(&self.direction_degree), "direction_degree", self.direction_degree, "1..=4")?;
        check(
            self.background_width.is_multiple_of(4) && (4..=256).contains(&self.background_width),
            "background_width",
            self.background_width,
            "a multiple of 4 in 4..=256",
        )?;
        check((-20.0..=20.0).contains(&self.density_offset), "density_offset", self.density_offset, "-20..=20")?;
        check(
            self.occupancy_resolution.is_multiple_of(8)
                && (8..=MAX_GRID_RESOLUTION).contains(&self.occupancy_resolution),
            "occupancy_resolution",
            self.occupancy_resolution,
            "a multiple of 8 in 8..=512",
        )?;
        check((1.0..=65536.0).contains(&self.samples_across), "samples_across", self.samples_across, "1..=65536")?;
        check((0.0..=1.0).contains(&self.cone_angle), "cone_angle", self.cone_angle, "0..=1")?;
        check(self.near_m.is_finite() && self.near_m >= 0.0, "near_m", self.near_m, "zero or more, finite")?;
        check(self.far_m.is_finite() && self.far_m > self.near_m, "far_m", self.far_m, "above near_m, finite")?;
        check(
            self.point_width_m.is_finite() && self.point_width_m >= 0.0,
            "point_width_m",
            self.point_width_m,
            "zero or more, finite",
        )?;
        check(self.latent_mean.iter().all(|v| v.is_finite()), "latent_mean", self.latent_mean, "finite numbers")?;
        check(self.latent_scale.iter().all(|v| v.is_finite()), "latent_scale", self.latent_scale, "finite numbers")
    }
}

/// The options of rendering.
#[derive(Serialize, Deserialize, Clone, Copy, PartialEq, Debug)]
#[serde(deny_unknown_fields, default)]
pub struct RenderOptions {
    /// Threads used, at least 1.
    pub threads: usize,
    /// A ray ends after this number of samples.
    pub max_samples_per_ray: usize,
    /// A ray ends when its transmittance falls below this.
    pub min_transmittance: f32,
    /// Samples of less weight than this take the mean colour of their ray's other samples (the heaviest sample always
    /// has its own colour).
    pub min_weight: f32,
    /// Multiplies the steps along rays, at least 1: fewer samples, coarser surfaces.
    pub step_scale: f32,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { threads: 1, max_samples_per_ray: 256, min_transmittance: 1e-2, min_weight: 5e-3, step_scale: 1.0 }
    }
}

/// The options of a field's training.
#[derive(Serialize, Deserialize, JsonSchema, Clone, PartialEq, Debug)]
#[serde(deny_unknown_fields, default)]
pub struct TrainerConfig {
    /// Names every random draw of the training.
    pub seed: u64,
    /// Threads used, at least 1. Results do not depend on it.
    pub threads: usize,
    /// Private gradient buffers, at least 1; no more threads than this work at once. Results depend on it (order of
    /// sums), so keep it when comparing runs bit by bit.
    pub gradient_shards: usize,
    /// Peak learning rate of the hash tables.
    pub learning_rate_table: f32,
    /// Peak learning rate of the networks.
    pub learning_rate_networks: f32,
    /// Steps over which the learning rate rises linearly from zero.
    pub warmup_steps: u64,
    /// Planned number of steps: the learning rate falls exponentially from `decay_start` of these to the last.
    pub steps: u64,
    /// Share of `steps` after which the learning rate begins to fall, 0..=1.
    pub decay_start: f32,
    /// Learning rate at the last step as a share of the peak.
    pub final_factor: f32,
    /// Decay of Adam's first moment.
    pub beta1: f32,
    /// Decay of Adam's second moment.
    pub beta2: f32,
    /// Adam's epsilon.
    pub epsilon: f32,
    /// Pull of the network weights towards zero (added to the gradient).
    pub weight_decay: f32,
    /// Errors above this count linearly instead of squared (Huber loss).
    pub huber_delta: f32,
    /// Most samples of a ray.
    pub max_samples_per_ray: usize,
    /// A step takes no more rays after this number of samples (at first, when all of space is thin fog, a ray has ten
    /// times the samples that it has later).
    pub samples_per_step: usize,
    /// A ray ends when its transmittance falls below this.
    pub min_transmittance: f32,
    /// Samples of less weight than this are kept by chance (with a probability in proportion to the weight, at least
    /// `min_keep`), and their gradient is scaled up accordingly. 0 keeps all.
    pub roulette_weight: f32,
    /// Least probability of being kept.
    pub min_keep: f32,
    /// Jitter the sample positions along the rays.
    pub jitter: bool,
    /// Weight of the opacity regulariser: pushes each ray's opacity to 0 or 1.
    pub opacity_entropy: f32,
    /// Weight of the distortion loss (mip-NeRF 360, eq. 15), which contracts the weights along a ray to thin surfaces.
    /// Distances t count as t / (t + half the longest extent of the bounds).
    pub distortion: f32,
    /// Steps between two refreshes of the occupancy grid.
    pub occupancy_interval: u64,
    /// Up to this step all of space counts as occupied.
    pub occupancy_warmup_steps: u64,
    /// While rays have more samples than this on average, steps along them are stretched (up to `most_step_scale`
    /// times): thin fog needs no fine steps, and once there are surfaces the occupancy grid keeps rays short.
    pub target_samples_per_ray: f32,
    /// Largest stretch of steps (see `target_samples_per_ray`), also the first. 1 switches stretching off.
    pub most_step_scale: f32,
    /// Cells that each refresh evaluates, half of them among the occupied ones.
    pub occupancy_cells: usize,
    /// Share of a cell's density that each evaluation keeps.
    pub occupancy_decay: f32,
    /// A cell is occupied when its density times the step inside the bounds is above this (or above the mean).
    pub occupancy_threshold: f32,
    /// Also compute the gradient of the loss by each latent of the batch.
    pub latent_gradient: bool,
}

impl TrainerConfig {
    /// Checks the values; the error names the first that is out of range.
    pub fn validate(&self) -> Result<(), FieldError> {
        for (value, key) in [
            (self.threads, "threads"),
            (self.gradient_shards, "gradient_shards"),
            (self.max_samples_per_ray, "max_samples_per_ray"),
        ] {
            check(value >= 1, key, value, "1 or more")?;
        }
        for (value, key) in [
            (self.learning_rate_table, "learning_rate_table"),
            (self.learning_rate_networks, "learning_rate_networks"),
            (self.huber_delta, "huber_delta"),
            (self.min_keep, "min_keep"),
            (self.target_samples_per_ray, "target_samples_per_ray"),
            (self.most_step_scale, "most_step_scale"),
            (self.final_factor, "final_factor"),
        ] {
            check(value.is_finite() && value > 0.0, key, value, "above zero, finite")?;
        }
        for (value, key) in [(self.beta1, "beta1"), (self.beta2, "beta2")] {
            check((0.0..1.0).contains(&value), key, value, "0..1")?;
        }
        Ok(())
    }
}

impl Default for TrainerConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            threads: 2,
            gradient_shards: 2,
            learning_rate_table: 1e-2,
            learning_rate_networks: 2e-3,
            warmup_steps: 50,
            steps: 8000,
            decay_start: 0.3,
            final_factor: 0.03,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-15,
            weight_decay: 1e-6,
            huber_delta: 1.0,
            max_samples_per_ray: 192,
            samples_per_step: 1 << 15,
            min_transmittance: 1e-3,
            roulette_weight: 1e-3,
            min_keep: 0.1,
            jitter: true,
            opacity_entropy: 0.0,
            distortion: 0.0,
            occupancy_interval: 16,
            occupancy_warmup_steps: 256,
            target_samples_per_ray: 24.0,
            most_step_scale: 12.0,
            occupancy_cells: 1 << 15,
            occupancy_decay: 0.9,
            occupancy_threshold: 0.05,
            latent_gradient: false,
        }
    }
}
