//! The trainer: steps of Adam on batches of rays.

use super::batch::{RayBatch, StepReport};
use super::shard::{Job, Shard};
use crate::config::{FieldError, LATENT_DIM, TrainerConfig};
use crate::kernels::adam::AdamStep;
use crate::kernels::dispatch::{self, InstructionSet};
use crate::march::samples::RayLimits;
use crate::model::field::Field;
use crate::model::tensors::{NamedTensor, network_tensors, table_tensor};
use crate::pool::Pool;

/// Most rays that are worked on together; all of one latent.
const CHUNK: usize = 32;
/// Numbers that one task of the Adam step updates.
const ADAM_PIECE: usize = 1 << 15;

/// One task of the Adam step: parameters, both moments, and each shard's gradient.
type AdamPiece<'a> = (&'a mut [f32], [&'a mut [f32]; 2], Vec<&'a mut [f32]>);

/// Trains a field from rays.
///
/// ```
/// use carff_field::{Field, FieldConfig, FieldTrainer, RayBatch, TrainerConfig};
/// use carff_base::geometry::Ray;
/// let config = FieldConfig { log2_table_size: 10, occupancy_resolution: 16, ..FieldConfig::default() };
/// let trainer_config = TrainerConfig { threads: 1, ..TrainerConfig::default() };
/// let mut trainer = FieldTrainer::new(Field::new(config, 1)?, trainer_config)?;
/// trainer.set_state_latents(&[vec![[0.0; 8]]]);
/// let report = trainer.step(&RayBatch {
///     rays: vec![Ray { origin: [0.0, 0.0, 5.0], direction: [0.0, 0.0, -1.0], spread: 0.0 }],
///     target_rgb: vec![[0.2, 0.4, 0.6]],
///     latent_index: vec![0],
///     latents: vec![[0.0; 8]],
/// });
/// assert!(report.loss.is_finite());
/// # Ok::<(), carff_field::FieldError>(())
/// ```
#[derive(Debug)]
pub struct FieldTrainer {
    pub(super) field: Field,
    pub(super) config: TrainerConfig,
    pub(super) step: u64,
    pub(super) state_latents: Vec<Vec<[f32; LATENT_DIM]>>,
    /// Largest recent density of each occupancy cell, 1/metre.
    pub(super) cell_density: Vec<f32>,
    /// Factor by which steps along rays are stretched; 1 once the occupancy grid keeps rays short.
    pub(super) step_scale: f32,
    pub(super) table_moments: [Vec<f32>; 2],
    pub(super) network_moments: [Vec<f32>; 2],
    pub(super) shards: Vec<Shard>,
    pub(super) pool: Pool,
    /// Indices of the batch's rays that are used, sorted by latent.
    order: Vec<u32>,
    /// Ranges of `order` that share a latent.
    chunks: Vec<(u32, u32)>,
}

impl FieldTrainer {
    /// Makes a trainer at step 0. Fails when the configuration is out of range.
    pub fn new(mut field: Field, config: TrainerConfig) -> Result<Self, FieldError> {
        config.validate()?;
        // Weights change, and their copies in bf16 would not follow.
        if field.set.is_bf16() {
            field.set_instruction_set(InstructionSet::detect());
        }
        let (t, n) = (field.table.len(), field.networks.len());
        Ok(Self {
            cell_density: vec![0.0; field.config.occupancy_resolution.pow(3)],
            table_moments: [vec![0.0; t], vec![0.0; t]],
            network_moments: [vec![0.0; n], vec![0.0; n]],
            shards: (0..config.gradient_shards).map(|_| Shard::new(&field)).collect(),
            pool: Pool::new(config.threads),
            field,
            step_scale: config.most_step_scale.max(1.0),
            config,
            step: 0,
            state_latents: Vec::new(),
            order: Vec::new(),
            chunks: Vec::new(),
        })
    }

