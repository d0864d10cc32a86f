//! Losses of pixels and samples, and their gradients by raw colours and raw densities.

use super::shard::{Job, Pixels, RaySums, Shard};
use crate::config::TrainerConfig;

/// Transmittances are clamped to this distance from 0 and 1 for the entropy.
const ENTROPY_MARGIN: f32 = 1e-3;
/// Colour channels.
const CHANNELS: f32 = 3.0;

impl Shard {
    /// Composites the pixels, and computes their loss with its gradient.
    pub(super) fn pixel_loss(&mut self, job: &Job<'_>) {
        let samples = &self.samples.by_latent[0];
        let Pixels { rgb, rgb_gradient, transmittance_gradient } = &mut self.pixels;
        rgb.clear();
        rgb.extend(samples.rays.iter().zip(&self.background.rgb).map(|(s, b)| b.map(|v| v * s.transmittance)));
        for k in &self.kept {
            let i = k.index as usize;
            for (p, color) in rgb[samples.ray[i] as usize].iter_mut().zip(&k.color) {
                *p += samples.weight[i] * color;
            }
        }
        rgb_gradient.clear();
        transmittance_gradient.clear();
        for ((pixel, target), state) in rgb.iter().zip(&self.targets).zip(&samples.rays) {
            let mut gradient = [0.0; 3];
            for ch in 0..3 {
                let e = pixel[ch] - target[ch];
                self.sums.squared_error += f64::from(e * e);
                let d = job.config.huber_delta;
                let loss = if e.abs() <= d { 0.5 * e * e } else { d * (e.abs() - 0.5 * d) };
                self.sums.loss += f64::from(loss);
                gradient[ch] = e.clamp(-d, d) * job.gradient_scale;
            }
            rgb_gradient.push(gradient);
            let (loss, gradient) = opacity_entropy(job.config, state.transmittance, job.gradient_scale);
            self.sums.loss -= f64::from(loss);
            transmittance_gradient.push(gradient);
        }
    }

    /// Adds the distortion loss over the kept samples (mip-NeRF 360, eq. 15): per ray, the sum over all pairs of
    /// w w' |s - s'|, and a third of the sum of w^2 times the sample's length. Writes the gradient by each density,
    /// divided by the sample's delta, to `sigma_gradient`.
    pub(super) fn distortion_loss(&mut self, job: &Job<'_>) {
        let loss_weight = CHANNELS * job.config.distortion;
        if loss_weight <= 0.0 {
            return;
        }
        let (points, samples, marcher) = (&self.samples.points, &self.samples.by_latent[0], &job.field.marcher);
        // Centre and length of a sample in bounded distance.
        let interval = |i: usize| {
            let start = points.distance_m[i];
            let (start, end) = (marcher.bounded(start), marcher.bounded(start + points.delta_m[i]));
            (0.5 * (start + end), end - start)
        };
        let reset = |sums: &mut Vec<RaySums>| {
            sums.clear();
            sums.resize(self.rays.len(), RaySums::default());
        };
        reset(&mut self.ray_sums);
        for k in &mut self.kept {
            let i = k.index as usize;
            let (prefix, w) = (&mut self.ray_sums[samples.ray[i] as usize], samples.weight[i]);
            let (center, length) = interval(i);
            let pairs = 2.0 * (center * prefix.weight - prefix.moment);
            let own = w * length / 3.0;
            self.sums.loss += f64::from(loss_weight * w * (pairs + own));
            k.sigma_gradient = pairs + 2.0 * own;
            prefix.weight += w;
            prefix.moment += w * center;
        }
        reset(&mut self.ray_sums);
        for k in self.kept.iter_mut().rev() {
            let i = k.index as usize;
            let (suffix, w) = (&mut self.ray_sums[samples.ray[i] as usize], samples.weight[i]);
            let (center, _) = interval(i);
            let by_weight = k.sigma_gradient + 2.0 * (suffix.moment - center * suffix.weight);
            k.sigma_gradient =
                loss_weight * job.gradient_scale * (samples.transmittance[i] * by_weight - suffix.gradient);
            suffix.weight += w;
            suffix.moment += w * center;
            suffix.gradient += w * by_weight;
        }
    }

    /// Computes the gradients by each kept sample's raw colour and raw density (Max 1995), back to front. Afterwards
    /// `pixels.rgb` holds each ray's suffix: the light that the background and all kept samples send to the camera.
    pub(super) fn sample_gradients(&mut self) {
        let (points, samples) = (&self.samples.points, &self.samples.by_latent[0]);
        let Pixels { rgb: suffixes, rgb_gradient, transmittance_gradient } = &mut self.pixels;
        for ((suffix, state), background) in suffixes.iter_mut().zip(&samples.rays).zip(&self.background.rgb) {
            *suffix = background.map(|v| v * state.transmittance);
        }
        for k in self.kept.iter_mut().rev() {
            let i = k.index as usize;
            let ray = samples.ray[i] as usize;
            let (g, suffix) = (&rgb_gradient[ray], &mut suffixes[ray]);
            let mut by_sigma = k.sigma_gradient - transmittance_gradient[ray] * samples.rays[ray].transmittance;
            for c in 0..3 {
                by_sigma += g[c] * (samples.transmittance[i] * k.color[c] - suffix[c]);
                k.color_gradient[c] = k.scale * g[c] * samples.weight[i] * k.color[c] * (1.0 - k.color[c]);
                suffix[c] += samples.weight[i] * k.color[c];
            }
            k.sigma_gradient = k.scale * by_sigma * points.delta_m[i] * samples.sigma[i];
        }
    }
}

/// Returns the loss of a ray's opacity, to be subtracted, and the loss's gradient by the transmittance.
fn opacity_entropy(config: &TrainerConfig, transmittance: f32, gradient_scale: f32) -> (f32, f32) {
    let weight = config.opacity_entropy * CHANNELS;
    if weight <= 0.0 {
        return (0.0, 0.0);
    }
    let t = transmittance.clamp(ENTROPY_MARGIN, 1.0 - ENTROPY_MARGIN);
    let loss = weight * (t * t.ln() + (1.0 - t) * (1.0 - t).ln());
    (loss, weight * gradient_scale * ((1.0 - t).ln() - t.ln()))
}
