//! The occupancy grid: what each known state takes on the ground, weighed by the belief.

use carff_checkpoint::{FieldProbe, StepRates};
use carff_decision::ProbeLayout;
use carff_messages::{Belief, LATENT_DIM, MAX_CELLS, MAX_HORIZON, Occupancy, UnknownBox};

/// Number of cells along the longer side of the grid.
const LONGEST: usize = 32;
/// Number of heights at which a column is probed. They are spread over the lower part of the field, from above the ground.
const HEIGHTS: usize = 8;
/// Largest height that counts, metres: bridges and crowns of trees are not in the way.
const HIGHEST_M: f32 = 2.2;
/// Lowest and highest probed height, as shares of the height that counts.
const SHARES: [f32; 2] = [0.14, 0.94];
/// Columns in a cell along each axis.
const COLUMNS: usize = 2;

/// The taken cells of each known state, probed once.
#[derive(Clone, Debug)]
pub struct Grid {
    columns: usize,
    rows: usize,
    cell_m: f64,
    low_corner_m: [f64; 2],
    ground_m: f32,
    /// Height above the ground that counts, metres.
    height_m: f32,
    /// For each state, the taken share of each cell, 0..=1.
    taken: Vec<Vec<f32>>,
    /// For each cell, true if its middle is on the lane of a vehicle that is a hazard.
    on_lane: Vec<bool>,
    /// Rates on these cells at each step of the look-ahead; `None`: the known states hold exactly.
    rates: Option<StepRates>,
}

impl Grid {
    /// Probes the field in every known state, within its bounds. Without `rates` the known states hold exactly.
    pub fn probe(probe: &FieldProbe, rates: Option<StepRates>) -> Self {
        let bounds_m = probe.field().config().bounds_m.map(|corner| corner.map(f64::from));
        let side_m = [0, 1].map(|axis| bounds_m[1][axis] - bounds_m[0][axis]);
        let cell_m = (side_m[0].max(side_m[1]) / LONGEST as f64).max(1e-3);
        let [columns, rows] = side_m.map(|side| ((side / cell_m).ceil() as usize).clamp(1, LONGEST));
        let mut grid = Self {
            columns,
            rows,
            cell_m,
            low_corner_m: [bounds_m[0][0], bounds_m[0][1]],
            ground_m: bounds_m[0][2] as f32,
            height_m: ((bounds_m[1][2] - bounds_m[0][2]) as f32).min(HIGHEST_M),
            taken: Vec::new(),
            on_lane: Vec::new(),
            rates,
        };
        grid.on_lane = (0..columns * rows).map(|cell| is_on_lane(probe.layout(), grid.middle_m(cell))).collect();
        let points = grid.points();
        let of_state = |latent: &[f32; LATENT_DIM]| {
            let mut densities = vec![0.0; points.len()];
            probe.field().density(&points, latent, &mut densities);
            grid.shares(&densities)
        };
        let taken = probe.states().iter().map(|state| of_state(&state.mean)).collect();
        grid.taken = taken;
        grid
    }

    /// The points of each cell, column by column, bottom to top.
    fn points(&self) -> Vec<[f32; 3]> {
        let mut points = Vec::with_capacity(self.columns * self.rows * COLUMNS * COLUMNS * HEIGHTS);
        for cell in 0..self.columns * self.rows {
            for column in 0..COLUMNS * COLUMNS {
                let place = [cell % self.columns, cell / self.columns];
                let inner = [column % COLUMNS, column / COLUMNS];
                let at = |axis: usize| {
                    let share = (inner[axis] as f64 + 0.5) / COLUMNS as f64;
                    (self.low_corner_m[axis] + (place[axis] as f64 + share) * self.cell_m) as f32
                };
                points.extend((0..HEIGHTS).map(|i| {
                    let share = SHARES[0] + (SHARES[1] - SHARES[0]) * i as f32 / (HEIGHTS - 1) as f32;
                    [at(0), at(1), self.ground_m + share * self.height_m]
                }));
            }
        }
        points
    }

