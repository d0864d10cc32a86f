//! Training: forward, loss, backward by hand, Adam, and the upkeep of the occupancy grid.

use carff_geometry::Ray;
use rayon::prelude::*;

use crate::config::{FieldError, LATENT_DIM, TrainerConfig};
use crate::dispatch::{self, InstructionSet};
use crate::field::{
    Field, Folded, GROUP, NamedTensor, Scratch, grow, network_tensors, set_network_tensor, write_direction,
};
use crate::kernels::{AdamStep, LANES, stride};
use crate::march::{NO_RAY, RayLimits, RayState, Samples};
use crate::math::{hash, spherical_harmonics, unit};

/// Most rays that are worked on together; all of one latent.
const CHUNK: usize = 32;
/// Numbers that one task of the Adam step updates.
const ADAM_PIECE: usize = 1 << 15;
/// Random points of each cell that are looked at when training ends, under one latent of each state.
const LAST_LOOKS: u64 = 10;
/// A cell stays when a step inside the bounds through its densest point would hide this share of what is behind.
const VISIBLE_OPACITY: f32 = 0.03;
/// Random points of each cell at which states are compared when training ends.
const COMPARED_POINTS: u64 = 8;
/// States differ in a cell where their means of the opacity of a step inside the bounds, or of the colour as seen
/// through it, differ by more than this.
const VISIBLE_CHANGE: f32 = 0.12;
/// Occupancy cells that one task looks at.
const CELLS_PIECE: usize = 512;

/// One task of the Adam step: parameters, both moments, and each shard's gradient.
type AdamPiece<'a> = (&'a mut [f32], &'a mut [f32], &'a mut [f32], Vec<&'a mut [f32]>);

/// Rays with what they should see. All three lists have one entry for each ray.
#[derive(Clone, Debug, Default)]
pub struct RayBatch {
    /// The rays.
    pub rays: Vec<Ray>,
    /// Their colours, 0..=1.
    pub target_rgb: Vec<[f32; 3]>,
    /// For each ray, its latent's place in `latents`.
    pub latent_index: Vec<u32>,
    /// The latents of this batch.
    pub latents: Vec<[f32; LATENT_DIM]>,
}

/// What one step did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Mean Huber loss over rays and channels.
    pub loss: f64,
    /// Of the batch, dB.
    pub psnr: f64,
    /// Samples whose density was evaluated.
    pub samples: usize,
    /// Samples that got a colour and a gradient.
    pub kept_samples: usize,
    /// Rays.
    pub rays: usize,
    /// Gradient of the loss by each latent of the batch; empty unless asked for.
    pub latent_gradient: Vec<[f32; LATENT_DIM]>,
}

/// Optimiser state, for saving and resuming.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainerState<'a> {
    /// Steps done.
    pub step: u64,
    /// Moments and cell densities by name; the names and shapes depend on the field's configuration alone.
    pub tensors: Vec<NamedTensor<'a>>,
}

/// Activations of up to `GROUP` blocks of kept samples, from the forward pass to the backward one.
#[derive(Debug, Default)]
struct Tile {
    features: Vec<f32>,
    density_a: Vec<f32>,
    density_b: Vec<f32>,
    inputs: Vec<f32>,
    color_a: Vec<f32>,
    color_b: Vec<f32>,
    output: Vec<f32>,
}

/// Gradients by activations, of one tile.
#[derive(Debug, Default)]
struct Backward {
    output: Vec<f32>,
    wide_a: Vec<f32>,
    wide_b: Vec<f32>,
    inputs: Vec<f32>,
    features: Vec<f32>,
    points: Vec<[f32; 3]>,
    widths: Vec<f32>,
    density_bias: Vec<f32>,
    color_bias: Vec<f32>,
    background_bias: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
struct Kept {
    sample: u32,
    /// 1 / probability of having been kept.
    scale: f32,
    color: [f32; 3],
    color_gradient: [f32; 3],
    raw_gradient: f32,
}

/// Sums over the samples of a ray that lie on one side of a sample.
#[derive(Clone, Copy, Debug, Default)]
struct RaySums {
    /// Of weights.
    weight: f32,
    /// Of weights times places.
    moment: f32,
    /// Of weights times the loss's gradients by them.
    gradient: f32,
}

/// What one shard of the batch works in; the order of its sums does not depend on threads.
#[derive(Debug, Default)]
struct Shard {
    table_gradient: Vec<f32>,
    network_gradient: Vec<f32>,
    latent_gradient: Vec<[f32; LATENT_DIM]>,
    scratch: Scratch,
    samples: Samples,
    folded: Folded,
    rays: Vec<Ray>,
    targets: Vec<[f32; 3]>,
    kept: Vec<Kept>,
    tiles: Vec<Tile>,
    backward: Backward,
    background: Tile,
    behind_rgb: Vec<[f32; 3]>,
    pixel: Vec<[f32; 3]>,
    pixel_gradient: Vec<[f32; 3]>,
    through_gradient: Vec<f32>,
    ray_sums: Vec<RaySums>,
    loss: f64,
    squared_error: f64,
    ray_count: usize,
    sample_count: usize,
    kept_count: usize,
}

/// Trains a field from rays.
///
/// ```
/// use carff_field::{Field, FieldConfig, FieldTrainer, RayBatch, TrainerConfig};
/// use carff_geometry::Ray;
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
    field: Field,
    config: TrainerConfig,
    step: u64,
    state_latents: Vec<Vec<[f32; LATENT_DIM]>>,
    cell_density: Vec<f32>,
    step_scale: f32,
    table_moments: [Vec<f32>; 2],
    network_moments: [Vec<f32>; 2],
    shards: Vec<Shard>,
    pool: Option<rayon::ThreadPool>,
    order: Vec<u32>,
    chunks: Vec<(u32, u32)>,
    cells: Vec<u32>,
}

