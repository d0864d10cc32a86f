//! Unambiguous views, found from the posteriors.
//!
//! Views that look the same have the same posterior, so the neighbours of a posterior are of all the states that its
//! view may show. A view is unambiguous if its neighbours are of its own state. No image is compared with another: the
//! search needs neither images without noise nor the same pose in every state.

use crate::TrainingError;
use carff_evaluation::PosedImages;
use carff_messages::{Gaussian, LATENT_DIM};
use rayon::prelude::*;

/// Largest and smallest number of neighbours of a posterior mean.
const NEIGHBOURS: usize = 20;
const FEWEST: usize = 3;
/// Largest number of neighbours as a share of the images of the state that has the fewest: more would be of other
/// states, for any view.
const OF_STATE: f64 = 0.25;
/// Quantile of the own shares within a state that is taken as the best share that the state can have. It is below 1
/// for states that no view can distinguish.
const BEST: f64 = 0.75;
/// Smallest own share of an unambiguous view, as a part of the best.
const OF_BEST: f64 = 0.9;

type Latent = [f32; LATENT_DIM];

/// Per state, the unambiguous images of trained and free poses. Every state that has an image gets one.
pub fn unambiguous_by_state(posed: &PosedImages, posteriors: &[Gaussian]) -> Vec<Vec<usize>> {
    let images = posed.trained_and_random();
    let (means, states) = means_and_states(posed, posteriors, &images);
    let chosen = unambiguous(&neighbours(&means, count(&states)), &states, posed.scenario.state_count());
    chosen.into_iter().map(|of_state| of_state.into_iter().map(|k| images[k]).collect()).collect()
}

/// Error of a state without a view.
pub fn no_view(state: usize) -> TrainingError {
    TrainingError::Unfit(format!(
        "state {state} has no view from a trained pose; add images of it, or choose another `split_seed`"
    ))
}

/// For each image of trained and free poses, its state and those of the views with the nearest posteriors: what its
/// view may show, each as often as it is likely.
pub fn possible_states(posed: &PosedImages, posteriors: &[Gaussian]) -> Vec<Vec<usize>> {
    let images = posed.trained_and_random();
    let (means, states) = means_and_states(posed, posteriors, &images);
    let with_own = |(k, near): (usize, Vec<usize>)| near.into_iter().chain([k]).map(|other| states[other]).collect();
    neighbours(&means, count(&states)).into_iter().enumerate().map(with_own).collect()
}

fn means_and_states(posed: &PosedImages, posteriors: &[Gaussian], images: &[usize]) -> (Vec<Latent>, Vec<usize>) {
    images.iter().map(|&i| (posteriors[i].mean, posed.labels[i].state)).unzip()
}

/// Per state, the indices of the views most of whose neighbours have that state.
fn unambiguous(neighbours: &[Vec<usize>], states: &[usize], count: usize) -> Vec<Vec<usize>> {
    let own = |(near, state): (&Vec<usize>, &usize)| {
        near.iter().filter(|&&other| states[other] == *state).count() as f64 / near.len().max(1) as f64
    };
    let shares: Vec<f64> = neighbours.iter().zip(states).map(own).collect();
    (0..count)
        .map(|state| {
            let of_state: Vec<usize> = (0..states.len()).filter(|&k| states[k] == state).collect();
            let mut sorted: Vec<f64> = of_state.iter().map(|&k| shares[k]).collect();
            sorted.sort_by(f64::total_cmp);
            let best = carff_base::statistics::percentile_of_sorted(&sorted, BEST).unwrap_or_default();
            of_state.into_iter().filter(|&k| shares[k] >= OF_BEST * best).collect()
        })
        .collect()
}

/// Number of neighbours for images of these states.
fn count(states: &[usize]) -> usize {
    let of = |state: usize| states.iter().filter(|&&other| other == state).count();
    let fewest = states.iter().collect::<std::collections::BTreeSet<_>>().into_iter().map(|&state| of(state)).min();
    ((fewest.unwrap_or(0) as f64 * OF_STATE) as usize).clamp(FEWEST, NEIGHBOURS)
}

/// Indices of the `count` nearest other means of each mean. Distances are in deviations of each dimension.
fn neighbours(means: &[Latent], count: usize) -> Vec<Vec<usize>> {
    let n = means.len().max(1) as f32;
    let scale: Latent = std::array::from_fn(|d| {
        let mean = means.iter().map(|m| m[d]).sum::<f32>() / n;
        let variance = means.iter().map(|m| (m[d] - mean).powi(2)).sum::<f32>() / n;
        1.0 / variance.sqrt().max(1e-6)
    });
    let scaled: Vec<Latent> = means.iter().map(|m| std::array::from_fn(|d| m[d] * scale[d])).collect();
    let nearest = |k: usize| {
        let distance =
            |other: usize| -> f32 { (0..LATENT_DIM).map(|d| (scaled[k][d] - scaled[other][d]).powi(2)).sum() };
        let mut others: Vec<(f32, usize)> =
            (0..scaled.len()).filter(|&other| other != k).map(|other| (distance(other), other)).collect();
        let taken = count.min(others.len());
        if taken > 0 {
            // Equal distances in the order of the views, so that the choice does not depend on the sort.
            others.select_nth_unstable_by(taken - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        }
        let mut near: Vec<usize> = others[..taken].iter().map(|(_, other)| *other).collect();
        near.sort_unstable();
        near
    };
    (0..means.len()).into_par_iter().map(nearest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::random::{Key, stream};
    use rand::Rng;

    /// Four states: the first two have places of their own, the others share one. A third of the views of each is
    /// hidden, and all these have one posterior, nearer to the first place. Exactly the others are unambiguous.
    #[test]
    fn hidden_views_are_ambiguous() {
        let mut rng = stream(Key { seed: 5, frame: 0, step: 0, sample: 0 });
        let (mut means, mut states, mut hidden) = (Vec::new(), Vec::new(), Vec::new());
        for (state, centre) in [(0, -2.0), (1, 2.0), (2, 6.0), (3, 6.0)] {
            for view in 0..120 {
                let at = if view % 3 == 0 { -1.0 } else { centre };
                means.push(std::array::from_fn(|d| if d < 2 { at + rng.random_range(-0.3..0.3) } else { 0.0 }));
                states.push(state);
                hidden.push(view % 3 == 0);
            }
        }
        let found = unambiguous(&neighbours(&means, NEIGHBOURS), &states, 4);
        for (state, of_state) in found.iter().enumerate().take(2) {
            let expected: Vec<usize> = (0..480).filter(|&k| states[k] == state && !hidden[k]).collect();
            assert_eq!(*of_state, expected, "state {state}");
        }
        // Two states that no view distinguishes: by chance some views have fewer neighbours of their own state.
        for of_state in &found[2..] {
            assert!(of_state.len() > 10 && of_state.iter().all(|&k| !hidden[k]), "{of_state:?}");
        }
    }
}