    /// The opaque share of each cell's columns.
    fn shares(&self, densities: &[f32]) -> Vec<f32> {
        let step_m = (SHARES[1] - SHARES[0]) * self.height_m / (HEIGHTS - 1) as f32;
        let opacity = |column: &[f32]| 1.0 - (-column.iter().sum::<f32>() * step_m).exp();
        let cells = densities.chunks_exact(COLUMNS * COLUMNS * HEIGHTS);
        let share = |cell: &[f32]| {
            let columns = cell.chunks_exact(HEIGHTS);
            columns.map(opacity).sum::<f32>() / (COLUMNS * COLUMNS) as f32
        };
        cells.map(|cell| share(cell).clamp(0.0, 1.0)).collect()
    }

    /// Returns the grid of a belief. What is probable but unknown has no place, unless it is in one of the boxes; what
    /// every state takes is taken. On the others' lane, all of it counts with the rates of the step.
    pub fn occupancy(&self, belief: &Belief, unknown: &[UnknownBox]) -> Occupancy {
        let probabilities = &belief.state_probability[..self.taken.len().min(belief.state_probability.len())];
        let mut occupancy = Occupancy::empty(belief.header);
        (occupancy.columns, occupancy.rows) = (self.columns as u32, self.rows as u32);
        (occupancy.cell_m, occupancy.low_corner_m) = (self.cell_m as f32, self.low_corner_m.map(|v| v as f32));
        occupancy.unknown_probability = belief.unknown_probability;
        let other = (1.0 - probabilities.iter().sum::<f32>()).max(0.0);
        let step = (belief.header.step.max(1) as usize - 1).min(MAX_HORIZON as usize - 1);
        let rates = self.rates.map(|rates| rates[step]);
        for (cell, to) in occupancy.probability.iter_mut().take((self.columns * self.rows).min(MAX_CELLS)).enumerate() {
            let known: f32 = probabilities.iter().zip(&self.taken).map(|(p, taken)| p * taken[cell]).sum();
            let still = self.taken.iter().map(|taken| taken[cell]).fold(1.0, f32::min);
            let taken = known + other * still;
            let free = unknown.iter().filter(|b| self.is_in(cell, b)).map(|b| 1.0 - b.probability).product::<f32>();
            let mut occupied = 1.0 - (1.0 - taken) * free;
            if let Some(rates) = rates.filter(|_| self.on_lane[cell]) {
                occupied = rates.of(f64::from(occupied)) as f32;
            }
            *to = occupied.clamp(0.0, 1.0);
        }
        occupancy
    }

    /// Reports whether the middle of a cell is in a box.
    fn is_in(&self, cell: usize, unknown: &UnknownBox) -> bool {
        let middle_m = self.middle_m(cell);
        (0..2).all(|axis| (middle_m[axis] - unknown.center[axis]).abs() <= unknown.half_size[axis])
    }

    /// Returns the middle of a cell, x and y in metres.
    fn middle_m(&self, cell: usize) -> [f64; 2] {
        let place = [cell % self.columns, cell / self.columns];
        [0, 1].map(|axis| self.low_corner_m[axis] + (place[axis] as f64 + 0.5) * self.cell_m)
    }
}