    /// Sets the latents of each state, one list for each state: the occupancy grid keeps matter of any of them. Until
    /// then all of space counts as occupied.
    pub fn set_state_latents(&mut self, latents_by_state: &[Vec<[f32; LATENT_DIM]>]) {
        self.state_latents = latents_by_state.iter().filter(|l| !l.is_empty()).cloned().collect();
    }

    /// Returns the field as trained so far.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// Returns the number of steps done.
    pub fn step_count(&self) -> u64 {
        self.step
    }

    /// Returns the learning rate of the current step as a share of the peak.
    fn learning_rate_factor(&self) -> f32 {
        let c = &self.config;
        let rise = ((self.step + 1) as f32 / c.warmup_steps.max(1) as f32).min(1.0);
        let start = c.steps as f32 * c.decay_start;
        let part = ((self.step as f32 - start) / (c.steps as f32 - start).max(1.0)).clamp(0.0, 1.0);
        rise * c.final_factor.powf(part)
    }

    /// Does one step of training on a batch. Ignores entries beyond the shortest list, rays whose latent does not
    /// exist, and rays with values that are not finite.
    pub fn step(&mut self, batch: &RayBatch) -> StepReport {
        self.refresh_occupancy();
        let report = self.accumulate(batch);
        self.update();
        if report.rays > 0 {
            let excess = report.samples as f32 / report.rays as f32 / self.config.target_samples_per_ray;
            self.step_scale =
                (self.step_scale * excess.clamp(0.5, 2.0).powf(0.1)).clamp(1.0, self.config.most_step_scale.max(1.0));
        }
        self.step += 1;
        report
    }

    /// Returns the sampling of the current step's rays.
    pub fn limits(&self) -> RayLimits {
        let warm = self.step >= self.config.occupancy_warmup_steps && !self.state_latents.is_empty();
        RayLimits {
            max_samples: self.config.max_samples_per_ray,
            min_transmittance: self.config.min_transmittance,
            step_scale: self.step_scale,
            use_occupancy: warm,
        }
    }

    /// Computes loss and gradients of a batch without a step. The gradients' names and shapes are those of
    /// [`Field::tensors`], without the grids of cells.
    pub fn gradients(&mut self, batch: &RayBatch) -> (StepReport, Vec<NamedTensor<'static>>) {
        let report = self.accumulate(batch);
        let mut table = vec![0.0_f32; self.field.table.len()];
        let mut networks = vec![0.0_f32; self.field.networks.len()];
        for shard in &mut self.shards {
            for (sums, parts) in [(&mut table, &mut shard.table_gradient), (&mut networks, &mut shard.network_gradient)]
            {
                for (sum, part) in sums.iter_mut().zip(parts) {
                    *sum += std::mem::take(part);
                }
            }
        }
        let mut tensors = vec![table_tensor("grid.table", &self.field.layout, table)];
        tensors.extend(network_tensors(&self.field.layout, &networks, ""));
        (report, tensors)
    }

    /// Forward and backward: fills the shards' gradients.
    pub(super) fn accumulate(&mut self, batch: &RayBatch) -> StepReport {
        self.arrange(batch);
        let shard_count = self.shards.len();
        let job = Job {
            field: &self.field,
            config: &self.config,
            batch,
            order: &self.order,
            limits: self.limits(),
            step: self.step,
            gradient_scale: 1.0 / (3.0 * self.order.len().max(1) as f32),
        };
        let chunks = &self.chunks;
        self.pool.for_each(&mut self.shards, |s, shard| {
            shard.begin(batch.latents.len());
            for chunk in chunks.iter().skip(s).step_by(shard_count) {
                if shard.sums.samples > job.config.samples_per_step / shard_count {
                    break;
                }
                shard.chunk(&job, chunk.0 as usize..chunk.1 as usize);
            }
        });
        self.report(batch)
    }

