//! From densities in a hypothesis to the state it shows.
//!
//! A hypothesis is a scene latent; the field says how dense the scene is at a point. Points in the boxes where
//! something can stand are queried (not a whole picture per candidate), each box's occupancy is compared with what the
//! known states showed, and "nobody there" and "none of the known states" are possible answers.
//!
//! What a field learns from pictures is surfaces: nobody sees whether a vehicle is hollow. So the points stand in upright
//! columns, and a box is as occupied as its median column is to light: a vehicle stops it nearly everywhere, haze or a
//! neighbour's shadow here and there.
//!
//! ```
//! use carff_geometry::OrientedBox;
//! use carff_probing::{Calibration, Place, Prober};
//! let place = |x: f64, occupied_in: Vec<bool>| Place {
//!     name: "actor".into(),
//!     oriented_box: OrientedBox { center: [x, 0.0, 1.0], half_size: [1.0, 1.0, 1.0], yaw: 0.0 },
//!     occupied_in,
//! };
//! let places = vec![place(-5.0, vec![true, false]), place(5.0, vec![false, false])];
//! let prober = Prober::new(places, vec![true, false])?;
//! // State 0 shows something at the first place, state 1 nothing at all.
//! let seen = vec![vec![[0.9, 0.1], [0.8, 0.0]].concat(), vec![[0.1, 0.1], [0.0, 0.05]].concat()];
//! let calibration = Calibration::fit(&prober, &seen)?;
//! let reading = calibration.read(&prober, &[0.85, 0.02]);
//! assert_eq!(reading.state, Some(0));
//! assert!(reading.hazard_likelihood > 0.9);
//! # Ok::<(), carff_probing::ProbingError>(())
//! ```

use carff_geometry::OrientedBox;
use serde::{Deserialize, Serialize};

/// Upright columns along a box's length and its width.
const COLUMNS: [usize; 2] = [5, 4];
/// Points of each column.
const COLUMN_POINTS: usize = 8;
/// Share of a box's length and width that the columns cover: its skin belongs to the surroundings.
const COLUMNS_FILL: f64 = 0.7;
/// Where columns begin and end, as shares of the box's height above its bottom: clear of the ground, and over the roof.
const COLUMN_SPAN: [f64; 2] = [0.25, 1.05];
/// Log-likelihood ratios of one place are limited to this, so that no place alone decides for all others.
const MAX_LOG_RATIO: f64 = 6.0;
/// Deviations are at least this share of the distance between a place's two means: calibration sees the known states
/// alone, and what lies between them shall be read as doubtful.
const MIN_DEVIATION_SHARE: f64 = 0.2;
/// A reading whose best state explains its places worse than this (mean probability of a place) names no state.
const MIN_MEAN_PROBABILITY: f64 = 0.5;

/// Why probing cannot be set up.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum ProbingError {
    /// There is nothing to probe.
    #[error("there is no place to probe: the scenario names no dynamic box and no candidate")]
    NoPlaces,
    /// A place says of another number of states than there are.
    #[error("place `{name}` says of {given} states, but there are {states}")]
    States {
        /// Which place.
        name: String,
        /// How many it says of.
        given: usize,
        /// How many there are.
        states: usize,
    },
    /// Occupancies for calibration are missing or misshapen.
    #[error("state {state}: {len} occupancies are not a multiple of {places} places, or none")]
    Observations {
        /// Which state.
        state: usize,
        /// Values given.
        len: usize,
        /// Places.
        places: usize,
    },
}

/// A place where something can stand, and the states in which it does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// What can stand there, for example `actor`.
    pub name: String,
    /// Where.
    pub oriented_box: OrientedBox,
    /// Per known state whether it is taken.
    pub occupied_in: Vec<bool>,
}

/// The places of a scenario, and the points to query.
#[derive(Clone, Debug, PartialEq)]
pub struct Prober {
    places: Vec<Place>,
    hazard_states: Vec<bool>,
    points: Vec<[f32; 3]>,
    /// Per place, the length of a column that one of its points stands for, metres.
    point_lengths_m: Vec<f32>,
}

impl Prober {
    /// Sets up the points. `hazard_states` says per state whether the right action there is the hazard one.
    pub fn new(places: Vec<Place>, hazard_states: Vec<bool>) -> Result<Self, ProbingError> {
        if places.is_empty() {
            return Err(ProbingError::NoPlaces);
        }
        for place in &places {
            if place.occupied_in.len() != hazard_states.len() {
                return Err(ProbingError::States {
                    name: place.name.clone(),
                    given: place.occupied_in.len(),
                    states: hazard_states.len(),
                });
            }
        }
        let points = places.iter().flat_map(|p| column_points(&p.oriented_box)).collect();
        let point_lengths_m = places
            .iter()
            .map(|p| {
                let span_m = 2.0 * p.oriented_box.half_size[2] * (COLUMN_SPAN[1] - COLUMN_SPAN[0]);
                (span_m / COLUMN_POINTS as f64) as f32
            })
            .collect();
        Ok(Self { places, hazard_states, points, point_lengths_m })
    }

    /// The places.
    pub fn places(&self) -> &[Place] {
        &self.places
    }

