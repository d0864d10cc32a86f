//! Rays, the samples along them, and pixels: volume rendering and the loss, with gradients.

use super::{ReferenceField, spherical_harmonics};
use carff_base::geometry::Ray;
use carff_field::RaySamples;
use tch::{Device, Kind, Tensor};

/// Rays as tensors.
#[derive(Debug)]
pub struct Rays {
    origins_m: Tensor,
    directions: Tensor,
    harmonics: Tensor,
    spreads: Tensor,
}

impl Rays {
    /// Converts rays; `degree` is the field's `direction_degree`.
    pub fn new(rays: &[Ray], degree: usize) -> Self {
        let flat = |part: fn(&Ray) -> &[f32; 3]| {
            let values: Vec<f32> = rays.iter().flat_map(|r| part(r).iter().copied()).collect();
            Tensor::from_slice(&values).view([-1, 3])
        };
        let directions = flat(|r| &r.direction);
        let spreads: Vec<f32> = rays.iter().map(|r| r.spread).collect();
        Self {
            origins_m: flat(|r| &r.origin),
            harmonics: spherical_harmonics(&directions, degree),
            directions,
            spreads: Tensor::from_slice(&spreads),
        }
    }

    /// Returns the number of rays.
    pub fn count(&self) -> i64 {
        self.origins_m.size()[0]
    }
}

/// Samples along rays as tensors, sorted by ray.
#[derive(Debug)]
pub struct Samples {
    ray: Tensor,
    distance_m: Tensor,
    delta_m: Tensor,
    /// For each sample the index of its ray's first sample.
    start: Tensor,
}

impl Samples {
    /// Converts the samples that the native field chose; the tensor library does not march.
    pub fn new(samples: &RaySamples) -> Self {
        let mut start = Vec::with_capacity(samples.ray.len());
        for (i, ray) in samples.ray.iter().enumerate() {
            let same = i > 0 && samples.ray[i - 1] == *ray;
            start.push(if same { start[i - 1] } else { i as i64 });
        }
        let ray: Vec<i64> = samples.ray.iter().map(|&r| i64::from(r)).collect();
        Self {
            ray: Tensor::from_slice(&ray),
            distance_m: Tensor::from_slice(&samples.distance_m),
            delta_m: Tensor::from_slice(&samples.delta_m),
            start: Tensor::from_slice(&start),
        }
    }

    /// Returns the number of samples.
    pub fn count(&self) -> i64 {
        self.ray.size()[0]
    }

    /// Computes the world points of samples `first..first + count`, `[count, 3]`.
    fn points_m(&self, rays: &Rays, first: i64, count: i64) -> Tensor {
        let ray = self.ray.narrow(0, first, count);
        let distance = self.distance_m.narrow(0, first, count).unsqueeze(1);
        rays.origins_m.index_select(0, &ray) + distance * rays.directions.index_select(0, &ray)
    }

    /// Computes the widths of samples `first..first + count`, metres, `[count]`.
    fn widths_m(&self, rays: &Rays, first: i64, count: i64) -> Tensor {
        let ray = self.ray.narrow(0, first, count);
        self.distance_m.narrow(0, first, count) * rays.spreads.index_select(0, &ray)
    }

    /// Computes the weight of each sample and the transmittance of each ray (Max 1995) from densities.
    fn weights(&self, density: &Tensor, rays: i64) -> (Tensor, Tensor) {
        let depth = (density * &self.delta_m).to_kind(Kind::Double);
        let before = depth.cumsum(0, Kind::Double) - &depth;
        let in_front = &before - before.index_select(0, &self.start);
        let weight = in_front.neg().exp().to_kind(Kind::Float) * depth.neg().expm1().neg().to_kind(Kind::Float);
        let whole = Tensor::zeros([rays], (Kind::Double, Device::Cpu)).index_add(0, &self.ray, &depth);
        (weight, whole.neg().exp().to_kind(Kind::Float))
    }
}

impl ReferenceField {
    /// Computes pixels `[R, 3]`, with gradients. `latent` is `[8]` for all rays or `[R, 8]`.
    pub fn pixels(&self, rays: &Rays, samples: &Samples, latent: &Tensor) -> Tensor {
        let of_samples = if latent.dim() == 1 { latent.shallow_clone() } else { latent.index_select(0, &samples.ray) };
        let (points_m, widths_m) =
            (samples.points_m(rays, 0, samples.count()), samples.widths_m(rays, 0, samples.count()));
        let geometry = self.geometry(&points_m, Some(&widths_m), &of_samples);
        let (weight, transmittance) = samples.weights(&self.activate(&geometry), rays.count());
        let color = self.color(&geometry, &rays.harmonics.index_select(0, &samples.ray), &of_samples);
        let beyond = self.background(&rays.harmonics, latent) * transmittance.unsqueeze(1);
        beyond.index_add(0, &samples.ray, &(color * weight.unsqueeze(1)))
    }

    /// Renders pixels `[R, 3]` without gradients, `chunk` samples at a time. Samples of weight `min_weight` or less
    /// take the mean colour of their ray's other samples (the heaviest sample always has its own colour).
    pub fn render(&self, rays: &Rays, samples: &Samples, latent: &Tensor, min_weight: f64, chunk: i64) -> Tensor {
        let chunks = |count: i64| (0..count).step_by(chunk.max(1) as usize).map(move |at| (at, chunk.min(count - at)));
        tch::no_grad(|| {
            let geometry: Vec<Tensor> = chunks(samples.count())
                .map(|(first, count)| {
                    let widths_m = samples.widths_m(rays, first, count);
                    self.geometry(&samples.points_m(rays, first, count), Some(&widths_m), latent)
                })
                .collect();
            let mut pixels = self.background(&rays.harmonics, latent);
            if geometry.is_empty() {
                return pixels;
            }
            let geometry = Tensor::cat(&geometry, 0);
            let (weight, transmittance) = samples.weights(&self.activate(&geometry), rays.count());
            pixels *= transmittance.unsqueeze(1);
            let per_ray = || Tensor::zeros([rays.count()], (Kind::Float, Device::Cpu));
            let heaviest = per_ray().index_reduce(0, &samples.ray, &weight, "amax", true);
            let kept = weight.gt(min_weight).logical_or(&weight.ge_tensor(&heaviest.index_select(0, &samples.ray)));
            let kept = kept.logical_and(&weight.gt(0.0)).nonzero().view(-1);
            let kept_weight = weight.index_select(0, &kept);
            let kept_ray = samples.ray.index_select(0, &kept);
            let whole = per_ray().index_add(0, &samples.ray, &weight);
            let colored = per_ray().index_add(0, &kept_ray, &kept_weight).clamp_min(1e-30);
            let weight = kept_weight * (whole / colored).index_select(0, &kept_ray);
            for (first, count) in chunks(kept.size()[0]) {
                let weight = weight.narrow(0, first, count);
                let kept = kept.narrow(0, first, count);
                let ray = samples.ray.index_select(0, &kept);
                let harmonics = rays.harmonics.index_select(0, &ray);
                let color = self.color(&geometry.index_select(0, &kept), &harmonics, latent);
                let _ = pixels.index_add_(0, &ray, &(color * weight.unsqueeze(1)));
            }
            pixels
        })
    }
}

/// Computes the sum of the Huber loss over pixels and channels: 0.5 e^2 up to `delta`, linear beyond.
pub fn huber_sum(pixels: &Tensor, targets: &Tensor, delta: f64) -> Tensor {
    let error = (pixels - targets).abs();
    let near = error.clamp_max(delta);
    (near.square() * 0.5 + (error - &near) * delta).sum(Kind::Float)
}
