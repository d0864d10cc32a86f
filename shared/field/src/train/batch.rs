//! Batches of rays, and the report of a training step.

use carff_base::geometry::Ray;

use crate::config::LATENT_DIM;

/// Rays with their target colours. The first three lists have one entry for each ray.
#[derive(Clone, Debug, Default)]
pub struct RayBatch {
    /// The rays.
    pub rays: Vec<Ray>,
    /// Target colours, 0..=1.
    pub target_rgb: Vec<[f32; 3]>,
    /// For each ray, the index of its latent in `latents`.
    pub latent_index: Vec<u32>,
    /// The latents of this batch.
    pub latents: Vec<[f32; LATENT_DIM]>,
}

/// Loss and counts of one training step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Mean loss over rays and channels: Huber loss, opacity entropy and distortion.
    pub loss: f64,
    /// Peak signal-to-noise ratio of the batch's colours, dB.
    pub psnr: f64,
    /// Samples whose density was evaluated.
    pub samples: usize,
    /// Samples that got a colour and a gradient.
    pub kept_samples: usize,
    /// Rays that were used.
    pub rays: usize,
    /// Gradient of the loss by each latent of the batch; empty unless requested.
    pub latent_gradient: Vec<[f32; LATENT_DIM]>,
}