    /// Number of known states.
    pub fn state_count(&self) -> usize {
        self.hazard_states.len()
    }

    /// Per state whether the right action there is the hazard one.
    pub fn hazard_states(&self) -> &[bool] {
        &self.hazard_states
    }

    /// All points to query, metres, world space; each place has as many in a row.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }

    /// Densities at [`Self::points`] (1/m) to one occupancy in 0..=1 per place, written to `occupancies`.
    pub fn occupancies(&self, densities: &[f32], occupancies: &mut [f32]) {
        let columns = COLUMNS[0] * COLUMNS[1];
        let boxes = densities.chunks_exact(columns * COLUMN_POINTS).zip(&self.point_lengths_m);
        for (out, (densities, length_m)) in occupancies.iter_mut().zip(boxes) {
            let stopped = |column: &[f32]| {
                let sum: f32 = column.iter().filter(|d| d.is_finite()).map(|d| d.max(0.0)).sum();
                1.0 - (-sum * length_m).exp()
            };
            let mut shares = [0.0; COLUMNS[0] * COLUMNS[1]];
            for (share, column) in shares.iter_mut().zip(densities.chunks_exact(COLUMN_POINTS)) {
                *share = stopped(column);
            }
            let (_, median, _) = shares.select_nth_unstable_by(columns / 2, f32::total_cmp);
            *out = *median;
        }
    }
}

/// The points of a box, column by column, metres. Heights are staggered from column to column, so that a thin surface
/// between two heights of one is met by others.
fn column_points(b: &OrientedBox) -> Vec<[f32; 3]> {
    let at = |i: usize, n: usize| COLUMNS_FILL * (2.0 * i as f64 / (n - 1) as f64 - 1.0);
    let mut points = Vec::with_capacity(COLUMNS[0] * COLUMNS[1] * COLUMN_POINTS);
    for y in 0..COLUMNS[1] {
        for x in 0..COLUMNS[0] {
            let stagger = ((x * 3 + y * 5) % 7) as f64 / 7.0;
            for z in 0..COLUMN_POINTS {
                let share = (z as f64 + stagger) / COLUMN_POINTS as f64;
                let height = COLUMN_SPAN[0] + (COLUMN_SPAN[1] - COLUMN_SPAN[0]) * share;
                let point = b.point([at(x, COLUMNS[0]), at(y, COLUMNS[1]), 2.0 * height - 1.0]);
                points.push(point.map(|v| v as f32));
            }
        }
    }
    points
}

/// What the known states showed: per place how occupied it looks when taken and when free.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
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

/// What one hypothesis shows.
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

