//! Samples along rays as lists, for measurements and parity tests.

use carff_base::geometry::Ray;

use super::samples::{March, MarchScratch, NO_RAY, RayLimits, Samples};
use crate::config::LATENT_DIM;
use crate::model::field::{Field, Folded};

/// Rays that are marched together.
const CHUNK: usize = 64;

/// Samples along rays, sorted by ray and along each ray. All lists but the last have one entry for each sample.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RaySamples {
    /// Index of the sample's ray.
    pub ray: Vec<u32>,
    /// Distance from the ray's origin, metres.
    pub distance_m: Vec<f32>,
    /// Delta: the length of ray that the sample represents, metres.
    pub delta_m: Vec<f32>,
    /// Weight: the share of the ray's light that comes from the sample, 0..=1.
    pub weight: Vec<f32>,
    /// Transmittance of each ray after all of its samples, 0..=1.
    pub transmittance: Vec<f32>,
}

impl RaySamples {
    fn clear(&mut self) {
        self.ray.clear();
        for list in [&mut self.distance_m, &mut self.delta_m, &mut self.weight, &mut self.transmittance] {
            list.clear();
        }
    }

    /// Appends the samples of a chunk of rays, numbered from `first`.
    fn append(&mut self, samples: &Samples, first: usize) {
        let (points, of_latent) = (&samples.points, &samples.by_latent[0]);
        // Waves alternate between rays; a stable sort by ray keeps the order along each ray.
        let mut order: Vec<usize> = (0..points.len()).filter(|i| of_latent.ray[*i] != NO_RAY).collect();
        order.sort_by_key(|i| of_latent.ray[*i]);
        for i in order {
            self.ray.push(first as u32 + of_latent.ray[i]);
            self.distance_m.push(points.distance_m[i]);
            self.delta_m.push(points.delta_m[i]);
            self.weight.push(of_latent.weight[i]);
        }
        self.transmittance.extend(of_latent.rays.iter().map(|r| r.transmittance));
    }
}

impl Field {
    /// Lists the samples along rays that rendering, or training without jitter, uses under one latent. For measurements
    /// and parity tests; rendering itself keeps no such lists.
    pub fn samples_along(&self, rays: &[Ray], latent: &[f32; LATENT_DIM], limits: &RayLimits, out: &mut RaySamples) {
        let limits = RayLimits { max_samples: limits.max_samples.max(1), ..*limits };
        let (mut samples, mut scratch, mut folded) = (Samples::default(), MarchScratch::default(), Folded::default());
        self.fold(latent, &mut folded);
        out.clear();
        for (c, rays) in rays.chunks(CHUNK).enumerate() {
            let march = March { field: self, latents: std::slice::from_ref(&folded), rays, limits };
            samples.march(&march, &mut scratch, |_| 0.5);
            out.append(&samples, c * CHUNK);
        }
    }
}
