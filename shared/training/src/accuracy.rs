//! Does a latent name its state? Nearest state centroid, counted up to visual equivalence.

use crate::pictures::Pictures;
use carff_dataset::{Observability, PoseRole};
use carff_messages::{Gaussian, LATENT_DIM};
use serde::{Deserialize, Serialize};

/// State centroids with one pooled variance per dimension.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Centroids {
    /// Per state.
    pub means: Vec<[f32; LATENT_DIM]>,
    /// Pooled variance of the means about their centroids, per dimension.
    pub variance: [f32; LATENT_DIM],
}

impl Centroids {
    /// Centroids of the posterior means of those pictures that show the actor's place fully and whose pose is neither
    /// unseen nor used for calibration; of a state with no such picture, of all its pictures from these poses. `None` when a
    /// state has none at all.
    pub fn fit(pictures: &Pictures, posteriors: &[Gaussian]) -> Option<Self> {
        let states = pictures.scenario.state_count();
        let mut sums = vec![[0.0_f64; LATENT_DIM]; states];
        let mut counts = vec![0_usize; states];
        let rest = pictures.with_roles(&[PoseRole::Rest]);
        let shows = |i: usize| pictures.labels[i].observability == Observability::Full;
        let mut shown = vec![false; states];
        rest.iter().filter(|&&i| shows(i)).for_each(|&i| shown[pictures.labels[i].state] = true);
        let chosen: Vec<usize> = rest.into_iter().filter(|&i| shows(i) || !shown[pictures.labels[i].state]).collect();
        for &i in &chosen {
            let state = pictures.labels[i].state;
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
                *v += (posteriors[i].mean[d] - means[pictures.labels[i].state][d]).powi(2) / chosen.len() as f32;
            }
        }
        Some(Self { means, variance: variance.map(|v| v.max(1e-6)) })
    }

    /// The state whose centroid is nearest.
    pub fn nearest(&self, latent: &[f32; LATENT_DIM]) -> usize {
        let distance = |m: &[f32; LATENT_DIM]| -> f32 {
            (0..LATENT_DIM).map(|d| (latent[d] - m[d]).powi(2) / self.variance[d]).sum()
        };
        (0..self.means.len())
            .min_by(|&a, &b| distance(&self.means[a]).total_cmp(&distance(&self.means[b])))
            .unwrap_or(0)
    }
}

/// Right answers out of trials, for one kind of view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// Right up to visual equivalence.
    pub right: usize,
    /// Right by name.
    pub right_by_name: usize,
    /// Right names to be expected of someone who knows all that the pictures show, and guesses among what looks the
    /// same.
    pub best_by_name: f64,
    /// Views counted.
    pub trials: usize,
}

impl Share {
    /// Accuracy up to visual equivalence, 0..=1; 0 for no trials.
    pub fn accuracy(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.right as f64 / self.trials as f64 }
    }

    /// Accuracy by name, 0..=1; 0 for no trials.
    pub fn raw(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.right_by_name as f64 / self.trials as f64 }
    }

    /// The best possible [`Self::raw`], 0..=1; 0 for no trials.
    pub fn ceiling(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.best_by_name / self.trials as f64 }
    }

    /// Counts one answer, for a state that looks the same as `alike` states, itself among them.
    pub fn count(&mut self, right: bool, by_name: bool, alike: usize) {
        self.trials += 1;
        self.best_by_name += 1.0 / alike.max(1) as f64;
        self.right += usize::from(right);
        self.right_by_name += usize::from(by_name);
    }
}

/// State accuracy by how much the views show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ByObservability {
    /// The actor's place is fully visible.
    pub full: Share,
    /// Partly.
    pub partial: Share,
    /// Not at all.
    pub none: Share,
}

impl ByObservability {
    /// The share of one kind of view.
    pub fn of(&mut self, observability: Observability) -> &mut Share {
        match observability {
            Observability::Full => &mut self.full,
            Observability::Partial => &mut self.partial,
            Observability::None => &mut self.none,
        }
    }
}

/// State accuracy of the posterior means of `chosen` pictures.
pub fn state_accuracy(
    pictures: &Pictures,
    posteriors: &[Gaussian],
    centroids: &Centroids,
    chosen: &[usize],
) -> ByObservability {
    let mut table = ByObservability::default();
    for &i in chosen {
        let label = pictures.labels[i];
        let named = centroids.nearest(&posteriors[i].mean);
        let right = pictures.equivalence.same(label.view, named, label.state);
        let alike = pictures.alike(label.view, label.state).len();
        table.of(label.observability).count(right, named == label.state, alike);
    }
    table
}