impl Calibration {
    /// Fits on occupancies found in the known states: per state, rows of one value per place, one row a latent.
    pub fn fit(prober: &Prober, occupancies_by_state: &[Vec<f32>]) -> Result<Self, ProbingError> {
        let n = prober.places.len();
        for (state, rows) in occupancies_by_state.iter().enumerate() {
            if rows.is_empty() || rows.len() % n != 0 {
                return Err(ProbingError::Observations { state, len: rows.len(), places: n });
            }
        }
        if occupancies_by_state.len() != prober.state_count() {
            return Err(ProbingError::Observations { state: occupancies_by_state.len(), len: 0, places: n });
        }
        let places = (0..n)
            .map(|p| {
                let values = |taken: bool| -> Vec<f64> {
                    occupancies_by_state
                        .iter()
                        .enumerate()
                        .filter(|(s, _)| prober.places[p].occupied_in[*s] == taken)
                        .flat_map(|(_, rows)| rows.iter().skip(p).step_by(n))
                        .map(|&o| logit(f64::from(o)))
                        .collect()
                };
                let (taken, free) = (moments(&values(true)), moments(&values(false)));
                // A place that is always taken, or always free, tells nothing: both sides alike.
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

    /// Whether it was fitted on as many places as `prober` has.
    pub fn fits(&self, prober: &Prober) -> bool {
        self.places.len() == prober.places.len()
    }

    /// How well taken and free are told apart per place: distance of the means in deviations.
    pub fn separations(&self) -> Vec<f64> {
        self.places
            .iter()
            .map(|p| (p.taken_mean - p.free_mean) / (0.5 * (p.taken_deviation + p.free_deviation)))
            .collect()
    }

    /// Reads one hypothesis from its occupancies (one per place).
    pub fn read(&self, prober: &Prober, occupancies: &[f32]) -> Reading {
        // Per place the probability that it is taken, both being equally likely beforehand.
        let taken: Vec<f64> = self
            .places
            .iter()
            .zip(occupancies)
            .map(|(p, &o)| {
                let x = logit(f64::from(o));
                let log = |mean: f64, deviation: f64| -0.5 * ((x - mean) / deviation).powi(2) - deviation.ln();
                // Beyond the means the far side cannot win by its wider spread.
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
        let logs: Vec<f64> = (0..prober.state_count())
            .map(|s| {
                prober
                    .places
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
        let hazard: f32 = probabilities.iter().zip(&prober.hazard_states).filter(|(_, h)| **h).map(|(p, _)| *p).sum();
        let explained = (highest / prober.places.len() as f64).exp();
        let known = explained >= MIN_MEAN_PROBABILITY;
        Reading {
            state: known.then_some(best),
            confidence: if known { probabilities[best] } else { 0.0 },
            hazard_likelihood: hazard.clamp(0.0, 1.0),
            state_probabilities: probabilities,
        }
    }
}

/// The belief that a set of read samples stands for.
#[derive(Clone, Debug, PartialEq)]
pub struct Resolved {
    /// Probability of each known state; they sum to 1.
    pub state_probabilities: Vec<f32>,
    /// Probability of a hazard state, 0..=1.
    pub hazard_probability: f32,
    /// The most probable state; of equally probable ones, a hazard state first.
    pub state: usize,
}

/// Puts readings together: within a component its samples count alike (with the component's own mean), components
/// count by their weights. That keeps the weights' exact shares, whatever share of the samples a component got.
pub fn resolve(
    prober: &Prober,
    weights: &[f32],
    component_readings: &[Reading],
    sample_readings: &[Reading],
    sample_components: &[usize],
) -> Resolved {
    let states = prober.state_count();
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
    let key = |s: usize| (probabilities[s] / total * 1e6).round() as i64 * 2 + i64::from(prober.hazard_states[s]);
    let state = (0..states).max_by_key(|&s| (key(s), std::cmp::Reverse(s))).unwrap_or(0);
    Resolved {
        state_probabilities: probabilities.iter().map(|p| (p / total) as f32).collect(),
        hazard_probability: (hazard / total_weight).clamp(0.0, 1.0) as f32,
        state,
    }
}

fn logit(p: f64) -> f64 {
    let p = if p.is_finite() { p.clamp(0.005, 0.995) } else { 0.005 };
    (p / (1.0 - p)).ln()
}

/// Mean and deviation; the deviation is kept from vanishing, since calibration sees only so many latents.
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

    /// Three states: something at place 0, at place 1, nowhere.
    fn prober() -> Prober {
        let place = |x: f64, occupied_in: Vec<bool>| Place {
            name: "actor".into(),
            oriented_box: OrientedBox { center: [x, 0.0, 1.0], half_size: [1.0, 0.5, 0.5], yaw: 0.0 },
            occupied_in,
        };
        Prober::new(
            vec![place(0.0, vec![true, false, false]), place(5.0, vec![false, true, false])],
            vec![true, true, false],
        )
        .unwrap()
    }

    fn calibration(prober: &Prober) -> Calibration {
        let rows = |a: f32, b: f32| (0..10).flat_map(|i| [a + 0.01 * i as f32, b + 0.005 * i as f32]).collect();
        Calibration::fit(prober, &[rows(0.8, 0.05), rows(0.05, 0.7), rows(0.03, 0.02)]).unwrap()
    }

    /// Each known state is read back from its own occupancies, "nobody there" among them.
    #[test]
    fn known_states_are_read_back() {
        let p = prober();
        let c = calibration(&p);
        for (occupancies, state, hazard) in [([0.85, 0.05], 0, true), ([0.04, 0.75], 1, true), ([0.02, 0.03], 2, false)]
        {
            let r = c.read(&p, &occupancies);
            assert_eq!(r.state, Some(state));
            assert_eq!(r.hazard_likelihood > 0.5, hazard);
            assert!((r.state_probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        }
    }

    /// Both places taken is no known state: the reading names none, and still says hazard.
    #[test]
    fn what_no_state_explains_is_unknown() {
        let p = prober();
        let r = calibration(&p).read(&p, &[0.85, 0.75]);
        assert_eq!(r.state, None);
        assert!(r.hazard_likelihood > 0.5);
    }

    /// A hollow box with a thin roof is as occupied as a solid one; what lies on the ground below, or far over the roof, is
    /// not in the box.
    #[test]
    fn surfaces_count_like_solids() {
        let p = prober();
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

    /// Densities that are no numbers count as empty, and never panic.
    #[test]
    fn garbage_densities_are_harmless() {
        let p = prober();
        let mut densities = vec![f32::NAN; p.points().len()];
        densities[0] = f32::INFINITY;
        densities[1] = -3.0;
        let mut out = [9.0; 2];
        p.occupancies(&densities, &mut out);
        assert_eq!(out, [0.0, 0.0]);
    }

    /// A component's weight counts exactly, whatever share of the samples it got.
    #[test]
    fn weights_count_exactly() {
        let p = prober();
        let c = calibration(&p);
        let (hazard, clear) = (c.read(&p, &[0.85, 0.05]), c.read(&p, &[0.02, 0.02]));
        let samples = vec![clear.clone(), clear.clone(), clear.clone(), hazard.clone()];
        let r = resolve(&p, &[0.2, 0.8], &[hazard, clear], &samples, &[1, 1, 1, 0]);
        assert!((r.hazard_probability - 0.2).abs() < 0.02, "{}", r.hazard_probability);
        assert_eq!(r.state, 2);
    }

    /// Of equally probable states a hazard state is resolved.
    #[test]
    fn ties_go_to_the_hazard() {
        let p = prober();
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