impl FieldTrainer {
    /// A trainer at step 0. Errors when a thread pool cannot be made or the configuration is out of range.
    pub fn new(mut field: Field, config: TrainerConfig) -> Result<Self, FieldError> {
        fn positive(value: usize, key: &'static str) -> Result<(), FieldError> {
            if value >= 1 {
                Ok(())
            } else {
                Err(FieldError::Config { key, value: value.to_string(), allowed: "1 or more" })
            }
        }
        // Weights change: no copy of them in bf16 would follow.
        if field.set.is_bf16() {
            field.set_instruction_set(InstructionSet::detect());
        }
        positive(config.threads, "threads")?;
        positive(config.gradient_shards, "gradient_shards")?;
        positive(config.max_samples_per_ray, "max_samples_per_ray")?;
        let rates = [
            (config.learning_rate_table, "learning_rate_table"),
            (config.learning_rate_networks, "learning_rate_networks"),
            (config.huber_delta, "huber_delta"),
            (config.min_keep, "min_keep"),
            (config.target_samples_per_ray, "target_samples_per_ray"),
            (config.most_step_scale, "most_step_scale"),
            (config.final_factor, "final_factor"),
        ];
        for (value, key) in rates {
            if !(value.is_finite() && value > 0.0) {
                return Err(FieldError::Config { key, value: value.to_string(), allowed: "above zero, finite" });
            }
        }
        for (value, key) in [(config.beta1, "beta1"), (config.beta2, "beta2")] {
            if !(0.0..1.0).contains(&value) {
                return Err(FieldError::Config { key, value: value.to_string(), allowed: "0..1" });
            }
        }
        // A pool that cannot be made (no threads to be had) is done without: results do not depend on it.
        let pool = (config.threads > 1)
            .then(|| rayon::ThreadPoolBuilder::new().num_threads(config.threads).build().ok())
            .flatten();
        let (t, n) = (field.table.len(), field.networks.len());
        let shards = (0..config.gradient_shards)
            .map(|_| Shard { table_gradient: vec![0.0; t], network_gradient: vec![0.0; n], ..Shard::default() })
            .collect();
        Ok(Self {
            cell_density: vec![0.0; field.config.occupancy_resolution.pow(3)],
            table_moments: [vec![0.0; t], vec![0.0; t]],
            network_moments: [vec![0.0; n], vec![0.0; n]],
            shards,
            pool,
            field,
            step_scale: config.most_step_scale.max(1.0),
            config,
            step: 0,
            state_latents: Vec::new(),
            order: Vec::new(),
            chunks: Vec::new(),
            cells: Vec::new(),
        })
    }

    /// The latents of each state, one list a state: the occupancy grid keeps what exists under any of them.
    /// Until it is called all of space counts as occupied.
    pub fn set_state_latents(&mut self, latents_by_state: &[Vec<[f32; LATENT_DIM]>]) {
        self.state_latents = latents_by_state.iter().filter(|l| !l.is_empty()).cloned().collect();
    }

    /// The field as trained so far.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The field, and an end to training. Its grids get cells of half the side, and those in which no state has anything
    /// that a picture would show are given up: training keeps thin fog, which rendering need not walk through. Where
    /// states differ is noted.
    pub fn into_field(mut self) -> Field {
        if self.step < self.config.occupancy_warmup_steps || self.state_latents.is_empty() {
            return self.field;
        }
        self.field.refine_grids();
        let count = self.field.occupancy.resolution().pow(3) as u32;
        let cells: Vec<u32> = (0..count).filter(|cell| self.field.occupancy.cell(*cell as usize)).collect();
        let mut densest = vec![0.0_f32; cells.len()];
        for look in 0..LAST_LOOKS {
            let round = hash(self.config.seed, 0x1a57, look);
            let latents = self.latents_for(round);
            for (most, density) in densest.iter_mut().zip(self.densest(&cells, &latents, round)) {
                *most = most.max(density);
            }
        }
        let threshold = VISIBLE_OPACITY / self.field.marcher.step_m;
        let mut kept = vec![false; count as usize];
        for (cell, density) in cells.iter().zip(densest) {
            kept[*cell as usize] = density > threshold;
        }
        self.field.occupancy.set_from(|cell| kept[cell]);
        let cells: Vec<u32> = cells.into_iter().filter(|cell| kept[*cell as usize]).collect();
        let mut changing = vec![false; kept.len()];
        for (cell, change) in cells.iter().zip(self.changes(&cells)) {
            changing[*cell as usize] = change > VISIBLE_CHANGE;
        }
        self.field.changing.set_from(|cell| changing[cell]);
        self.field
    }

