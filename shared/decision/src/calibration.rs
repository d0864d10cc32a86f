//! The calibration that turns occupancies into states, and the belief that a set of readings amounts to.

use crate::layout::{ProbeLayout, ProbingError};
use serde::{Deserialize, Serialize};

/// Log-likelihood ratios of one place are limited to this, so that no single place decides for all others.
const MAX_LOG_RATIO: f64 = 6.0;
/// Deviations are at least this share of the distance between a place's two means. Calibration only sees the known
/// states, and an occupancy between them should read as doubtful.
const MIN_DEVIATION_SHARE: f64 = 0.2;
/// A reading whose best state explains its places worse than this (mean probability of a place) names no state.
const MIN_MEAN_PROBABILITY: f64 = 0.5;

/// The occupancies that the known states showed: for each place, their distribution when it is taken and when it is
/// free.
///
/// ```
/// use carff_base::geometry::OrientedBox;
/// use carff_decision::{ProbeCalibration, Place, ProbeLayout};
/// let place = Place {
///     name: "truck".into(),
///     oriented_box: OrientedBox { center: [0.0, 0.0, 1.0], half_size: [1.0; 3], yaw: 0.0 },
///     occupied_in: vec![true, false],
/// };
/// let layout = ProbeLayout::new(vec![place], vec![true, false])?;
/// let calibration = ProbeCalibration::fit(&layout, &[vec![0.8, 0.9], vec![0.05, 0.1]])?;
/// assert!(calibration.separations()[0] > 3.0);
/// assert_eq!(calibration.read(&layout, &[0.02]).state, Some(1));
/// # Ok::<(), carff_decision::ProbingError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProbeCalibration {
    places: Vec<PlaceCalibration>,
}

/// One place's two distributions, each a Gaussian over the occupancy's logit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct PlaceCalibration {
    taken_mean: f64,
    taken_deviation: f64,
    free_mean: f64,
    free_deviation: f64,
}

/// The state that one latent shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// The known state, or `None` when none of them explains what was found.
    pub state: Option<usize>,
    /// Probability of that state among the known ones, 0..=1 (0 when there is none).
    pub confidence: f32,
    /// Probability of a hazard state, 0..=1.
    pub hazard_likelihood: f32,
    /// Probability of each known state; they sum to 1.
    pub state_probabilities: Vec<f32>,
}

impl ProbeCalibration {
    /// Fits on the occupancies of the known states: for each state, rows of one value a place, one row a latent.
    pub fn fit(layout: &ProbeLayout, occupancies_by_state: &[Vec<f32>]) -> Result<Self, ProbingError> {
        let n = layout.places().len();
        for (state, rows) in occupancies_by_state.iter().enumerate() {
            if rows.is_empty() || rows.len() % n != 0 {
                return Err(ProbingError::Observations { state, len: rows.len(), places: n });
            }
        }
        if occupancies_by_state.len() != layout.state_count() {
            return Err(ProbingError::Observations { state: occupancies_by_state.len(), len: 0, places: n });
        }
        let places = (0..n)
            .map(|p| {
                let values = |taken: bool| -> Vec<f64> {
                    occupancies_by_state
                        .iter()
                        .enumerate()
                        .filter(|(s, _)| layout.places()[p].occupied_in[*s] == taken)
                        .flat_map(|(_, rows)| rows.iter().skip(p).step_by(n))
                        .map(|&o| logit(f64::from(o)))
                        .collect()
                };
                let (taken, free) = (moments(&values(true)), moments(&values(false)));
                // A place that is always taken, or always free, carries no information: both sides are equal.
                let (taken, free) = match (taken, free) {
                    (Some(t), Some(f)) => (t, f),
                    (Some(only), None) | (None, Some(only)) => (only, only),
                    (None, None) => ((0.0, 1.0), (0.0, 1.0)),
                };
                let least = MIN_DEVIATION_SHARE * (taken.0 - free.0).abs();
                PlaceCalibration {
                    taken_mean: taken.0,
                    taken_deviation: taken.1.max(least),
                    free_mean: free.0,
                    free_deviation: free.1.max(least),
                }
            })
            .collect();
        Ok(Self { places })
    }

