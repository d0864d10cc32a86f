//! One shard of a batch: its gradients, and the way of a chunk of rays through forward, losses and backward.

use std::ops::Range;

use carff_base::geometry::Ray;

use super::batch::RayBatch;
use crate::config::{LATENT_DIM, TrainerConfig};
use crate::kernels::block::BlockBuffer;
use crate::kernels::math::{hash, unit};
use crate::march::samples::{March, MarchScratch, NO_RAY, RayLimits, Samples};
use crate::model::field::{Field, Folded};
use crate::model::network::Hidden;

/// The data that all chunks of a step share.
pub(super) struct Job<'a> {
    pub field: &'a Field,
    pub config: &'a TrainerConfig,
    pub batch: &'a RayBatch,
    /// Indices of the rays that are used, sorted by latent.
    pub order: &'a [u32],
    pub limits: RayLimits,
    pub step: u64,
    /// 1 / (rays x channels).
    pub gradient_scale: f32,
}

/// Activations of a group of blocks, from the forward pass to the backward pass.
#[derive(Debug, Default)]
pub(super) struct Tile {
    pub features: BlockBuffer,
    pub density_hidden: Hidden,
    pub color_inputs: BlockBuffer,
    pub color_hidden: Hidden,
    pub output: BlockBuffer,
}

/// Activations of the background network.
#[derive(Debug, Default)]
pub(super) struct Background {
    pub directions: BlockBuffer,
    pub hidden: Hidden,
    pub output: BlockBuffer,
    /// The colour of each ray.
    pub rgb: Vec<[f32; 3]>,
}

/// Gradients by the folded biases of the first layers.
#[derive(Debug, Default)]
pub(super) struct FoldedGradients {
    pub density: Vec<f32>,
    pub color: Vec<f32>,
    pub background: Vec<f32>,
}

/// Gradients by the activations of one tile.
#[derive(Debug, Default)]
pub(super) struct TileGradients {
    pub output: BlockBuffer,
    pub hidden: Hidden,
    pub color_inputs: BlockBuffer,
    pub features: BlockBuffer,
    pub points: Vec<[f32; 3]>,
    pub widths: Vec<f32>,
}

/// A sample that gets a colour and a gradient.
#[derive(Clone, Copy, Debug)]
pub(super) struct KeptSample {
    pub index: u32,
    /// 1 / probability of having been kept.
    pub scale: f32,
    pub color: [f32; 3],
    /// Gradient by the raw colour.
    pub color_gradient: [f32; 3],
    /// Gradient by the raw density.
    pub sigma_gradient: f32,
}

/// Loss of the pixels of a chunk, with its gradients.
#[derive(Debug, Default)]
pub(super) struct Pixels {
    pub rgb: Vec<[f32; 3]>,
    pub rgb_gradient: Vec<[f32; 3]>,
    /// Gradient of the opacity's loss by the rays' transmittances.
    pub transmittance_gradient: Vec<f32>,
}

/// Sums over the samples of a ray before a sample (prefix) or after it (suffix).
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RaySums {
    /// Weights.
    pub weight: f32,
    /// Weights times positions.
    pub moment: f32,
    /// Weights times the loss's gradients by them.
    pub gradient: f32,
}

/// Sums of a shard over its rays.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sums {
    pub loss: f64,
    pub squared_error: f64,
    pub rays: usize,
    pub samples: usize,
    pub kept_samples: usize,
}

/// Gradients and buffers of one shard of the batch; the order of its sums does not depend on threads.
#[derive(Debug, Default)]
pub(super) struct Shard {
    pub table_gradient: Vec<f32>,
    pub network_gradient: Vec<f32>,
    pub latent_gradient: Vec<[f32; LATENT_DIM]>,
    pub sums: Sums,
    pub rays: Vec<Ray>,
    pub targets: Vec<[f32; 3]>,
    pub folded: Folded,
    pub samples: Samples,
    pub kept: Vec<KeptSample>,
    pub tiles: Vec<Tile>,
    pub background: Background,
    pub pixels: Pixels,
    pub tile_gradients: TileGradients,
    pub folded_gradients: FoldedGradients,
    pub ray_sums: Vec<RaySums>,
    scratch: MarchScratch,
}