    /// How much the states' means over each cell differ: the larger of the differences in the opacity of a step inside
    /// the bounds and in colour as seen through it.
    fn changes(&self, cells: &[u32]) -> Vec<f32> {
        let field = &self.field;
        let rounds: Vec<u64> = (0..COMPARED_POINTS).map(|look| hash(self.config.seed, 0xc4a9, look)).collect();
        let look = |cells: &[u32]| -> Vec<f32> {
            // Per cell the least and the largest of the states' means: opacity, and colours through it.
            let mut range = vec![([f32::INFINITY; 4], [f32::NEG_INFINITY; 4]); cells.len()];
            let (mut densities, mut colors) = (vec![0.0; cells.len()], vec![[0.0; 3]; cells.len()]);
            let mut means = vec![[0.0_f32; 4]; cells.len()];
            for state in &self.state_latents {
                means.fill([0.0; 4]);
                for (i, round) in rounds.iter().enumerate() {
                    let points: Vec<[f32; 3]> =
                        self.points_in(cells, *round).into_iter().map(|q| field.contraction.uncontract(q)).collect();
                    let directions: Vec<[f32; 3]> = cells.iter().map(|cell| random_direction(*round, *cell)).collect();
                    let latent = &state[i % state.len()];
                    field.density_and_color(&points, &directions, latent, &mut densities, &mut colors);
                    for ((mean, density), [r, g, b]) in means.iter_mut().zip(&densities).zip(&colors) {
                        let opacity = 1.0 - (-density * field.marcher.step_m).exp();
                        for (sum, v) in mean.iter_mut().zip([1.0, *r, *g, *b]) {
                            *sum += opacity * v / COMPARED_POINTS as f32;
                        }
                    }
                }
                for ((low, high), mean) in range.iter_mut().zip(&means) {
                    for k in 0..4 {
                        low[k] = low[k].min(mean[k]);
                        high[k] = high[k].max(mean[k]);
                    }
                }
            }
            range.iter().map(|(low, high)| (0..4).map(|k| high[k] - low[k]).fold(0.0, f32::max)).collect()
        };
        match &self.pool {
            Some(pool) => pool.install(|| cells.par_chunks(CELLS_PIECE).map(look).flatten().collect()),
            None => cells.chunks(CELLS_PIECE).flat_map(look).collect(),
        }
    }

    /// One random point of each cell, in the unit cube.
    fn points_in(&self, cells: &[u32], round: u64) -> Vec<[f32; 3]> {
        let resolution = self.field.occupancy.resolution();
        cells
            .iter()
            .map(|cell| {
                let i = *cell as usize;
                let at = [i % resolution, i / resolution % resolution, i / (resolution * resolution)];
                std::array::from_fn(|a| {
                    let jitter = unit(hash(round, 4 + a as u64, i as u64));
                    (at[a] as f32 + jitter) / resolution as f32
                })
            })
            .collect()
    }

    /// How much steps along rays are stretched just now; 1 once the occupancy grid keeps rays short.
    pub fn step_scale(&self) -> f32 {
        self.step_scale
    }

    /// Steps done.
    pub fn step_count(&self) -> u64 {
        self.step
    }

    /// Learning rate of the current step as a share of the peak.
    pub fn learning_rate_factor(&self) -> f32 {
        let c = &self.config;
        let rise = ((self.step + 1) as f32 / c.warmup_steps.max(1) as f32).min(1.0);
        let start = c.steps as f32 * c.decay_start;
        let part = ((self.step as f32 - start) / (c.steps as f32 - start).max(1.0)).clamp(0.0, 1.0);
        rise * c.final_factor.powf(part)
    }

    /// One step of training on a batch. Entries beyond the shortest list, and rays whose latent does not exist or that
    /// hold values which are not finite, are left out.
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

    /// How the rays of the current step are sampled.
    pub fn limits(&self) -> RayLimits {
        let warm = self.step >= self.config.occupancy_warmup_steps && !self.state_latents.is_empty();
        RayLimits {
            max_samples: self.config.max_samples_per_ray,
            min_transmittance: self.config.min_transmittance,
            step_scale: self.step_scale,
            use_occupancy: warm,
        }
    }

