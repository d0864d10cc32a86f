//! Memory: the belief over the present state, given all frames of a take so far (paper section 3.2, with observations).
//!
//! The belief is carried from frame to frame as weighted samples: the posteriors that represent the known states. A new
//! image weighs them by its forecast, and by what it shows of the places that they take. When a time step has passed, the
//! mixture density network moves them. An image's forecast holds the prior, by which it is divided. Images that follow
//! each other err alike, so evidence that repeats that of the image before counts by a learned share only.

use crate::{Mixture, ProbeLayout};
use carff_messages::{Gaussian, LATENT_DIM, MAX_COMPONENTS};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest squared distance of a component from the nearest known state, in deviations: 99.9 % of the components of a
/// state's images are within 26 (chi-squared, 8 dimensions). Memory does not change components that are further away.
const LARGEST_DISTANCE: f64 = 26.0;
/// Smallest weight of a state in the belief: no evidence excludes a state forever.
const SMALLEST: f64 = 1e-6;

/// The learned numbers of the memory.
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
    /// Logarithm of the likelihood ratio of a place that an image shows clearly as taken, 0 to 100; 0 counts no places.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub place_strength: f64,
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

/// Content of a memory at an image, before the image is compared with the known states.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RememberedStates {
    /// Weights of the present states; they sum to 1. Empty without a memory.
    pub weights: Vec<f32>,
    /// Hazard probability of the next state by the places only, 0..=1: what the field has seen, without the encoder.
    pub hazard_by_places: f32,
}

/// Memory of one camera's frames.
///
/// ```
/// use carff_base::geometry::OrientedBox;
/// use carff_decision::{Memory, MemorySettings, Mixture, Place, ProbeLayout};
/// use carff_messages::Gaussian;
/// let at = |x: f32| Gaussian { mean: [x; 8], log_variance: [-4.0; 8] };
/// // Two states that stay unchanged. Something stands at the place in the second one.
/// let stays = |state: &Gaussian| Mixture { weights: vec![1.0], components: vec![*state] };
/// let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
/// let place = Place { name: "actor".into(), oriented_box, occupied_in: vec![false, true] };
/// let layout = ProbeLayout::new(vec![place], vec![false, true])?;
/// let settings = MemorySettings { repeated_share: 0.1, distrust: 0.001, place_strength: 5.0 };
/// let mut memory = Memory::new(&layout, vec![at(-1.0), at(1.0)], stays, settings);
/// let image = |second: f32| Mixture { weights: vec![1.0 - second, second], components: vec![at(-1.0), at(1.0)] };
/// // The second state is in sight, then hidden.
/// memory.see(&image(0.999));
/// let hidden = memory.see(&image(0.5));
/// assert!(hidden.weights[0] > 0.99 && hidden.components[0] == at(1.0));
/// // Two images show the place free, which the encoder does not see.
/// memory.compare(&[-1.0]);
/// memory.see(&image(0.5));
/// memory.compare(&[-1.0]);
/// assert!(memory.states()[1] < 0.9);
/// # Ok::<(), carff_decision::ProbingError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Memory {
    states: Vec<Gaussian>,
    layout: ProbeLayout,
    /// For each state, the probabilities of the next one.
    moves: Vec<Vec<f64>>,
    /// Probability of each next state before any image.
    prior: Vec<f64>,
    settings: MemorySettings,
    /// By all evidence.
    all: Carried,
    /// By the places only.
    by_places: Carried,
    /// The last image's components that are far from all known states, with their weights.
    far: Vec<(f64, Gaussian)>,
}

impl Memory {
    /// An empty memory. `states` are the posteriors that represent the known states of `layout`, equally probable before
    /// any image; `forecast` is the mixture density network.
    pub fn new(
        layout: &ProbeLayout,
        states: Vec<Gaussian>,
        forecast: impl Fn(&Gaussian) -> Mixture,
        settings: MemorySettings,
    ) -> Self {
        let share = |state| {
            let (shares, other) = shares(&states, &forecast(state));
            // A forecast that is near no state moves to all of them.
            shares.iter().map(|s| s + other / shares.len() as f64).collect::<Vec<f64>>()
        };
        let moves: Vec<Vec<f64>> = states.iter().map(share).collect();
        let count = states.len();
        let prior = moved(&moves, &vec![1.0 / count.max(1) as f64; count]);
        let (all, by_places) = (Carried::even(count), Carried::even(count));
        Self { states, layout: layout.clone(), moves, prior, settings, all, by_places, far: Vec::new() }
    }

    /// Forgets everything: the next image starts a new take.
    pub fn clear(&mut self) {
        for carried in [&mut self.all, &mut self.by_places] {
            *carried = Carried::even(self.states.len());
        }
        self.far.clear();
    }

    /// Moves the belief by one time step.
    pub fn advance(&mut self) {
        for carried in [&mut self.all, &mut self.by_places] {
            carried.advance(&self.moves);
        }
    }

