//! Support vector machine on latents (paper table 2): RBF kernel, C = 1, one machine for each pair of states.
//!
//! The conventions are those of `SVC()` of scikit-learn: the kernel width is `scale`, and pairs vote. The machines are
//! from linfa.

use carff_base::random::{Key, tag};
use carff_messages::LATENT_DIM;
use linfa::{Dataset, traits::Fit, traits::Predict};
use linfa_svm::Svm;
use ndarray::{Array1, Array2};
use rand::seq::SliceRandom;

/// Latent: one row of the machines' input.
pub type LatentRow = [f32; LATENT_DIM];

/// Tolerance of the solver, as in scikit-learn.
const SOLVER_TOLERANCE: f64 = 1e-3;

/// Returns gamma = 1 / (dimensions * variance of all entries); 1 for a variance of 0.
fn scale_gamma(rows: &[LatentRow]) -> f64 {
    let values = || rows.iter().flatten().map(|&v| f64::from(v));
    let n = (rows.len() * LATENT_DIM).max(1) as f64;
    let mean = values().sum::<f64>() / n;
    let variance = values().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    if variance > 0.0 { 1.0 / (LATENT_DIM as f64 * variance) } else { 1.0 }
}

/// Fits machines on rows with their states, and returns a state for each of `asked`. A pair whose machine cannot be
/// fitted does not vote. With only one state, the result is that state.
pub fn fit_and_name(rows: &[LatentRow], states: &[usize], asked: &[LatentRow]) -> Vec<usize> {
    let mut known: Vec<usize> = states.to_vec();
    known.sort_unstable();
    known.dedup();
    let table = |rows: &[LatentRow]| Array2::from_shape_fn((rows.len(), LATENT_DIM), |(i, d)| f64::from(rows[i][d]));
    let gamma = scale_gamma(rows);
    let asked_table = table(asked);
    let mut votes = vec![vec![0_usize; known.len()]; asked.len()];
    for (i, &first) in known.iter().enumerate() {
        for (j, &second) in known.iter().enumerate().skip(i + 1) {
            let of_pair: Vec<usize> = (0..rows.len()).filter(|&r| states[r] == first || states[r] == second).collect();
            let records = table(&of_pair.iter().map(|&r| rows[r]).collect::<Vec<_>>());
            let is_first: Array1<bool> = of_pair.iter().map(|&r| states[r] == first).collect();
            let machine = Svm::<f64, bool>::params()
                .gaussian_kernel(1.0 / gamma)
                .pos_neg_weights(1.0, 1.0)
                .eps(SOLVER_TOLERANCE)
                .fit(&Dataset::new(records, is_first));
            let Ok(machine) = machine else { continue };
            let answers: Array1<bool> = machine.predict(&asked_table);
            for (vote, &says_first) in votes.iter_mut().zip(&answers) {
                vote[if says_first { i } else { j }] += 1;
            }
        }
    }
    let winner = |vote: &Vec<usize>| {
        let most = vote.iter().max().copied().unwrap_or(0);
        vote.iter().position(|v| *v == most).and_then(|i| known.get(i)).copied().unwrap_or(0)
    };
    votes.iter().map(winner).collect()
}

/// State of each row from machines that were fitted without the row's fold.
pub fn cross_validated(rows: &[LatentRow], states: &[usize], fold_of: &[usize]) -> Vec<usize> {
    let folds = fold_of.iter().max().map_or(0, |f| f + 1);
    let mut named = vec![0; rows.len()];
    for fold in 0..folds {
        let (out, within): (Vec<usize>, Vec<usize>) = (0..rows.len()).partition(|&i| fold_of[i] == fold);
        let pick = |of: &[usize]| of.iter().map(|&i| rows[i]).collect::<Vec<LatentRow>>();
        let labels: Vec<usize> = within.iter().map(|&i| states[i]).collect();
        for (&i, name) in out.iter().zip(fit_and_name(&pick(&within), &labels, &pick(&out))) {
            named[i] = name;
        }
    }
    named
}

/// Fold of each row, stratified by state: rows of each state are shuffled by `seed` and distributed in rotation.
pub fn stratified_folds(states: &[usize], folds: usize, seed: u64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..states.len()).collect();
    order.shuffle(&mut rng(seed));
    order.sort_by_key(|&i| states[i]);
    let mut fold_of = vec![0; states.len()];
    for (place, i) in order.into_iter().enumerate() {
        fold_of[i] = place % folds.max(1);
    }
    fold_of
}