    /// Loss and gradients of a batch, with no step taken. The gradients' names and shapes are those of
    /// [`Field::tensors`], the occupancy left out.
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
        let f = self.field.config.features_per_level;
        let shape = vec![table.len() / f, f];
        let mut tensors = vec![NamedTensor { name: "grid.table".into(), shape, data: table.into() }];
        tensors.extend(network_tensors(&self.field.layout, &networks, ""));
        (report, tensors)
    }

    /// Forward and backward: fills the shards' gradients.
    fn accumulate(&mut self, batch: &RayBatch) -> StepReport {
        let count = batch.rays.len().min(batch.target_rgb.len()).min(batch.latent_index.len());
        // Rays of one latent together, in their order: chunks then share the folded biases.
        self.order.clear();
        self.order.extend((0..count as u32).filter(|i| {
            let i = *i as usize;
            let ray = &batch.rays[i];
            (batch.latent_index[i] as usize) < batch.latents.len()
                && ray.origin.iter().chain(&ray.direction).chain(&batch.target_rgb[i]).all(|v| v.is_finite())
        }));
        self.order.sort_by_key(|i| batch.latent_index[*i as usize]);
        self.chunks.clear();
        let latent_at = |at: u32| batch.latent_index[self.order[at as usize] as usize];
        let mut start = 0;
        while (start as usize) < self.order.len() {
            let mut end = start + 1;
            while (end as usize) < self.order.len() && end - start < CHUNK as u32 && latent_at(end) == latent_at(start)
            {
                end += 1;
            }
            self.chunks.push((start, end));
            start = end;
        }
        let rays = self.order.len();
        let limits = self.limits();
        let job = Job {
            field: &self.field,
            config: &self.config,
            batch,
            order: &self.order,
            limits,
            step: self.step,
            gradient_scale: 1.0 / (3.0 * rays.max(1) as f32),
        };
        let (chunks, shard_count) = (&self.chunks, self.shards.len());
        let run = |(s, shard): (usize, &mut Shard)| {
            shard.begin(batch.latents.len());
            let most = job.config.samples_per_step / shard_count;
            for chunk in chunks.iter().skip(s).step_by(shard_count) {
                if shard.sample_count > most {
                    break;
                }
                shard.chunk(&job, chunk.0 as usize..chunk.1 as usize);
            }
        };
        match &self.pool {
            Some(pool) => pool.install(|| self.shards.par_iter_mut().with_max_len(1).enumerate().for_each(run)),
            None => self.shards.iter_mut().enumerate().for_each(run),
        }
        let total = |f: fn(&Shard) -> f64| self.shards.iter().map(f).sum::<f64>();
        let rays: usize = self.shards.iter().map(|s| s.ray_count).sum();
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
            loss: total(|s| s.loss) / channels,
            psnr: -10.0 * (total(|s| s.squared_error) / channels).max(1e-12).log10(),
            samples: self.shards.iter().map(|s| s.sample_count).sum(),
            kept_samples: self.shards.iter().map(|s| s.kept_count).sum(),
            rays,
            latent_gradient,
        }
    }

    /// One Adam step from the shards' gradients, which are zeroed.
    fn update(&mut self) {
        let c = &self.config;
        let n = (self.step + 1).min(100_000) as i32;
        let correction = (1.0 - c.beta2.powi(n)).sqrt() / (1.0 - c.beta1.powi(n));
        let factor = self.learning_rate_factor() * correction;
        let step = |rate: f32, decay: f32| AdamStep {
            rate: rate * factor,
            beta1: c.beta1,
            beta2: c.beta2,
            epsilon: c.epsilon * (1.0 - c.beta2.powi(n)).sqrt(),
            decay,
        };
        let (table_step, network_step) =
            (step(c.learning_rate_table, 0.0), step(c.learning_rate_networks, c.weight_decay));
        let set = self.field.set;
        let [first, second] = &mut self.network_moments;
        let mut gradients: Vec<&mut [f32]> = self.shards.iter_mut().map(|s| &mut s.network_gradient[..]).collect();
        dispatch::adam(set, network_step, false, &mut self.field.networks, first, second, &mut gradients);

        let [first, second] = &mut self.table_moments;
        let mut pieces: Vec<AdamPiece> = self
            .field
            .table
            .chunks_mut(ADAM_PIECE)
            .zip(first.chunks_mut(ADAM_PIECE))
            .zip(second.chunks_mut(ADAM_PIECE))
            .map(|((p, m), v)| (p, m, v, Vec::with_capacity(self.shards.len())))
            .collect();
        for shard in &mut self.shards {
            for (piece, gradient) in pieces.iter_mut().zip(shard.table_gradient.chunks_mut(ADAM_PIECE)) {
                piece.3.push(gradient);
            }
        }
        let run = |(p, m, v, g): &mut AdamPiece| {
            dispatch::adam(set, table_step, true, p, m, v, g);
        };
        match &self.pool {
            Some(pool) => pool.install(|| pieces.par_iter_mut().for_each(run)),
            None => pieces.iter_mut().for_each(run),
        }
    }

    /// Looks at cells of the occupancy grid under every state's latent and keeps the largest density.
    fn refresh_occupancy(&mut self) {
        let c = &self.config;
        let warmup = c.occupancy_warmup_steps;
        if self.state_latents.is_empty() || self.step < warmup {
            return;
        }
        let since = self.step - warmup;
        if !since.is_multiple_of(c.occupancy_interval.max(1)) {
            return;
        }
        let round = hash(c.seed, 0x0cc0, self.step);
        let resolution = self.field.occupancy.resolution();
        let cells = resolution.pow(3);
        // Everything at the end of the warm-up and twice more soon after; later a share of all and of the occupied.
        let full_interval = c.occupancy_interval.max(1) * 8;
        let full = since == 0 || since == full_interval || since == 3 * full_interval;
        self.cells.clear();
        if full {
            self.cells.extend(0..cells as u32);
        } else {
            let half = c.occupancy_cells / 2;
            self.cells.extend((0..half).map(|i| (hash(round, 1, i as u64) % cells as u64) as u32));
            for i in 0..half {
                let start = (hash(round, 2, i as u64) % cells as u64) as usize;
                // The next occupied cell from a random place on; giving up after a while keeps this bounded.
                let found = (0..4096).map(|k| (start + k) % cells).find(|cell| self.field.occupancy.cell(*cell));
                self.cells.extend(found.map(|cell| cell as u32));
            }
            self.cells.sort_unstable();
            self.cells.dedup();
        }
        let latents = self.latents_for(round);
        let found = self.densest(&self.cells, &latents, round);
        for (cell, density) in self.cells.iter().zip(found) {
            let kept = &mut self.cell_density[*cell as usize];
            *kept = (*kept * self.config.occupancy_decay).max(density);
        }
        let mean = self.cell_density.iter().map(|d| f64::from(d.min(1e3))).sum::<f64>() / cells as f64;
        let threshold = (self.config.occupancy_threshold / self.field.marcher.step_m).min(mean as f32);
        let densities = &self.cell_density;
        self.field.occupancy.set_from(|i| densities[i] > threshold);
    }

    /// One latent of each state, another in each round.
    fn latents_for(&self, round: u64) -> Vec<[f32; LATENT_DIM]> {
        self.state_latents
            .iter()
            .enumerate()
            .map(|(s, of_state)| of_state[(hash(round, 3, s as u64) % of_state.len() as u64) as usize])
            .collect()
    }

    /// The largest density under any of the latents, at one random point of each cell.
    fn densest(&self, cells: &[u32], latents: &[[f32; LATENT_DIM]], round: u64) -> Vec<f32> {
        let field = &self.field;
        let look = |cells: &[u32]| -> Vec<f32> {
            let points = self.points_in(cells, round);
            let mut densities = vec![0.0; points.len() * latents.len()];
            field.density_in_cube(&points, latents, &mut densities);
            (0..points.len())
                .map(|p| (0..latents.len()).map(|l| densities[l * points.len() + p]).fold(0.0, f32::max))
                .collect()
        };
        match &self.pool {
            Some(pool) => pool.install(|| cells.par_chunks(CELLS_PIECE).map(look).flatten().collect()),
            None => cells.chunks(CELLS_PIECE).flat_map(look).collect(),
        }
    }

    /// The optimiser's state; with the field's own tensors it is all that is needed to go on bit by bit.
    pub fn state(&self) -> TrainerState<'_> {
        let f = self.field.config.features_per_level;
        let mut tensors = Vec::new();
        for (name, moments) in ["first", "second"].iter().zip(&self.table_moments) {
            tensors.push(NamedTensor {
                name: format!("{name}.grid.table").into(),
                shape: vec![moments.len() / f, f],
                data: moments.into(),
            });
        }
        for (name, moments) in ["first.", "second."].iter().zip(&self.network_moments) {
            tensors.extend(network_tensors(&self.field.layout, moments, name));
        }
        let r = self.field.config.occupancy_resolution;
        tensors.push(NamedTensor {
            name: "occupancy.density".into(),
            shape: vec![r, r, r],
            data: (&self.cell_density).into(),
        });
        tensors.push(NamedTensor { name: "step_scale".into(), shape: vec![1], data: vec![self.step_scale].into() });
        TrainerState { step: self.step, tensors }
    }

    /// A trainer that goes on where `state` was taken. `field` is the field of that moment. The error lists every key
    /// that is missing, unknown or of another shape.
    pub fn from_state(
        field: Field,
        config: TrainerConfig,
        step: u64,
        tensors: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
    ) -> Result<Self, FieldError> {
        let mut trainer = Self::new(field, config)?;
        trainer.step = step;
        let wanted: Vec<(String, Vec<usize>)> =
            trainer.state().tensors.into_iter().map(|t| (t.name.into_owned(), t.shape)).collect();
        let mut seen = vec![false; wanted.len()];
        let mut differences = Vec::new();
        for (name, shape, data) in tensors {
            let Some(at) = wanted.iter().position(|(n, _)| *n == name) else {
                differences.push(format!("`{name}` is not known"));
                continue;
            };
            seen[at] = true;
            if shape != wanted[at].1 || data.len() != shape.iter().product::<usize>() {
                differences.push(format!("`{name}` has shape {shape:?}, wanted {:?}", wanted[at].1));
                continue;
            }
            if data.iter().any(|v| !v.is_finite()) {
                differences.push(format!("`{name}` holds values that are not finite"));
                continue;
            }
            let layout = &trainer.field.layout;
            match name.split_once('.') {
                Some(("first", "grid.table")) => trainer.table_moments[0] = data,
                Some(("second", "grid.table")) => trainer.table_moments[1] = data,
                Some(("first", rest)) => set_network_tensor(layout, &mut trainer.network_moments[0], rest, &data),
                Some(("second", rest)) => set_network_tensor(layout, &mut trainer.network_moments[1], rest, &data),
                _ if name == "step_scale" => trainer.step_scale = data[0],
                _ => trainer.cell_density = data,
            }
        }
        for ((name, _), _) in wanted.iter().zip(&seen).filter(|(_, seen)| !**seen) {
            differences.push(format!("`{name}` is missing"));
        }
        if differences.is_empty() { Ok(trainer) } else { Err(FieldError::Tensors { differences }) }
    }
}

