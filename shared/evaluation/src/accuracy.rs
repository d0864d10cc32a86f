//! State accuracy of latents: nearest state centroid, counted up to visual equivalence.

use crate::PosedImages;
use carff_dataset::{Observability, PoseRole};
use carff_messages::{Gaussian, LATENT_DIM};
use serde::{Deserialize, Serialize};

/// State centroids with one pooled variance per dimension.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Centroids {
    /// Mean of each state.
    pub means: Vec<[f32; LATENT_DIM]>,
    /// Pooled variance of the means about their centroids, per dimension.
    pub variance: [f32; LATENT_DIM],
}

impl Centroids {
    /// Centroids of the posterior means of trained, non-calibration poses, from the images that show the actor's place
    /// fully. A state without such an image uses all its images from these poses. `None` when a state has no image.
    pub fn fit(posed: &PosedImages, posteriors: &[Gaussian]) -> Option<Self> {
        let states = posed.scenario.state_count();
        let mut sums = vec![[0.0_f64; LATENT_DIM]; states];
        let mut counts = vec![0_usize; states];
        let rest = posed.with_roles(&[PoseRole::Rest]);
        let shows = |i: usize| posed.labels[i].observability == Observability::Full;
        let mut shown = vec![false; states];
        rest.iter().filter(|&&i| shows(i)).for_each(|&i| shown[posed.labels[i].state] = true);
        let chosen: Vec<usize> = rest.into_iter().filter(|&i| shows(i) || !shown[posed.labels[i].state]).collect();
        for &i in &chosen {
            let state = posed.labels[i].state;
            counts[state] += 1;
            for (sum, &m) in sums[state].iter_mut().zip(&posteriors[i].mean) {
                *sum += f64::from(m);
            }
        }
        if counts.contains(&0) {
            return None;
        }
        let means: Vec<[f32; LATENT_DIM]> =
            sums.iter().zip(&counts).map(|(s, &n)| std::array::from_fn(|d| (s[d] / n as f64) as f32)).collect();
        let mut variance = [0.0_f32; LATENT_DIM];
        for &i in &chosen {
            for (d, v) in variance.iter_mut().enumerate() {
                *v += (posteriors[i].mean[d] - means[posed.labels[i].state][d]).powi(2) / chosen.len() as f32;
            }
        }
        Some(Self { means, variance: variance.map(|v| v.max(1e-6)) })
    }

    /// State with the nearest centroid.
    pub fn nearest(&self, latent: &[f32; LATENT_DIM]) -> usize {
        let distance = |m: &[f32; LATENT_DIM]| -> f32 {
            (0..LATENT_DIM).map(|d| (latent[d] - m[d]).powi(2) / self.variance[d]).sum()
        };
        (0..self.means.len())
            .min_by(|&a, &b| distance(&self.means[a]).total_cmp(&distance(&self.means[b])))
            .unwrap_or(0)
    }
}

/// Correct answers among the trials of one kind of view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// Correct up to visual equivalence.
    pub right: usize,
    /// Correct with the exact state.
    pub right_by_name: usize,
    /// Expected number of exact answers of an observer that knows all that the images show, and guesses among
    /// equivalent states.
    pub best_by_name: f64,
    /// Views counted.
    pub trials: usize,
}

impl Share {
    /// Accuracy up to visual equivalence, 0..=1; 0 for no trials.
    pub fn accuracy(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.right as f64 / self.trials as f64 }
    }

    /// Exact-state accuracy, 0..=1; 0 for no trials.
    pub fn raw(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.right_by_name as f64 / self.trials as f64 }
    }

    /// Upper bound of [`Self::raw`], 0..=1; 0 for no trials.
    pub fn ceiling(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.best_by_name / self.trials as f64 }
    }

    /// Counts one answer; `equivalent` is the number of states that look the same, including the true one.
    pub fn count(&mut self, right: bool, by_name: bool, equivalent: usize) {
        self.trials += 1;
        self.best_by_name += 1.0 / equivalent.max(1) as f64;
        self.right += usize::from(right);
        self.right_by_name += usize::from(by_name);
    }
}

/// Ratios of a [`Share`], as manifests and run metrics hold them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accuracy {
    /// Accuracy up to visual equivalence, 0..=1.
    pub accuracy: f64,
    /// Exact-state accuracy, 0..=1.
    pub raw: f64,
    /// Upper bound of `raw`, 0..=1.
    pub raw_ceiling: f64,
    /// Views counted.
    pub trials: usize,
}

impl From<Share> for Accuracy {
    fn from(share: Share) -> Self {
        Self { accuracy: share.accuracy(), raw: share.raw(), raw_ceiling: share.ceiling(), trials: share.trials }
    }
}

/// One value for each visibility of the actor's place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ByObservability<T = Share> {
    /// Fully visible.
    pub full: T,
    /// Partly visible.
    pub partial: T,
    /// Hidden.
    pub none: T,
}

impl<T> ByObservability<T> {
    /// Value of one visibility.
    pub fn of(&mut self, observability: Observability) -> &mut T {
        match observability {
            Observability::Full => &mut self.full,
            Observability::Partial => &mut self.partial,
            Observability::None => &mut self.none,
        }
    }

    /// Converts each value.
    pub fn map<U>(self, convert: impl Fn(T) -> U) -> ByObservability<U> {
        ByObservability { full: convert(self.full), partial: convert(self.partial), none: convert(self.none) }
    }
}

/// State accuracy of the posterior means of `chosen` posed.
pub fn state_accuracy(
    posed: &PosedImages,
    posteriors: &[Gaussian],
    centroids: &Centroids,
    chosen: &[usize],
) -> ByObservability {
    let mut table: ByObservability = ByObservability::default();
    for &i in chosen {
        let label = posed.labels[i];
        let named = centroids.nearest(&posteriors[i].mean);
        let right = posed.equivalence.same(label.view, named, label.state);
        let equivalent = posed.equivalent_states(label.view, label.state).len();
        table.of(label.observability).count(right, named == label.state, equivalent);
    }
    table
}