    /// Reports whether it was fitted on as many places as `layout` has.
    pub fn fits(&self, layout: &ProbeLayout) -> bool {
        self.places.len() == layout.places().len()
    }

    /// Returns, for each place, the distance between the means of taken and free in deviations.
    pub fn separations(&self) -> Vec<f64> {
        self.places
            .iter()
            .map(|p| (p.taken_mean - p.free_mean) / (0.5 * (p.taken_deviation + p.free_deviation)))
            .collect()
    }

    /// Reads the state of one latent from its occupancies, one a place.
    pub fn read(&self, layout: &ProbeLayout, occupancies: &[f32]) -> Reading {
        // For each place the probability that it is taken, with even prior odds.
        let taken: Vec<f64> = self
            .places
            .iter()
            .zip(occupancies)
            .map(|(p, &o)| {
                let x = logit(f64::from(o));
                let log = |mean: f64, deviation: f64| -0.5 * ((x - mean) / deviation).powi(2) - deviation.ln();
                // Beyond the means, the farther side must not win by its wider spread.
                let ratio = if x >= p.taken_mean.max(p.free_mean) {
                    MAX_LOG_RATIO * (p.taken_mean - p.free_mean).signum()
                } else if x <= p.free_mean.min(p.taken_mean) {
                    -MAX_LOG_RATIO * (p.taken_mean - p.free_mean).signum()
                } else {
                    log(p.taken_mean, p.taken_deviation) - log(p.free_mean, p.free_deviation)
                };
                let ratio = if p.taken_mean > p.free_mean { ratio } else { 0.0 };
                1.0 / (1.0 + (-ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)).exp())
            })
            .collect();
        let logs: Vec<f64> = (0..layout.state_count())
            .map(|s| {
                layout
                    .places()
                    .iter()
                    .zip(&taken)
                    .map(|(p, &t)| if p.occupied_in[s] { t.ln() } else { (1.0 - t).ln() })
                    .sum()
            })
            .collect();
        let best = (0..logs.len()).max_by(|&a, &b| logs[a].total_cmp(&logs[b])).unwrap_or(0);
        let highest = logs.get(best).copied().unwrap_or(f64::NEG_INFINITY);
        let weights: Vec<f64> = logs.iter().map(|l| (l - highest).exp()).collect();
        let total: f64 = weights.iter().sum();
        let probabilities: Vec<f32> = weights.iter().map(|w| (w / total) as f32).collect();
        let hazard: f32 = probabilities.iter().zip(layout.hazard_states()).filter(|(_, h)| **h).map(|(p, _)| *p).sum();
        let explained = (highest / layout.places().len() as f64).exp();
        let known = explained >= MIN_MEAN_PROBABILITY;
        Reading {
            state: known.then_some(best),
            confidence: if known { probabilities[best] } else { 0.0 },
            hazard_likelihood: hazard.clamp(0.0, 1.0),
            state_probabilities: probabilities,
        }
    }
}

/// The belief over the known states that a set of readings amounts to.
#[derive(Clone, Debug, PartialEq)]
pub struct Resolved {
    /// Probability of each known state; together with the unknown's they sum to 1.
    pub state_probabilities: Vec<f32>,
    /// Probability that something is there which no known state explains, 0..=1; 0 without a compared image.
    pub unknown_probability: f32,
    /// Probability of a hazard state, 0..=1.
    pub hazard_probability: f32,
    /// The most probable state; of equally probable ones, a hazard state first. States that probing cannot distinguish
    /// count together.
    pub state: usize,
}

impl Resolved {
    /// Probability of a state, 0..=1; 0 for one that does not exist.
    pub fn state_probability(&self, state: usize) -> f32 {
        self.state_probabilities.get(state).copied().unwrap_or(0.0)
    }
}

