//! The places to probe, the points to query in them, and their occupancies.
//!
//! A field trained on images learns surfaces: no image shows whether a vehicle is hollow. The points are therefore in
//! upright columns, and a place is as occupied as its median column is opaque: a vehicle stops light nearly everywhere,
//! haze or a neighbour's shadow only in a few places.

use carff_base::geometry::OrientedBox;
use serde::{Deserialize, Serialize};

/// Upright columns along a box's length and its width.
const COLUMNS: [usize; 2] = [5, 4];
/// Points of each column.
const COLUMN_POINTS: usize = 8;
/// Share of a box's length and width that the columns cover: its skin belongs to the surroundings.
const COLUMNS_FILL: f64 = 0.7;
/// Start and end of the columns, as shares of the box's height above its bottom: above the ground, and beyond the roof.
const COLUMN_SPAN: [f64; 2] = [0.25, 1.05];
/// Reason why probing cannot be set up.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum ProbingError {
    /// There is nothing to probe.
    #[error("there is no place to probe: the scenario names no dynamic box and no candidate")]
    NoPlaces,
    /// A place has another number of states than the scenario.
    #[error("place `{name}` has {given} states, but there are {states}")]
    States {
        /// Name of the place.
        name: String,
        /// Number of states of the place.
        given: usize,
        /// Number of states of the scenario.
        states: usize,
    },
    /// Occupancies for calibration are missing or misshapen.
    #[error("state {state}: {len} occupancies are not a multiple of {places} places, or none")]
    Observations {
        /// Index of the state.
        state: usize,
        /// Number of values.
        len: usize,
        /// Number of places.
        places: usize,
    },
}

/// A place that an actor can occupy, and the states in which it does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// Name of the possible occupant, for example `actor`.
    pub name: String,
    /// Box of the place, world space, metres.
    pub oriented_box: OrientedBox,
    /// For each known state, true if the place is taken.
    pub occupied_in: Vec<bool>,
}

/// The places of a scenario and the points to query in them.
///
/// ```
/// use carff_decision::{ProbeCalibration, Place, ProbeLayout};
/// use carff_base::geometry::OrientedBox;
/// let place = |x: f64, occupied_in: Vec<bool>| Place {
///     name: "actor".into(),
///     oriented_box: OrientedBox { center: [x, 0.0, 1.0], half_size: [1.0, 1.0, 1.0], yaw: 0.0 },
///     occupied_in,
/// };
/// let places = vec![place(-5.0, vec![true, false]), place(5.0, vec![false, false])];
/// let layout = ProbeLayout::new(places, vec![true, false])?;
/// // State 0 shows something at the first place, state 1 nothing at all.
/// let known = vec![vec![0.9, 0.1, 0.8, 0.0], vec![0.1, 0.1, 0.0, 0.05]];
/// let calibration = ProbeCalibration::fit(&layout, &known)?;
/// let reading = calibration.read(&layout, &[0.85, 0.02]);
/// assert_eq!(reading.state, Some(0));
/// assert!(reading.hazard_likelihood > 0.9);
/// # Ok::<(), carff_decision::ProbingError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct ProbeLayout {
    places: Vec<Place>,
    hazard_states: Vec<bool>,
    /// Per state, the states that take the same places, itself included.
    alike: Vec<Vec<usize>>,
    points: Vec<[f32; 3]>,
    /// Per place, the length of a column that one of its points stands for, metres.
    point_lengths_m: Vec<f32>,
}

impl ProbeLayout {
    /// Sets up the points. `hazard_states` is true for each state that is a hazard.
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
        let states = 0..hazard_states.len();
        let same = |a: usize, b: usize| places.iter().all(|place| place.occupied_in[a] == place.occupied_in[b]);
        let alike = states.clone().map(|a| states.clone().filter(|&b| same(a, b)).collect()).collect();
        Ok(Self { places, hazard_states, alike, points, point_lengths_m })
    }

    /// Returns the places.
    pub fn places(&self) -> &[Place] {
        &self.places
    }

    /// Returns the places that only states with the hazard take.
    pub fn hazard_places(&self) -> impl Iterator<Item = &Place> {
        self.places.iter().filter(|place| {
            let mut states = place.occupied_in.iter().zip(&self.hazard_states);
            place.occupied_in.contains(&true) && states.all(|(taken, hazard)| !taken || *hazard)
        })
    }

    /// Returns the number of known states.
    pub fn state_count(&self) -> usize {
        self.hazard_states.len()
    }

    /// Returns for each state whether it is a hazard.
    pub fn hazard_states(&self) -> &[bool] {
        &self.hazard_states
    }

    /// Returns the states that probing cannot distinguish from `state`, itself included: they take the same places.
    pub fn alike(&self, state: usize) -> &[usize] {
        self.alike.get(state).map_or(&[], Vec::as_slice)
    }

    /// Returns all points to query, metres, world space; the points of a place are consecutive.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }

    /// Converts densities at [`Self::points`] (1/m) to one occupancy in 0..=1 per place, written to `occupancies`.
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