fn random_direction(round: u64, cell: u32) -> [f32; 3] {
    let d = [7, 8, 9].map(|salt| unit(hash(round, salt, u64::from(cell))) - 0.5);
    let n = d.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-3);
    d.map(|v| v / n)
}

/// What all chunks of a step share.
struct Job<'a> {
    field: &'a Field,
    config: &'a TrainerConfig,
    batch: &'a RayBatch,
    order: &'a [u32],
    limits: RayLimits,
    step: u64,
    gradient_scale: f32,
}

impl Shard {
    fn begin(&mut self, latents: usize) {
        self.latent_gradient.clear();
        self.latent_gradient.resize(latents, [0.0; LATENT_DIM]);
        self.loss = 0.0;
        self.squared_error = 0.0;
        self.ray_count = 0;
        self.sample_count = 0;
        self.kept_count = 0;
    }

    /// Forward and backward of one chunk: rays `order[range]`, which share a latent.
    fn chunk(&mut self, job: &Job, range: std::ops::Range<usize>) {
        let field = job.field;
        let order = &job.order[range];
        let latent = job.batch.latent_index[order[0] as usize] as usize;
        self.ray_count += order.len();
        field.fold(&job.batch.latents[latent], &mut self.folded);
        self.rays.clear();
        self.rays.extend(order.iter().map(|i| job.batch.rays[*i as usize]));
        self.targets.clear();
        self.targets.extend(order.iter().map(|i| job.batch.target_rgb[*i as usize]));
        let (seed, step) = (hash(job.config.seed, 0x7261, job.step), job.config.jitter);
        self.samples.march(
            field,
            std::slice::from_ref(&self.folded),
            &self.rays,
            &job.limits,
            &mut self.scratch,
            |i| {
                if step { unit(hash(seed, 1, u64::from(order[i]))) } else { 0.5 }
            },
        );
        self.select(job, order, seed);
        self.background_forward(field);
        self.color_forward(field);
        self.pixel_loss(job);
        self.distortion_loss(job);
        self.sample_gradients();
        let bias = &mut self.backward;
        for (b, layer) in [
            (&mut bias.density_bias, &field.layout.density[0]),
            (&mut bias.color_bias, &field.layout.color[0]),
            (&mut bias.background_bias, &field.layout.background[0]),
        ] {
            b.clear();
            b.resize(layer.outputs, 0.0);
        }
        self.tiles_backward(field);
        self.background_backward(field);
        let z = &self.folded.latent;
        let dz = &mut self.latent_gradient[latent];
        for (bias, layer) in [
            (&self.backward.density_bias, &field.layout.density[0]),
            (&self.backward.color_bias, &field.layout.color[0]),
            (&self.backward.background_bias, &field.layout.background[0]),
        ] {
            layer.fold_backward(&field.networks, z, bias, &mut self.network_gradient, dz);
        }
    }