/// Fold of each row, with all rows of a group (a camera pose) in one fold: groups are shuffled by `seed` and
/// distributed in rotation.
pub fn grouped_folds(groups: &[usize], folds: usize, seed: u64) -> Vec<usize> {
    let mut known: Vec<usize> = groups.to_vec();
    known.sort_unstable();
    known.dedup();
    known.shuffle(&mut rng(seed));
    let place = |group: &usize| known.iter().position(|k| k == group).unwrap_or(0);
    groups.iter().map(|group| place(group) % folds.max(1)).collect()
}

fn rng(seed: u64) -> impl rand::Rng {
    carff_base::random::stream(Key { seed, frame: tag("svm fold"), step: 0, sample: 0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cloud of `count` points about `centre`, reproducible for equal seeds.
    fn cloud(centre: f32, count: usize, seed: u64) -> Vec<LatentRow> {
        (0..count)
            .map(|i| {
                let unit =
                    carff_base::random::gaussians::<LATENT_DIM>(Key { seed, frame: i as u64, step: 0, sample: 0 });
                unit.map(|u| centre + 0.2 * u)
            })
            .collect()
    }

    fn right(named: &[usize], states: &[usize]) -> usize {
        named.iter().zip(states).filter(|(a, b)| a == b).count()
    }

    /// Three separate clouds are classified without an error, by machines that were fitted without the point.
    #[test]
    fn separable_states_are_named() {
        let rows = [cloud(-1.0, 20, 1), cloud(0.0, 20, 2), cloud(1.0, 20, 3)].concat();
        let states: Vec<usize> = (0..60).map(|i| [4, 7, 9][i / 20]).collect();
        assert_eq!(cross_validated(&rows, &states, &stratified_folds(&states, 10, 5)), states);
    }

    /// Two states with the same points cannot be distinguished: about half is correct, which is the ceiling.
    #[test]
    fn duplicated_points_stay_at_the_ceiling() {
        let rows = [cloud(0.0, 100, 1), cloud(0.0, 100, 1)].concat();
        let states: Vec<usize> = (0..200).map(|i| i / 100).collect();
        let share = right(&cross_validated(&rows, &states, &stratified_folds(&states, 10, 5)), &states) as f64 / 200.0;
        assert!(share < 0.6, "{share}");
    }

    /// The kernel is not linear: a ring is distinguished from its middle.
    #[test]
    fn rings_are_told_from_their_middle() {
        let ring = (0..40).map(|i| {
            let angle = i as f32 * 0.157;
            let mut row = [0.0; LATENT_DIM];
            (row[0], row[1]) = (2.0 * angle.cos(), 2.0 * angle.sin());
            row
        });
        let rows: Vec<LatentRow> = ring.chain(cloud(0.0, 40, 3)).collect();
        let states: Vec<usize> = (0..80).map(|i| i / 40).collect();
        assert_eq!(right(&cross_validated(&rows, &states, &stratified_folds(&states, 10, 1)), &states), 80);
    }

    /// gamma is that of scikit-learn: half zeros and half ones have a variance of 1/4, so 1 / (8 / 4); constant rows
    /// have 1.
    #[test]
    fn gamma_is_the_scale_convention() {
        assert!((scale_gamma(&[[0.0; 8], [1.0; 8]]) - 0.5).abs() < 1e-12);
        assert_eq!(scale_gamma(&[[3.0; 8]; 4]), 1.0);
        assert_eq!(scale_gamma(&[]), 1.0);
    }

    /// Each fold has its share of each state, to within one.
    #[test]
    fn folds_are_stratified() {
        let states: Vec<usize> = (0..95).map(|i| usize::from(i >= 42)).collect();
        let folds = stratified_folds(&states, 10, 3);
        for fold in 0..10 {
            let of = |state| (0..95).filter(|&i| folds[i] == fold && states[i] == state).count();
            assert!((4..=5).contains(&of(0)) && (5..=6).contains(&of(1)), "{} {}", of(0), of(1));
        }
    }

    /// Rows of one group share a fold, and all folds have the same number of groups, to within one.
    #[test]
    fn groups_stay_together() {
        let groups: Vec<usize> = (0..90).map(|i| i / 6 * 3).collect();
        let folds = grouped_folds(&groups, 10, 3);
        for i in 0..90 {
            assert!((0..90).all(|j| groups[i] != groups[j] || folds[i] == folds[j]));
        }
        for fold in 0..10 {
            assert!((6..=12).contains(&folds.iter().filter(|f| **f == fold).count()));
        }
    }
}
