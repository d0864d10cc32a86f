//! Inputs of the field's benchmark: points, latents, and the rays of a training step.

use crate::reference::{Rays, Samples};
use carff_base::geometry::Ray;
use carff_base::random::{Key, gaussians, uniform};
use carff_field::{FieldConfig, LATENT_DIM, RayBatch, RaySamples};
use tch::Tensor;

/// Rays of a training step.
pub(super) const TRAINING_RAYS: usize = 4096;

/// Part of a training batch, as tensors.
pub(super) struct Piece {
    pub(super) rays: Rays,
    pub(super) samples: Samples,
    pub(super) latents: Tensor,
    pub(super) targets: Tensor,
}

/// Splits a batch into pieces of `size` rays.
pub(super) fn pieces(batch: &RayBatch, samples: &RaySamples, size: usize, degree: usize) -> Vec<Piece> {
    let flat = |rows: Vec<f32>, width: i64| Tensor::from_slice(&rows).view([-1, width]);
    (0..batch.rays.len())
        .step_by(size.max(1))
        .map(|first| {
            let range = first..(first + size).min(batch.rays.len());
            let from = samples.ray.partition_point(|r| (*r as usize) < range.start);
            let to = samples.ray.partition_point(|r| (*r as usize) < range.end);
            let own = RaySamples {
                ray: samples.ray[from..to].iter().map(|r| r - first as u32).collect(),
                distance_m: samples.distance_m[from..to].to_vec(),
                delta_m: samples.delta_m[from..to].to_vec(),
                ..RaySamples::default()
            };
            let latents = batch.latent_index[range.clone()].iter().flat_map(|l| batch.latents[*l as usize]).collect();
            let targets = batch.target_rgb[range.clone()].iter().flatten().copied().collect();
            Piece {
                rays: Rays::new(&batch.rays[range], degree),
                samples: Samples::new(&own),
                latents: flat(latents, LATENT_DIM as i64),
                targets: flat(targets, 3),
            }
        })
        .collect()
}

/// Returns rays from around the bounds into them, of any state. Their target colours do not affect the speed.
pub(super) fn training_batch(config: &FieldConfig, states: &[[f32; LATENT_DIM]]) -> RayBatch {
    let [low, high] = config.bounds_m;
    let mut batch = RayBatch { latents: states.to_vec(), ..RayBatch::default() };
    for i in 0..TRAINING_RAYS {
        let at = |k: u32| uniform(Key { seed: 7, frame: i as u64, step: k, sample: 0 }) as f32;
        let angle = std::f32::consts::TAU * at(0);
        let radius = 0.5 * (high[0] - low[0]).max(high[1] - low[1]);
        let origin = [
            0.5 * (low[0] + high[0]) + radius * angle.cos(),
            0.5 * (low[1] + high[1]) + radius * angle.sin(),
            low[2] + 1.0 + 8.0 * at(1),
        ];
        let target = random_point(config, i as u64);
        let d: [f32; 3] = std::array::from_fn(|k| target[k] - origin[k]);
        let n = d.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-6);
        // The width of a pixel in an image of 128 x 128 pixels with a field of view of 60 degrees.
        batch.rays.push(Ray { origin, direction: d.map(|v| v / n), spread: 0.009 });
        batch.target_rgb.push([at(2), at(3), at(4)]);
        batch.latent_index.push((i % states.len()) as u32);
    }
    batch
}

/// Returns a point in the bounds, by its number.
pub(super) fn random_point(config: &FieldConfig, i: u64) -> [f32; 3] {
    let [low, high] = config.bounds_m;
    std::array::from_fn(|k| {
        let at = uniform(Key { seed: 3, frame: i, step: k as u32, sample: 0 }) as f32;
        low[k] + (high[k] - low[k]) * at
    })
}

/// Returns a latent of the standard normal distribution, by its number.
pub(super) fn random_latent(i: u64) -> [f32; LATENT_DIM] {
    gaussians(Key { seed: 5, frame: i, step: 0, sample: 0 })
}