/// Combines readings into a belief. Within a component, its samples and its mean have equal weight; components count by
/// their mixture weights. Each component therefore has its exact weight, for any share of the samples.
pub fn resolve(
    layout: &ProbeLayout,
    weights: &[f32],
    component_readings: &[Reading],
    sample_readings: &[Reading],
    sample_components: &[usize],
) -> Resolved {
    let states = layout.state_count();
    let mut probabilities = vec![0.0_f64; states];
    let mut hazard = 0.0;
    for (k, (&weight, own)) in weights.iter().zip(component_readings).enumerate() {
        let mut readings: Vec<&Reading> =
            sample_readings.iter().zip(sample_components).filter(|(_, c)| **c == k).map(|(r, _)| r).collect();
        readings.push(own);
        let share = f64::from(weight) / readings.len() as f64;
        for reading in readings {
            for (sum, &p) in probabilities.iter_mut().zip(&reading.state_probabilities) {
                *sum += share * f64::from(p);
            }
            hazard += share * f64::from(reading.hazard_likelihood);
        }
    }
    let total: f64 = probabilities.iter().sum::<f64>().max(1e-12);
    let total_weight: f64 = weights.iter().map(|&w| f64::from(w)).sum::<f64>().max(1e-12);
    let state = most_probable(layout, |s| probabilities[s] / total);
    Resolved {
        state_probabilities: probabilities.iter().map(|p| (p / total) as f32).collect(),
        unknown_probability: 0.0,
        hazard_probability: (hazard / total_weight).clamp(0.0, 1.0) as f32,
        state,
    }
}

/// Returns the most probable state; of equally probable ones (to a millionth), a hazard state first, then the first.
/// States that probing cannot distinguish have the sum of their probabilities: one scene under several names is as
/// probable as under one.
pub(crate) fn most_probable(layout: &ProbeLayout, probability: impl Fn(usize) -> f64) -> usize {
    let of_scene = |s: usize| layout.alike(s).iter().map(|&alike| probability(alike)).sum::<f64>();
    let key = |s: usize| (of_scene(s) * 1e6).round() as i64 * 2 + i64::from(layout.hazard_states()[s]);
    (0..layout.state_count()).max_by_key(|&s| (key(s), std::cmp::Reverse(s))).unwrap_or(0)
}

fn logit(p: f64) -> f64 {
    let p = if p.is_finite() { p.clamp(0.005, 0.995) } else { 0.005 };
    (p / (1.0 - p)).ln()
}