    /// Weighs the belief by the forecast of a new image, and returns the forecast from all images so far. Components
    /// far from all known states keep their weight.
    pub fn see(&mut self, image: &Mixture) -> Mixture {
        let distrust = self.settings.distrust;
        let (shares, other) = shares(&self.states, image);
        let known = (1.0 - other).max(f64::MIN_POSITIVE);
        let of_next: Vec<f64> =
            shares.iter().zip(&self.prior).map(|(share, prior)| share / known / prior.max(SMALLEST)).collect();
        // An image that shows no known state is evidence for none.
        let evidence = |row: &Vec<f64>| {
            let ratio: f64 = row.iter().zip(&of_next).map(|(share, ratio)| share * ratio).sum();
            known * (ratio * (1.0 - distrust) + distrust).ln()
        };
        let evidence = self.moves.iter().map(evidence).collect();
        self.all.count(FORECAST, evidence, &self.settings);
        let far = |(_, component): &(&f32, &Gaussian)| nearest(&self.states, component) > LARGEST_DISTANCE;
        let components = image.weights.iter().zip(&image.components).filter(far);
        self.far = components.map(|(weight, component)| (f64::from(*weight), *component)).collect();
        self.forecast()
    }

    /// Weighs the belief by what the last image shows of each place: -1 for free, 1 for taken, 0 for nothing. Returns the
    /// forecast from all images so far.
    pub fn compare(&mut self, places: &[f64]) -> Mixture {
        let mut evidence = vec![0.0; self.states.len()];
        for (place, shown) in self.layout.places().iter().zip(places) {
            let of_place = self.settings.place_strength * shown;
            evidence
                .iter_mut()
                .zip(&place.occupied_in)
                .filter(|(_, taken)| **taken)
                .for_each(|(sum, _)| *sum += of_place);
        }
        // Relative to the mean likelihood, so that evidence that repeats is the same for all states.
        let largest = evidence.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mean = evidence.iter().map(|e| (e - largest).exp()).sum::<f64>() / evidence.len().max(1) as f64;
        for of_state in &mut evidence {
            *of_state -= largest + mean.ln();
        }
        self.by_places.count(PLACES, evidence.clone(), &self.settings);
        self.all.count(PLACES, evidence, &self.settings);
        self.forecast()
    }

    /// Weights of the present states; they sum to 1.
    pub fn states(&self) -> Vec<f64> {
        self.all.weights()
    }

    /// Returns the memory's content, as messages carry it.
    pub fn remembered(&self) -> RememberedStates {
        let next = moved(&self.moves, &self.by_places.weights());
        let hazards = next.iter().zip(self.layout.hazard_states()).filter(|(_, hazard)| **hazard);
        RememberedStates {
            weights: self.states().iter().map(|weight| *weight as f32).collect(),
            hazard_by_places: hazards.map(|(weight, _)| weight).sum::<f64>().min(1.0) as f32,
        }
    }

    /// Weights of the next states; they sum to 1.
    pub fn next(&self) -> Vec<f64> {
        moved(&self.moves, &self.states())
    }

    /// The carried samples by weight, and the last image's own components that are far from all of them.
    fn forecast(&self) -> Mixture {
        let other: f64 = self.far.iter().map(|(weight, _)| weight).sum();
        let next = self.next();
        let known = next.iter().zip(&self.states).map(|(w, state)| (w * (1.0 - other).max(0.0), *state));
        let mut terms: Vec<(f64, Gaussian)> = known.chain(self.far.iter().copied()).filter(|(w, _)| *w > 0.0).collect();
        terms.sort_by(|a, b| b.0.total_cmp(&a.0));
        terms.truncate(MAX_COMPONENTS);
        let sum: f64 = terms.iter().map(|(w, _)| w).sum();
        let (weights, components) = terms.into_iter().map(|(w, g)| ((w / sum) as f32, g)).unzip();
        Mixture { weights, components }
    }
}

/// Kinds of evidence of an image: its forecast, and the places that it shows.
const FORECAST: usize = 0;
const PLACES: usize = 1;

/// Weights of the present states, carried from image to image.
#[derive(Clone, Debug)]
struct Carried {
    /// Natural logarithm of the weight of each state.
    log_weight: Vec<f64>,
    /// The last image's evidence of each kind for each state.
    last: [Vec<f64>; 2],
}

impl Carried {
    /// Equally probable states.
    fn even(count: usize) -> Self {
        Self { log_weight: vec![0.0; count], last: [vec![0.0; count], vec![0.0; count]] }
    }

    /// Moves the weights, and the evidence that later images may repeat, by one time step.
    fn advance(&mut self, moves: &[Vec<f64>]) {
        let weights = self.weights();
        let after = moved(moves, &weights);
        for last in &mut self.last {
            let carried: Vec<f64> = weights.iter().zip(last.iter()).map(|(weight, last)| weight * last).collect();
            let sums = moved(moves, &carried);
            *last = sums.iter().zip(&after).map(|(sum, weight)| sum / weight.max(f64::MIN_POSITIVE)).collect();
        }
        self.set(&after);
    }

    /// Counts evidence of one kind for each state.
    fn count(&mut self, kind: usize, evidence: Vec<f64>, settings: &MemorySettings) {
        for ((log_weight, new), last) in self.log_weight.iter_mut().zip(&evidence).zip(&self.last[kind]) {
            *log_weight += new - settings.repeated(*new, *last);
        }
        self.last[kind] = evidence;
        self.set(&self.weights());
    }

    fn set(&mut self, weights: &[f64]) {
        self.log_weight = weights.iter().map(|weight| weight.max(SMALLEST).ln()).collect();
    }

    /// Weights that sum to 1.
    fn weights(&self) -> Vec<f64> {
        normalised_exp(&self.log_weight)
    }
}

/// Weights after a time step.
fn moved(moves: &[Vec<f64>], weights: &[f64]) -> Vec<f64> {
    let to = |next: usize| moves.iter().zip(weights).map(|(row, weight)| weight * row[next]).sum();
    (0..weights.len()).map(to).collect()
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
