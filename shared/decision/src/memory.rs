//! Memory: the belief over the next state, given all frames of a take so far (paper section 3.2, with observations).
//!
//! The belief is carried from frame to frame as weighted samples: the posteriors that represent the known states. A new
//! image weighs them by its forecast, and when a time step has passed, the mixture density network moves them. An image's
//! forecast holds the prior, by which it is divided. Images that follow each other err alike, so evidence that repeats
//! that of the image before counts by a learned share only.

use crate::Mixture;
use carff_messages::{Gaussian, LATENT_DIM, MAX_COMPONENTS};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest squared distance of a component from the nearest known state, in deviations: 99.9 % of the components of a
/// state's images are within 26 (chi-squared, 8 dimensions). Memory does not change components that are further away.
const LARGEST_DISTANCE: f64 = 26.0;
/// Smallest weight of a state in the belief: no evidence excludes a state forever.
const SMALLEST: f64 = 1e-6;

/// The two learned numbers of the memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MemorySettings {
    /// Share of an image's evidence that counts where it repeats that of the image before, 0 (ten like images are one)
    /// to 1 (they are ten).
    #[schemars(range(min = 0.0, max = 1.0))]
    pub repeated_share: f64,
    /// Share of the images whose forecast is not related to the scene, 0 to 1.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub distrust: f64,
}

impl MemorySettings {
    /// Returns the part of an image's evidence that does not count, because it repeats that of the image before. Both are
    /// logarithms of likelihood ratios.
    pub(crate) fn repeated(&self, evidence: f64, before: f64) -> f64 {
        if evidence * before > 0.0 {
            (1.0 - self.repeated_share) * evidence.abs().min(before.abs()).copysign(evidence)
        } else {
            0.0
        }
    }
}

/// Memory of one camera's frames.
///
/// ```
/// use carff_decision::{Memory, Mixture, MemorySettings};
/// use carff_messages::Gaussian;
/// let at = |x: f32| Gaussian { mean: [x; 8], log_variance: [-4.0; 8] };
/// // Two states that stay unchanged.
/// let stays = |state: &Gaussian| Mixture { weights: vec![1.0], components: vec![*state] };
/// let settings = MemorySettings { repeated_share: 0.1, distrust: 0.001 };
/// let mut memory = Memory::new(vec![at(-1.0), at(1.0)], stays, settings);
/// let image = |second: f32| Mixture { weights: vec![1.0 - second, second], components: vec![at(-1.0), at(1.0)] };
/// // The second state is in sight, then hidden.
/// memory.see(&image(0.999));
/// let hidden = memory.see(&image(0.5));
/// assert!(hidden.weights[0] > 0.99 && hidden.components[0] == at(1.0));
/// ```
#[derive(Clone, Debug)]
pub struct Memory {
    states: Vec<Gaussian>,
    /// For each state, the probabilities of the next one.
    moves: Vec<Vec<f64>>,
    /// Probability of each next state before any image.
    prior: Vec<f64>,
    settings: MemorySettings,
    /// Natural logarithms of the weight of each next state, and of the last image's likelihood ratio of it.
    log_weight: Vec<f64>,
    last: Vec<f64>,
}

impl Memory {
    /// An empty memory. `states` are the posteriors that represent the known states, equally probable before any image;
    /// `forecast` is the mixture density network.
    pub fn new(states: Vec<Gaussian>, forecast: impl Fn(&Gaussian) -> Mixture, settings: MemorySettings) -> Self {
        let share = |state| {
            let (shares, other) = shares(&states, &forecast(state));
            // A forecast that is near no state moves to all of them.
            shares.iter().map(|s| s + other / shares.len() as f64).collect::<Vec<f64>>()
        };
        let moves: Vec<Vec<f64>> = states.iter().map(share).collect();
        let count = states.len();
        let prior = (0..count).map(|to| moves.iter().map(|from| from[to]).sum::<f64>() / count as f64).collect();
        let (log_weight, last) = (vec![0.0; count], vec![0.0; count]);
        let mut memory = Self { states, moves, prior, settings, log_weight, last };
        memory.clear();
        memory
    }

    /// Forgets everything: the next image starts a new take.
    pub fn clear(&mut self) {
        self.last.fill(0.0);
        for (weight, prior) in self.log_weight.iter_mut().zip(&self.prior) {
            *weight = prior.max(SMALLEST).ln();
        }
    }

