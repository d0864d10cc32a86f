//! State accuracy of latents: nearest state centroid, counted up to visual equivalence.

use crate::PosedImages;
use carff_dataset::{Observability, PoseRole};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_trials::ByObservability;
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