/// Reports whether a point is on the lane of a place that only states with the hazard take: in the place's box, extended
/// along its heading.
fn is_on_lane(layout: &ProbeLayout, [x, y]: [f64; 2]) -> bool {
    layout.hazard_places().any(|place| {
        let of = &place.oriented_box;
        let aside_m = (y - of.center[1]) * of.yaw.cos() - (x - of.center[0]) * of.yaw.sin();
        aside_m.abs() <= of.half_size[1]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::OrientedBox;
    use carff_checkpoint::OccupancyRates;
    use carff_messages::Header;

    /// Two states on two cells: one takes the first cell; both take half of the second.
    fn grid() -> Grid {
        let taken = vec![vec![1.0, 0.5], vec![0.0, 0.5]];
        Grid {
            columns: 2,
            rows: 1,
            cell_m: 1.0,
            low_corner_m: [0.0, 0.0],
            ground_m: 1.0,
            height_m: 2.0,
            taken,
            on_lane: vec![true, false],
            rates: None,
        }
    }

    /// A cell is taken with the probability of the states that take it; the unknown counts where everyone is, and in its
    /// boxes.
    #[test]
    fn cells_are_weighed_by_the_belief() {
        let mut belief = Belief::empty(Header::of_frame(1, 2, 3).at_step(1), 2);
        belief.state_count = 2;
        belief.state_probability[..2].copy_from_slice(&[0.25, 0.5]);
        belief.unknown_probability = 0.25;
        let occupancy = grid().occupancy(&belief, &[]);
        assert_eq!(occupancy.cells(), [0.25, 0.5]);
        assert_eq!((occupancy.unknown_probability, occupancy.header.step), (0.25, 1));
        let unknown = UnknownBox { center: [0.5, 0.5, 0.5], half_size: [0.4; 3], probability: 0.8, place: -1 };
        let occupancy = grid().occupancy(&belief, &[unknown]);
        assert!((occupancy.cells()[0] - 0.85).abs() < 1e-6 && occupancy.cells()[1] == 0.5, "{:?}", occupancy.cells());
    }

    /// On the lane, a cell counts with the learned rates of its step; off the lane it does not.
    #[test]
    fn cells_on_the_lane_have_rates() {
        let mut grid = grid();
        let mut rates = [OccupancyRates::EXACT; MAX_HORIZON as usize];
        rates[1] = OccupancyRates { where_free: 0.1, where_taken: 0.6 };
        grid.rates = Some(rates);
        let of_step = |grid: &Grid, step| {
            let mut belief = Belief::empty(Header::of_frame(1, 2, 3).at_step(step), 2);
            belief.state_count = 2;
            belief.state_probability[..2].copy_from_slice(&[0.25, 0.75]);
            grid.occupancy(&belief, &[]).cells().to_vec()
        };
        let near = |found: Vec<f32>, wanted: [f32; 2]| {
            assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?}");
        };
        near(of_step(&grid, 1), [0.25, 0.5]);
        near(of_step(&grid, 2), [0.225, 0.5]);
        grid.on_lane[1] = true;
        near(of_step(&grid, 2), [0.225, 0.35]);
    }

    /// The lane is the place's box, extended along its heading; places that are taken without the hazard have none.
    #[test]
    fn lanes_continue_the_places() {
        let place = |occupied_in: [bool; 2], yaw: f64| carff_decision::Place {
            name: "actor".into(),
            oriented_box: OrientedBox { center: [1.0, 2.0, 0.5], half_size: [2.0, 1.0, 0.5], yaw },
            occupied_in: occupied_in.to_vec(),
        };
        let is_on = |places, at| is_on_lane(&ProbeLayout::new(places, vec![true, false]).unwrap(), at);
        assert!(is_on(vec![place([true, false], 0.0)], [-30.0, 2.9]));
        assert!(!is_on(vec![place([true, false], 0.0)], [1.0, 3.1]));
        assert!(is_on(vec![place([true, false], std::f64::consts::FRAC_PI_2)], [1.9, 30.0]));
        assert!(!is_on(vec![place([true, true], 0.0)], [1.0, 2.0]));
    }

    /// Columns without density are free, and dense ones are taken.
    #[test]
    fn dense_columns_are_taken() {
        let grid = grid();
        let per_cell = COLUMNS * COLUMNS * HEIGHTS;
        let densities: Vec<f32> = (0..2 * per_cell).map(|i| if i < per_cell / 2 { 100.0 } else { 0.0 }).collect();
        assert_eq!(grid.shares(&densities), [0.5, 0.0]);
        let points = grid.points();
        assert_eq!((points.len(), points[0]), (2 * per_cell, [0.25, 0.25, 1.28]));
    }
}
