//! Means of a matrix of PSNR: rendered states against true states.

use serde::{Deserialize, Serialize};

/// Means over pairs of states, dB; `None` where there is no such pair.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PairMeans {
    /// Rendered state against the same true state.
    pub matching_db: Option<f64>,
    /// Rendered state against every other true state that looks different.
    pub unmatching_db: Option<f64>,
    /// Matching minus un-matching.
    pub margin_db: Option<f64>,
}

/// Means over the rows of `rendered` states. `psnr_db[rendered][true]` may lack rows (`None`). Pairs of different
/// states that look the same (`same`) are left out.
pub fn pair_means(
    psnr_db: &[Option<Vec<f64>>],
    rendered: impl IntoIterator<Item = usize>,
    same: impl Fn(usize, usize) -> bool,
) -> PairMeans {
    let (mut matching, mut unmatching) = (Vec::new(), Vec::new());
    for row in rendered {
        for (column, &value) in psnr_db.get(row).into_iter().flatten().flatten().enumerate() {
            if row == column {
                matching.push(value);
            } else if !same(row, column) {
                unmatching.push(value);
            }
        }
    }
    let [matching_db, unmatching_db] = [matching, unmatching].map(|v| carff_base::statistics::mean(&v));
    PairMeans { matching_db, unmatching_db, margin_db: matching_db.zip(unmatching_db).map(|(a, b)| a - b) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The diagonal matches; equivalent states are left out; missing rows do not count; rows can be chosen.
    #[test]
    fn means_of_a_counted_matrix() {
        let matrix = [Some(vec![30.0, 20.0, 29.0]), None, Some(vec![29.0, 22.0, 32.0])];
        let same = |a: usize, b: usize| a.abs_diff(b) == 2;
        let all = pair_means(&matrix, 0..3, same);
        assert_eq!((all.matching_db, all.unmatching_db, all.margin_db), (Some(31.0), Some(21.0), Some(10.0)));
        assert_eq!(pair_means(&matrix, [2], same).matching_db, Some(32.0));
        assert_eq!(pair_means(&matrix, [1], same), PairMeans::default());
        assert_eq!(pair_means(&matrix, 0..3, |_, _| false).unmatching_db, Some(25.0));
    }
}
