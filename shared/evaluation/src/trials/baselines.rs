//! Baselines of the trials: observers that use less than the whole system, or know more.

use super::views::TrialView;
use crate::PosedImages;
use carff_dataset::Image;
use carff_messages::{Gaussian, LATENT_DIM};

/// Side of the thumbnails of the nearest neighbour.
const THUMBNAIL: usize = 16;

/// Gradient steps of the read-out, and their length. The loss is convex and has 9 parameters a state.
const STEPS: usize = 2000;
const RATE: f64 = 0.5;
/// Weight of the squared weights of the read-out.
const RIDGE: f64 = 1e-4;

/// Means over the cells of a 16 x 16 grid, 3 channels each.
fn thumbnail(image: &Image) -> Vec<f32> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let mut sums = vec![0.0_f32; THUMBNAIL * THUMBNAIL * 3];
    let mut counts = vec![0.0_f32; THUMBNAIL * THUMBNAIL];
    for (i, pixel) in image.rgb.chunks_exact(3).enumerate() {
        let cell = (i / width * THUMBNAIL / height) * THUMBNAIL + i % width * THUMBNAIL / width;
        counts[cell] += 1.0;
        pixel.iter().enumerate().for_each(|(c, &v)| sums[cell * 3 + c] += f32::from(v));
    }
    sums.iter().enumerate().map(|(i, sum)| sum / counts[i / 3].max(1.0)).collect()
}

/// Hazard probability (0 or 1) of each view: that of the nearest image of trained poses by thumbnail. With
/// `leave_out`, images of the view's own pose are left out.
pub fn nearest_neighbour(posed: &PosedImages, views: &[TrialView], leave_out: bool) -> Vec<f64> {
    let scenario = &posed.scenario;
    let known: Vec<(usize, bool, Vec<f32>)> = posed
        .trained()
        .into_iter()
        .filter(|&i| scenario.timestamp_of(posed.labels[i].state) + 1 < scenario.timestamps)
        .map(|i| {
            let label = posed.labels[i];
            (label.view, scenario.is_hazard(scenario.branch_of(label.state)), thumbnail(&posed.images[i]))
        })
        .collect();
    let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    views
        .iter()
        .map(|view| {
            let own = thumbnail(view.image);
            let others = known.iter().filter(|(pose, ..)| !leave_out || *pose != view.pose);
            let nearest = others.min_by(|a, b| distance(&a.2, &own).total_cmp(&distance(&b.2, &own)));
            nearest.map_or(0.5, |&(_, hazard, _)| f64::from(u8::from(hazard)))
        })
        .collect()
}

/// Multinomial logistic regression from a posterior's mean to the hazard: encoder and read-out without field and
/// forecast. Its targets are the exact hazard probabilities of the trained images.
pub struct ReadOut {
    mean: [f64; LATENT_DIM],
    scale: [f64; LATENT_DIM],
    /// Weights and offset of each state.
    weights: Vec<[f64; LATENT_DIM + 1]>,
    hazard_states: Vec<bool>,
}

impl ReadOut {
    /// Fits the read-out on the images of trained poses at all time steps but the last. `posteriors` has one posterior
    /// for each image of the dataset.
    pub fn fit(posed: &PosedImages, posteriors: &[Gaussian]) -> Self {
        let scenario = &posed.scenario;
        let states = scenario.state_count();
        let is_input = |state: usize| scenario.timestamp_of(state) + 1 < scenario.timestamps;
        let rows: Vec<usize> = posed.trained().into_iter().filter(|&i| is_input(posed.labels[i].state)).collect();
        let n = rows.len().max(1) as f64;
        let value = |i: usize, d: usize| f64::from(posteriors[i].mean[d]);
        let mean: [f64; LATENT_DIM] = std::array::from_fn(|d| rows.iter().map(|&i| value(i, d)).sum::<f64>() / n);
        let scale = std::array::from_fn(|d| {
            let variance = rows.iter().map(|&i| (value(i, d) - mean[d]).powi(2)).sum::<f64>() / n;
            1.0 / variance.sqrt().max(1e-6)
        });
        let hazard_states = (0..states).map(|state| scenario.is_hazard(scenario.branch_of(state))).collect();
        let mut this = Self { mean, scale, weights: vec![[0.0; LATENT_DIM + 1]; states], hazard_states };
        let targets: Vec<Vec<f64>> = rows
            .iter()
            .map(|&i| {
                let label = posed.labels[i];
                let mut alike = posed.equivalent_states(label.view, label.state);
                alike.retain(|&state| is_input(state));
                let share = 1.0 / alike.len().max(1) as f64;
                (0..states).map(|state| if alike.contains(&state) { share } else { 0.0 }).collect()
            })
            .collect();
        let inputs: Vec<[f64; LATENT_DIM + 1]> = rows.iter().map(|&i| this.input(&posteriors[i])).collect();
        for _ in 0..STEPS {
            let mut gradient = vec![[0.0; LATENT_DIM + 1]; states];
            for (input, target) in inputs.iter().zip(&targets) {
                for (state, p) in this.probabilities(input).into_iter().enumerate() {
                    let error = (p - target[state]) / n;
                    gradient[state].iter_mut().zip(input).for_each(|(g, x)| *g += error * x);
                }
            }
            for (weights, gradient) in this.weights.iter_mut().zip(&gradient) {
                weights.iter_mut().zip(gradient).for_each(|(w, g)| *w -= RATE * (g + RIDGE * *w));
            }
        }
        this
    }

    fn input(&self, posterior: &Gaussian) -> [f64; LATENT_DIM + 1] {
        let standard = |d: usize| (f64::from(posterior.mean[d]) - self.mean[d]) * self.scale[d];
        std::array::from_fn(|d| if d < LATENT_DIM { standard(d) } else { 1.0 })
    }

    fn probabilities(&self, input: &[f64; LATENT_DIM + 1]) -> Vec<f64> {
        let logits: Vec<f64> = self.weights.iter().map(|w| w.iter().zip(input).map(|(w, x)| w * x).sum()).collect();
        let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let shares: Vec<f64> = logits.iter().map(|logit| (logit - top).exp()).collect();
        let sum: f64 = shares.iter().sum();
        shares.into_iter().map(|share| share / sum).collect()
    }

    /// Returns the hazard probability of a posterior, 0..=1.
    pub fn hazard_probability(&self, posterior: &Gaussian) -> f64 {
        let probabilities = self.probabilities(&self.input(posterior)).into_iter();
        probabilities.zip(&self.hazard_states).filter(|(_, hazard)| **hazard).map(|(p, _)| p).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cells are means of their pixels; a side that 16 does not divide has cells of unequal size.
    #[test]
    fn thumbnails_are_means() {
        let mut image = Image::filled(40, 20, [10, 20, 30]);
        assert!(thumbnail(&image).chunks(3).all(|c| c == [10.0, 20.0, 30.0]));
        image.rgb[0] = 70;
        let [first, second] = [0, 1].map(|cell| thumbnail(&image)[cell * 3]);
        assert!(first > 10.0 && first < 70.0 && second == 10.0, "{first} {second}");
    }
}