impl FoldedGradients {
    fn begin(&mut self, folded: &Folded) {
        for (gradient, bias) in [
            (&mut self.density, &folded.density),
            (&mut self.color, &folded.color),
            (&mut self.background, &folded.background),
        ] {
            gradient.clear();
            gradient.resize(bias.len(), 0.0);
        }
    }
}

impl Shard {
    /// Makes a shard with gradients of zero.
    pub fn new(field: &Field) -> Self {
        Self {
            table_gradient: vec![0.0; field.table.len()],
            network_gradient: vec![0.0; field.networks.len()],
            ..Self::default()
        }
    }

    /// Begins a step.
    pub fn begin(&mut self, latents: usize) {
        self.latent_gradient.clear();
        self.latent_gradient.resize(latents, [0.0; LATENT_DIM]);
        self.sums = Sums::default();
    }

    /// Forward and backward of one chunk: the rays `order[range]`, which share a latent.
    pub fn chunk(&mut self, job: &Job<'_>, range: Range<usize>) {
        let field = job.field;
        let order = &job.order[range];
        let latent = job.batch.latent_index[order[0] as usize] as usize;
        field.fold(&job.batch.latents[latent], &mut self.folded);
        self.march(job, order);
        self.background_forward(field);
        self.color_forward(field);
        self.pixel_loss(job);
        self.distortion_loss(job);
        self.sample_gradients();
        self.folded_gradients.begin(&self.folded);
        self.tiles_backward(field);
        self.background_backward(field);
        let gradients = &self.folded_gradients;
        for (gradient, layer) in [
            (&gradients.density, &field.layout.density.layers[0]),
            (&gradients.color, &field.layout.color.layers[0]),
            (&gradients.background, &field.layout.background.layers[0]),
        ] {
            layer.fold_backward(
                &field.networks,
                &self.folded.latent,
                gradient,
                &mut self.network_gradient,
                &mut self.latent_gradient[latent],
            );
        }
    }

    /// Marches the rays of a chunk and selects samples.
    fn march(&mut self, job: &Job<'_>, order: &[u32]) {
        self.sums.rays += order.len();
        self.rays.clear();
        self.rays.extend(order.iter().map(|i| job.batch.rays[*i as usize]));
        self.targets.clear();
        self.targets.extend(order.iter().map(|i| job.batch.target_rgb[*i as usize]));
        let seed = hash(job.config.seed, 0x7261, job.step);
        let jitter = |ray: usize| {
            if job.config.jitter { unit(hash(seed, 1, u64::from(order[ray]))) } else { 0.5 }
        };
        let latents = std::slice::from_ref(&self.folded);
        let march = March { field: job.field, latents, rays: &self.rays, limits: job.limits };
        self.samples.march(&march, &mut self.scratch, jitter);
        self.select(job, order, seed);
    }

    /// Selects the samples that get a colour and a gradient: all of enough weight, and a few of the others by chance.
    fn select(&mut self, job: &Job<'_>, order: &[u32], seed: u64) {
        let c = job.config;
        self.kept.clear();
        let samples = &self.samples.by_latent[0];
        for (i, (ray, weight)) in samples.ray.iter().zip(&samples.weight).enumerate() {
            if *ray == NO_RAY {
                continue;
            }
            self.sums.samples += 1;
            let probability =
                if c.roulette_weight > 0.0 { (weight / c.roulette_weight).clamp(c.min_keep, 1.0) } else { 1.0 };
            let draw = 2 + u64::from(order[*ray as usize]);
            if probability >= 1.0 || unit(hash(seed, draw, i as u64)) < probability {
                self.kept.push(KeptSample {
                    index: i as u32,
                    scale: 1.0 / probability,
                    color: [0.0; 3],
                    color_gradient: [0.0; 3],
                    sigma_gradient: 0.0,
                });
            }
        }
        self.sums.kept_samples += self.kept.len();
    }
}