/// Returns mean and deviation; the deviation has a lower bound, since calibration sees few latents.
fn moments(values: &[f64]) -> Option<(f64, f64)> {
    if values.is_empty() {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    Some((mean, variance.sqrt().max(0.3)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Place;
    use carff_base::geometry::OrientedBox;

    /// Three states: something at place 0, at place 1, nowhere.
    fn layout() -> ProbeLayout {
        let place = |x: f64, occupied_in: Vec<bool>| Place {
            name: "actor".into(),
            oriented_box: OrientedBox { center: [x, 0.0, 1.0], half_size: [1.0, 0.5, 0.5], yaw: 0.0 },
            occupied_in,
        };
        ProbeLayout::new(
            vec![place(0.0, vec![true, false, false]), place(5.0, vec![false, true, false])],
            vec![true, true, false],
        )
        .unwrap()
    }

    fn calibration(layout: &ProbeLayout) -> ProbeCalibration {
        let rows = |a: f32, b: f32| (0..10).flat_map(|i| [a + 0.01 * i as f32, b + 0.005 * i as f32]).collect();
        ProbeCalibration::fit(layout, &[rows(0.8, 0.05), rows(0.05, 0.7), rows(0.03, 0.02)]).unwrap()
    }

    /// Each known state is read back from its own occupancies, "nobody there" among them.
    #[test]
    fn known_states_are_read_back() {
        let p = layout();
        let c = calibration(&p);
        for (occupancies, state, hazard) in [([0.85, 0.05], 0, true), ([0.04, 0.75], 1, true), ([0.02, 0.03], 2, false)]
        {
            let r = c.read(&p, &occupancies);
            assert_eq!(r.state, Some(state));
            assert_eq!(r.hazard_likelihood > 0.5, hazard);
            assert!((r.state_probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    /// Both places taken is not a known state: the reading names none, and still reports the hazard.
    #[test]
    fn what_no_state_explains_is_unknown() {
        let p = layout();
        let r = calibration(&p).read(&p, &[0.85, 0.75]);
        assert_eq!(r.state, None);
        assert!(r.hazard_likelihood > 0.5);
    }

    /// A hollow box with a thin roof is as occupied as a solid one; what lies on the ground below, or far over the
    /// roof, is not in the box.
    #[test]
    fn surfaces_count_like_solids() {
        let p = layout();
        let occupancy = |density: &dyn Fn(f32) -> f32| {
            let densities: Vec<f32> = p.points().iter().map(|point| density(point[2])).collect();
            let mut out = [9.0; 2];
            p.occupancies(&densities, &mut out);
            out
        };
        // The boxes stand from 0.5 to 1.5 m.
        let solid = occupancy(&|z| if z < 1.5 { 20.0 } else { 0.0 });
        let shell = occupancy(&|z| if (z - 1.3).abs() < 0.06 { 60.0 } else { 0.0 });
        let ground = occupancy(&|z| if z < 0.7 { 60.0 } else { 0.0 });
        assert!(solid[0] > 0.99 && shell[0] > 0.95 && ground[0] < 0.01, "{solid:?} {shell:?} {ground:?}");
        assert_eq!(shell[0], shell[1]);
    }

    /// Densities that are NaN count as empty, and never panic.
    #[test]
    fn garbage_densities_are_harmless() {
        let p = layout();
        let mut densities = vec![f32::NAN; p.points().len()];
        densities[0] = f32::INFINITY;
        densities[1] = -3.0;
        let mut out = [9.0; 2];
        p.occupancies(&densities, &mut out);
        assert_eq!(out, [0.0, 0.0]);
    }

    /// A component's weight counts exactly, for any share of the samples.
    #[test]
    fn weights_count_exactly() {
        let p = layout();
        let c = calibration(&p);
        let (hazard, clear) = (c.read(&p, &[0.85, 0.05]), c.read(&p, &[0.02, 0.02]));
        let samples = vec![clear.clone(), clear.clone(), clear.clone(), hazard.clone()];
        let r = resolve(&p, &[0.2, 0.8], &[hazard, clear], &samples, &[1, 1, 1, 0]);
        assert!((r.hazard_probability - 0.2).abs() < 0.02, "{}", r.hazard_probability);
        assert_eq!(r.state, 2);
    }

    /// A scene that two states share is as probable as both: it is resolved, and the path through it keeps the whole
    /// probability.
    #[test]
    fn states_of_one_scene_count_together() {
        let place = |x: f64, occupied_in: Vec<bool>| Place {
            name: "actor".into(),
            oriented_box: OrientedBox { center: [x, 0.0, 1.0], half_size: [1.0, 0.5, 0.5], yaw: 0.0 },
            occupied_in,
        };
        // Two states with something at place 0, and one without anything.
        let places = vec![place(0.0, vec![true, true, false]), place(5.0, vec![false, false, false])];
        let p = ProbeLayout::new(places, vec![false; 3]).unwrap();
        assert_eq!((p.alike(1), p.alike(2), p.alike(3)), (&[0, 1][..], &[2][..], &[][..]));
        let reading = Reading {
            state: Some(2),
            confidence: 0.4,
            hazard_likelihood: 0.0,
            state_probabilities: vec![0.3, 0.3, 0.4],
        };
        let r = resolve(&p, &[1.0], &[reading], &[], &[]);
        assert_eq!(r.state, 0);
        let path = |state| crate::path_probability(0.5, &p, &r.state_probabilities, state);
        assert!((path(0) - 0.3).abs() < 1e-6 && (path(2) - 0.2).abs() < 1e-6);
    }

    /// A hazard state is resolved among equally probable states.
    #[test]
    fn ties_go_to_the_hazard() {
        let p = layout();
        let even = |probability: [f32; 3], h: f32| Reading {
            state: Some(0),
            confidence: 1.0,
            hazard_likelihood: h,
            state_probabilities: probability.to_vec(),
        };
        let r = resolve(&p, &[0.5, 0.5], &[even([0.0, 1.0, 0.0], 1.0), even([0.0, 0.0, 1.0], 0.0)], &[], &[]);
        assert_eq!(r.state, 1);
    }
}