    /// Sorts the batch's usable rays by latent and cuts them into chunks, which share folded biases.
    fn arrange(&mut self, batch: &RayBatch) {
        let count = batch.rays.len().min(batch.target_rgb.len()).min(batch.latent_index.len());
        self.order.clear();
        self.order.extend((0..count as u32).filter(|i| {
            let i = *i as usize;
            let ray = &batch.rays[i];
            (batch.latent_index[i] as usize) < batch.latents.len()
                && ray.origin.iter().chain(&ray.direction).chain(&batch.target_rgb[i]).all(|v| v.is_finite())
        }));
        self.order.sort_by_key(|i| batch.latent_index[*i as usize]);
        self.chunks.clear();
        let same_latent = |a: &u32, b: &u32| batch.latent_index[*a as usize] == batch.latent_index[*b as usize];
        let mut start = 0;
        for chunk in self.order.chunk_by(same_latent).flat_map(|rays| rays.chunks(CHUNK)) {
            self.chunks.push((start, start + chunk.len() as u32));
            start += chunk.len() as u32;
        }
    }

    /// Sums up the shards' reports.
    fn report(&self, batch: &RayBatch) -> StepReport {
        let sum = |f: fn(&Shard) -> f64| self.shards.iter().map(f).sum::<f64>();
        let count = |f: fn(&Shard) -> usize| self.shards.iter().map(f).sum::<usize>();
        let rays = count(|s| s.sums.rays);
        let channels = 3.0 * rays.max(1) as f64;
        let mut latent_gradient = Vec::new();
        if self.config.latent_gradient {
            latent_gradient = vec![[0.0; LATENT_DIM]; batch.latents.len()];
            for shard in &self.shards {
                for (sum, part) in latent_gradient.iter_mut().zip(&shard.latent_gradient) {
                    for k in 0..LATENT_DIM {
                        sum[k] += part[k] * self.field.config.latent_scale[k];
                    }
                }
            }
        }
        StepReport {
            loss: sum(|s| s.sums.loss) / channels,
            psnr: -10.0 * (sum(|s| s.sums.squared_error) / channels).max(1e-12).log10(),
            samples: count(|s| s.sums.samples),
            kept_samples: count(|s| s.sums.kept_samples),
            rays,
            latent_gradient,
        }
    }

    /// Does one Adam step from the shards' gradients, which are zeroed.
    pub(super) fn update(&mut self) {
        let c = &self.config;
        let (table_step, network_step) =
            (self.adam_step(c.learning_rate_table, 0.0), self.adam_step(c.learning_rate_networks, c.weight_decay));
        let set = self.field.set;
        let [first, second] = &mut self.network_moments;
        let mut gradients: Vec<&mut [f32]> = self.shards.iter_mut().map(|s| &mut s.network_gradient[..]).collect();
        dispatch::adam_step(set, network_step, false, &mut self.field.networks, [first, second], &mut gradients);

        let [first, second] = &mut self.table_moments;
        let mut pieces: Vec<AdamPiece> = self
            .field
            .table
            .chunks_mut(ADAM_PIECE)
            .zip(first.chunks_mut(ADAM_PIECE))
            .zip(second.chunks_mut(ADAM_PIECE))
            .map(|((p, m), v)| (p, [m, v], Vec::with_capacity(self.shards.len())))
            .collect();
        for shard in &mut self.shards {
            for (piece, gradient) in pieces.iter_mut().zip(shard.table_gradient.chunks_mut(ADAM_PIECE)) {
                piece.2.push(gradient);
            }
        }
        self.pool.for_each(&mut pieces, |_, (parameters, [first, second], gradients)| {
            dispatch::adam_step(set, table_step, true, parameters, [first, second], gradients);
        });
    }

    /// Returns the current step's numbers, with Adam's bias corrections.
    fn adam_step(&self, rate: f32, decay: f32) -> AdamStep {
        let c = &self.config;
        let n = (self.step + 1).min(100_000) as i32;
        let correction = (1.0 - c.beta2.powi(n)).sqrt() / (1.0 - c.beta1.powi(n));
        AdamStep {
            rate: rate * (self.learning_rate_factor() * correction),
            beta1: c.beta1,
            beta2: c.beta2,
            epsilon: c.epsilon * (1.0 - c.beta2.powi(n)).sqrt(),
            decay,
        }
    }
}