    /// Which samples get a colour and a gradient: all that weigh something, and a few of the rest by chance.
    fn select(&mut self, job: &Job, order: &[u32], seed: u64) {
        let c = job.config;
        self.kept.clear();
        let samples = &self.samples.seen[0];
        let mut real = 0;
        for i in 0..samples.ray.len() {
            if samples.ray[i] == NO_RAY {
                continue;
            }
            real += 1;
            let keep = if c.roulette_weight > 0.0 {
                (samples.weight[i] / c.roulette_weight).clamp(c.min_keep, 1.0)
            } else {
                1.0
            };
            let ray = u64::from(order[samples.ray[i] as usize]);
            if keep >= 1.0 || unit(hash(seed, 2 + ray, i as u64)) < keep {
                self.kept.push(Kept {
                    sample: i as u32,
                    scale: 1.0 / keep,
                    color: [0.0; 3],
                    color_gradient: [0.0; 3],
                    raw_gradient: 0.0,
                });
            }
        }
        self.sample_count += real;
        self.kept_count += self.kept.len();
    }

    fn background_forward(&mut self, field: &Field) {
        let l = &field.layout;
        let (sd, sh, so) = (stride(l.direction), stride(l.background[0].outputs), stride(4));
        let blocks = self.rays.len().div_ceil(LANES);
        let tile = &mut self.background;
        let inputs = grow(&mut tile.inputs, blocks * sd);
        inputs.fill(0.0);
        for (i, ray) in self.rays.iter().enumerate() {
            let block = &mut inputs[i / LANES * sd..];
            write_direction(block, 0, l.direction, i % LANES, &spherical_harmonics(ray.direction));
        }
        let output = grow(&mut tile.output, blocks * so);
        field.background_network(&self.folded, inputs, grow(&mut tile.color_a, blocks * sh), output);
        self.behind_rgb.clear();
        self.behind_rgb
            .extend((0..self.rays.len()).map(|i| [0, 1, 2].map(|c| output[i / LANES * so + c * LANES + i % LANES])));
    }

    /// Both networks over the kept samples, with all activations stored.
    fn color_forward(&mut self, field: &Field) {
        let l = &field.layout;
        let w = &field.networks;
        let (sf, sw, si, so) = (stride(l.features), stride(l.width), stride(l.color[0].inputs), stride(4));
        let tiles = self.kept.len().div_ceil(GROUP * LANES);
        if self.tiles.len() < tiles {
            self.tiles.resize_with(tiles, Tile::default);
        }
        for (tile, kept) in self.tiles.iter_mut().zip(self.kept.chunks_mut(GROUP * LANES)) {
            let blocks = kept.len().div_ceil(LANES);
            let features = grow(&mut tile.features, blocks * sf);
            let inputs = grow(&mut tile.inputs, blocks * si);
            for at in kept.len()..blocks * LANES {
                for r in 0..l.features {
                    features[at / LANES * sf + r * LANES + at % LANES] = 0.0;
                }
                for r in l.geometry..l.color[0].inputs {
                    inputs[at / LANES * si + r * LANES + at % LANES] = 0.0;
                }
            }
            for (at, k) in kept.iter().enumerate() {
                let i = k.sample as usize;
                let from = &self.samples.features[i / LANES * sf + i % LANES..];
                let to = &mut features[at / LANES * sf + at % LANES..];
                for r in 0..l.features {
                    to[r * LANES] = from[r * LANES];
                }
                let harmonics = spherical_harmonics(self.rays[self.samples.seen[0].ray[i] as usize].direction);
                write_direction(&mut inputs[at / LANES * si..], l.geometry, l.direction, at % LANES, &harmonics);
            }
            let (set, [d0, d1, d2], [c0, c1, c2]) = (field.set, &l.density, &l.color);
            let da = grow(&mut tile.density_a, blocks * sw);
            let db = grow(&mut tile.density_b, blocks * sw);
            dispatch::dense_forward(set, d0.weights(w), &self.folded.density, features, sf, da, sw, true);
            dispatch::dense_forward(set, d1.weights(w), d1.biases(w), da, sw, db, sw, true);
            dispatch::dense_forward(set, d2.weights(w), d2.biases(w), db, sw, inputs, si, false);
            let ca = grow(&mut tile.color_a, blocks * sw);
            let cb = grow(&mut tile.color_b, blocks * sw);
            let output = grow(&mut tile.output, blocks * so);
            dispatch::dense_forward(set, c0.weights(w), &self.folded.color, inputs, si, ca, sw, true);
            dispatch::dense_forward(set, c1.weights(w), c1.biases(w), ca, sw, cb, sw, true);
            dispatch::dense_forward(set, c2.weights(w), c2.biases(w), cb, sw, output, so, false);
            dispatch::logistic(set, output);
            for (at, k) in kept.iter_mut().enumerate() {
                k.color = [0, 1, 2].map(|c| output[at / LANES * so + c * LANES + at % LANES]);
            }
        }
    }