    /// Moves the belief by one time step.
    pub fn advance(&mut self) {
        let weights = self.weights();
        let count = weights.len();
        let (mut moved, mut last) = (vec![0.0; count], vec![0.0; count]);
        for (from, row) in self.moves.iter().enumerate() {
            for (to, share) in row.iter().enumerate() {
                moved[to] += weights[from] * share;
                last[to] += weights[from] * share * self.last[from];
            }
        }
        for to in 0..count {
            self.last[to] = last[to] / moved[to].max(f64::MIN_POSITIVE);
            self.log_weight[to] = moved[to].max(SMALLEST).ln();
        }
    }

    /// Weighs the belief by the forecast of a new image, and returns the forecast from all images so far. Components
    /// far from all known states keep their weight.
    pub fn see(&mut self, image: &Mixture) -> Mixture {
        let distrust = self.settings.distrust;
        let (shares, other) = shares(&self.states, image);
        let known = (1.0 - other).max(f64::MIN_POSITIVE);
        for (state, share) in shares.iter().enumerate() {
            let ratio = share / known / self.prior[state].max(SMALLEST);
            let evidence = (ratio * (1.0 - distrust) + distrust).ln();
            // An image that shows no known state is evidence for none.
            let evidence = known * evidence;
            self.log_weight[state] += evidence - self.settings.repeated(evidence, self.last[state]);
            self.last[state] = evidence;
        }
        let weights = self.weights();
        for (log_weight, weight) in self.log_weight.iter_mut().zip(&weights) {
            *log_weight = weight.max(SMALLEST).ln();
        }
        self.forecast(&weights, image, other)
    }

    /// Weights of the next states; they sum to 1.
    pub fn weights(&self) -> Vec<f64> {
        normalised_exp(&self.log_weight)
    }

    /// The carried samples by weight, and the image's own components that are far from all of them.
    fn forecast(&self, weights: &[f64], image: &Mixture, other: f64) -> Mixture {
        let mut terms: Vec<(f64, Gaussian)> =
            weights.iter().zip(&self.states).map(|(w, state)| (w * (1.0 - other), *state)).collect();
        for (weight, component) in image.weights.iter().zip(&image.components) {
            if nearest(&self.states, component) > LARGEST_DISTANCE {
                terms.push((f64::from(*weight), *component));
            }
        }
        terms.sort_by(|a, b| b.0.total_cmp(&a.0));
        terms.truncate(MAX_COMPONENTS);
        let sum: f64 = terms.iter().map(|(w, _)| w).sum();
        let (weights, components) = terms.into_iter().map(|(w, g)| ((w / sum) as f32, g)).unzip();
        Mixture { weights, components }
    }
}

/// Shares of the known states in a mixture, by the overlap of their Gaussians, and the share of components that are far
/// from all of them. All sum to 1.
fn shares(states: &[Gaussian], mixture: &Mixture) -> (Vec<f64>, f64) {
    let (mut shares, mut other) = (vec![0.0; states.len()], 0.0);
    let total: f64 = mixture.weights.iter().map(|w| f64::from(*w)).sum();
    for (weight, component) in mixture.weights.iter().zip(&mixture.components) {
        let weight = f64::from(*weight) / total;
        if nearest(states, component) > LARGEST_DISTANCE {
            other += weight;
            continue;
        }
        let overlaps: Vec<f64> = states.iter().map(|state| log_overlap(component, state)).collect();
        for (share, overlap) in shares.iter_mut().zip(normalised_exp(&overlaps)) {
            *share += weight * overlap;
        }
    }
    (shares, other)
}

/// Variances of the difference of two Gaussians, with the square of the difference of their means.
fn differences<'a>(a: &'a Gaussian, b: &'a Gaussian) -> impl Iterator<Item = (f64, f64)> + 'a {
    (0..LATENT_DIM).map(|i| {
        let variance = f64::from(a.log_variance[i]).exp() + f64::from(b.log_variance[i]).exp();
        ((f64::from(a.mean[i]) - f64::from(b.mean[i])).powi(2), variance)
    })
}

/// Logarithm of the integral of the product of two Gaussians, without its constant.
fn log_overlap(a: &Gaussian, b: &Gaussian) -> f64 {
    differences(a, b).map(|(square, variance)| -0.5 * (square / variance + variance.ln())).sum()
}

/// Squared distance of the nearest state, in deviations.
fn nearest(states: &[Gaussian], component: &Gaussian) -> f64 {
    let distance = |state| differences(component, state).map(|(square, variance)| square / variance).sum::<f64>();
    states.iter().map(distance).fold(f64::INFINITY, f64::min)
}

/// Exponentials that sum to 1.
fn normalised_exp(logs: &[f64]) -> Vec<f64> {
    let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let exps: Vec<f64> = logs.iter().map(|log| (log - largest).exp()).collect();
    let sum: f64 = exps.iter().sum();
    exps.into_iter().map(|e| e / sum).collect()
}