    /// Composites the pixels, and their loss with its gradient.
    fn pixel_loss(&mut self, job: &Job) {
        let c = job.config;
        self.pixel.clear();
        let through = |s: &RayState| s.transmittance;
        self.pixel
            .extend(self.samples.seen[0].rays.iter().zip(&self.behind_rgb).map(|(s, b)| b.map(|v| v * through(s))));
        for k in &self.kept {
            let i = k.sample as usize;
            let pixel = &mut self.pixel[self.samples.seen[0].ray[i] as usize];
            for (p, color) in pixel.iter_mut().zip(&k.color) {
                *p += self.samples.seen[0].weight[i] * color;
            }
        }
        self.pixel_gradient.clear();
        self.through_gradient.clear();
        for ((pixel, target), state) in self.pixel.iter().zip(&self.targets).zip(&self.samples.seen[0].rays) {
            let mut gradient = [0.0; 3];
            for ch in 0..3 {
                let e = pixel[ch] - target[ch];
                self.squared_error += f64::from(e * e);
                let d = c.huber_delta;
                let loss = if e.abs() <= d { 0.5 * e * e } else { d * (e.abs() - 0.5 * d) };
                self.loss += f64::from(loss);
                gradient[ch] = e.clamp(-d, d) * job.gradient_scale;
            }
            self.pixel_gradient.push(gradient);
            let mut through_gradient = 0.0;
            if c.opacity_entropy > 0.0 {
                let t = state.transmittance.clamp(1e-3, 1.0 - 1e-3);
                self.loss -= f64::from(c.opacity_entropy * 3.0 * (t * t.ln() + (1.0 - t) * (1.0 - t).ln()));
                through_gradient = c.opacity_entropy * 3.0 * job.gradient_scale * ((1.0 - t).ln() - t.ln());
            }
            self.through_gradient.push(through_gradient);
        }
    }

    /// The distortion loss over the kept samples (mip-NeRF 360, eq. 15): per ray, the sum over all pairs of
    /// w w' |s - s'|, and a third of the sum of w^2 times the sample's length. Leaves its gradient by each density,
    /// divided by the sample's length, in `raw_gradient`.
    fn distortion_loss(&mut self, job: &Job) {
        let weight_of_loss = 3.0 * job.config.distortion;
        if weight_of_loss <= 0.0 {
            return;
        }
        let (placed, s, marcher) = (&self.samples.placed, &self.samples.seen[0], &job.field.marcher);
        let place = |i: usize| {
            let from = placed.distance_m[i];
            let (from, to) = (marcher.bounded(from), marcher.bounded(from + placed.length_m[i]));
            (0.5 * (from + to), to - from)
        };
        let begin = |sums: &mut Vec<RaySums>| {
            sums.clear();
            sums.resize(self.rays.len(), RaySums::default());
        };
        begin(&mut self.ray_sums);
        for k in &mut self.kept {
            let i = k.sample as usize;
            let (front, w, (at, length)) = (&mut self.ray_sums[s.ray[i] as usize], s.weight[i], place(i));
            let to_front = 2.0 * (at * front.weight - front.moment);
            let own = w * length / 3.0;
            self.loss += f64::from(weight_of_loss * w * (to_front + own));
            k.raw_gradient = to_front + 2.0 * own;
            front.weight += w;
            front.moment += w * at;
        }
        begin(&mut self.ray_sums);
        for k in self.kept.iter_mut().rev() {
            let i = k.sample as usize;
            let (behind, w, (at, _)) = (&mut self.ray_sums[s.ray[i] as usize], s.weight[i], place(i));
            let by_weight = k.raw_gradient + 2.0 * (behind.moment - at * behind.weight);
            k.raw_gradient = weight_of_loss * job.gradient_scale * (s.behind[i] * by_weight - behind.gradient);
            behind.weight += w;
            behind.moment += w * at;
            behind.gradient += w * by_weight;
        }
    }

    /// Gradients by each kept sample's raw colour and raw density (Max 1995; the sum behind a sample, back to front).
    fn sample_gradients(&mut self) {
        let (placed, s) = (&self.samples.placed, &self.samples.seen[0]);
        // From here on `behind_rgb` turns into the colour that arrives from behind each sample.
        let mut arriving: Vec<[f32; 3]> = std::mem::take(&mut self.pixel);
        for ((a, state), b) in arriving.iter_mut().zip(&s.rays).zip(&self.behind_rgb) {
            *a = b.map(|v| v * state.transmittance);
        }
        for k in self.kept.iter_mut().rev() {
            let i = k.sample as usize;
            let ray = s.ray[i] as usize;
            let (g, behind) = (&self.pixel_gradient[ray], &mut arriving[ray]);
            let mut by_density = k.raw_gradient - self.through_gradient[ray] * s.rays[ray].transmittance;
            for c in 0..3 {
                by_density += g[c] * (s.behind[i] * k.color[c] - behind[c]);
                k.color_gradient[c] = k.scale * g[c] * s.weight[i] * k.color[c] * (1.0 - k.color[c]);
                behind[c] += s.weight[i] * k.color[c];
            }
            k.raw_gradient = k.scale * by_density * placed.length_m[i] * s.density[i];
        }
        self.pixel = arriving;
    }

    fn tiles_backward(&mut self, field: &Field) {
        let l = &field.layout;
        let w = &field.networks;
        let set = field.set;
        let (sf, sw, si, so) = (stride(l.features), stride(l.width), stride(l.color[0].inputs), stride(4));
        let gradient = &mut self.network_gradient;
        for (tile, kept) in self.tiles.iter_mut().zip(self.kept.chunks(GROUP * LANES)) {
            let b = &mut self.backward;
            let blocks = kept.len().div_ceil(LANES);
            let d_output = grow(&mut b.output, blocks * so);
            d_output.fill(0.0);
            for (at, k) in kept.iter().enumerate() {
                for c in 0..3 {
                    d_output[at / LANES * so + c * LANES + at % LANES] = k.color_gradient[c];
                }
            }
            let (features, inputs) = (&tile.features[..blocks * sf], &tile.inputs[..blocks * si]);
            let (da, db) = (&tile.density_a[..blocks * sw], &tile.density_b[..blocks * sw]);
            let (ca, cb) = (&tile.color_a[..blocks * sw], &tile.color_b[..blocks * sw]);
            let (ga, gb) = (grow(&mut b.wide_a, blocks * sw), grow(&mut b.wide_b, blocks * sw));
            let g_inputs = grow(&mut b.inputs, blocks * si);
            let g_features = grow(&mut b.features, blocks * sf);
            let mut by_weights = |layer: &crate::layout::Layer, x: &[f32], sx: usize, dy: &[f32], sy: usize| {
                let (dw, db) = gradient[layer.weight..].split_at_mut(layer.bias - layer.weight);
                let (dw, db) = (&mut dw[..layer.inputs * layer.outputs], &mut db[..layer.outputs]);
                dispatch::dense_backward_weights(set, x, sx, dy, sy, dw, db);
            };
            let [d0, d1, d2] = &l.density;
            let [c0, c1, c2] = &l.color;
            by_weights(c2, cb, sw, d_output, so);
            dispatch::dense_backward_input(set, c2.weights(w), c2.outputs, d_output, so, ga, sw, l.width, Some(cb));
            by_weights(c1, ca, sw, ga, sw);
            dispatch::dense_backward_input(set, c1.weights(w), c1.outputs, ga, sw, gb, sw, l.width, Some(ca));
            {
                let dw = c0.weights_mut(gradient);
                dispatch::dense_backward_weights(set, inputs, si, gb, sw, dw, &mut b.color_bias);
            }
            dispatch::dense_backward_input(set, c0.weights(w), c0.outputs, gb, sw, g_inputs, si, l.geometry, None);
            for (at, k) in kept.iter().enumerate() {
                // The clamp of the exponential passes no gradient above its limit, as instant-ngp's does below it.
                g_inputs[at / LANES * si + at % LANES] += k.raw_gradient;
            }
            let mut by_weights = |layer: &crate::layout::Layer, x: &[f32], sx: usize, dy: &[f32], sy: usize| {
                let (dw, db) = gradient[layer.weight..].split_at_mut(layer.bias - layer.weight);
                let (dw, db) = (&mut dw[..layer.inputs * layer.outputs], &mut db[..layer.outputs]);
                dispatch::dense_backward_weights(set, x, sx, dy, sy, dw, db);
            };
            by_weights(d2, db, sw, g_inputs, si);
            dispatch::dense_backward_input(set, d2.weights(w), d2.outputs, g_inputs, si, ga, sw, l.width, Some(db));
            by_weights(d1, da, sw, ga, sw);
            dispatch::dense_backward_input(set, d1.weights(w), d1.outputs, ga, sw, gb, sw, l.width, Some(da));
            {
                let dw = d0.weights_mut(gradient);
                dispatch::dense_backward_weights(set, features, sf, gb, sw, dw, &mut b.density_bias);
            }
            dispatch::dense_backward_input(set, d0.weights(w), d0.outputs, gb, sw, g_features, sf, l.features, None);
            b.points.clear();
            b.points.extend(kept.iter().map(|k| self.samples.placed.points[k.sample as usize]));
            if field.attenuates() {
                b.widths.clear();
                b.widths.extend(kept.iter().map(|k| self.samples.widths[k.sample as usize]));
                for (widths, block) in b.widths.chunks(LANES).zip(g_features.chunks_exact_mut(sf)) {
                    dispatch::attenuate(set, &l.levels, l.features_per_level, widths, block);
                }
            }
            for (points, block) in b.points.chunks(LANES).zip(g_features.chunks_exact(sf)) {
                dispatch::scatter(set, l.features_per_level, &l.levels, &mut self.table_gradient, points, block);
            }
        }
    }

    fn background_backward(&mut self, field: &Field) {
        let l = &field.layout;
        let set = field.set;
        let (sd, sh, so) = (stride(l.direction), stride(l.background[0].outputs), stride(4));
        let blocks = self.rays.len().div_ceil(LANES);
        let b = &mut self.backward;
        let d_output = grow(&mut b.output, blocks * so);
        d_output.fill(0.0);
        let mut any = false;
        for (i, state) in self.samples.seen[0].rays.iter().enumerate() {
            any |= state.transmittance > 1e-3;
            for c in 0..3 {
                let v = self.behind_rgb[i][c];
                d_output[i / LANES * so + c * LANES + i % LANES] =
                    self.pixel_gradient[i][c] * state.transmittance * v * (1.0 - v);
            }
        }
        if !any {
            return;
        }
        let [b0, b1] = &l.background;
        let hidden = &self.background.color_a[..blocks * sh];
        let inputs = &self.background.inputs[..blocks * sd];
        let (dw, db) = self.network_gradient[b1.weight..].split_at_mut(b1.bias - b1.weight);
        dispatch::dense_backward_weights(set, hidden, sh, d_output, so, dw, &mut db[..b1.outputs]);
        let g = grow(&mut b.wide_a, blocks * sh);
        let w = &field.networks;
        dispatch::dense_backward_input(set, b1.weights(w), b1.outputs, d_output, so, g, sh, b0.outputs, Some(hidden));
        let dw = b0.weights_mut(&mut self.network_gradient);
        dispatch::dense_backward_weights(set, inputs, sd, g, sh, dw, &mut b.background_bias);
    }
}

#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
