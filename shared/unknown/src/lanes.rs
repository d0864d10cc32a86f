//! The ground on which something unknown counts, and the field's own errors there.

use carff_base::geometry::{OrientedBox, PinholeCamera, TurnedBox};
use serde::{Deserialize, Serialize};

/// Side of a cell of the error map, as a share of the bounds' longer side.
const CELL_SHARE: f64 = 1.0 / 32.0;

/// Height above the vehicle itself in which a camera is mounted on it, metres.
const ABOVE_ROOF_M: f64 = 1.0;

/// The parts of the ground on which something unknown is a hazard: roads, or the surroundings of the probed places.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lanes {
    /// Areas, metres, world space; their heights do not count.
    pub areas: Vec<OrientedBox>,
    /// Height of the ground, metres.
    pub ground_m: f64,
    /// Limits of the field in x and y, metres: low and high corner. Beyond them nothing is judged.
    pub bounds_m: [[f64; 2]; 2],
    /// Distance from the camera below which nothing is judged, metres: the vehicle that carries the camera.
    pub nearest_m: f64,
    /// Boxes of the vehicle itself. Its place varies by a margin, so a state may explain the pixels behind them in two
    /// ways: with the vehicle there, or elsewhere.
    pub own: Vec<OwnBox>,
}

/// The vehicle itself in some of the known states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnBox {
    /// Box of the vehicle, metres, world space.
    pub oriented_box: OrientedBox,
    /// Margin of its pose, metres.
    pub margin_m: f64,
    /// For each known state, true if the vehicle is there.
    pub states: Vec<bool>,
}

impl Lanes {
    /// Returns the test whether a point of the ground is on an area, within the bounds.
    fn judged_ground(&self) -> impl Fn([f64; 2]) -> bool {
        let areas: Vec<(TurnedBox, f64)> = self.areas.iter().map(|area| (area.turned(), area.center[2])).collect();
        let [low, high] = self.bounds_m;
        move |[x, y]| {
            let inside = x >= low[0] && x <= high[0] && y >= low[1] && y <= high[1];
            inside && areas.iter().any(|(area, z)| area.contains([x, y, *z]))
        }
    }

    /// For each of some states, returns those of the pixels (by index, row by row) that look at the vehicle itself, or
    /// past its margin, in this state.
    pub fn own_pixels(&self, camera: &PinholeCamera, states: usize, pixels: &[usize]) -> Vec<Vec<usize>> {
        let [x, y, z] = camera.position_m();
        let holds_camera = |own: &OrientedBox| {
            let top_m = own.center[2] + own.half_size[2] + ABOVE_ROOF_M;
            z < top_m && own.contains([x, y, own.center[2]])
        };
        // Every pixel of a camera inside a box looks past that box: a camera next to the vehicle has no margin, and one
        // on it sees none of it beyond the nearest distance.
        let outside = |own: &OwnBox| [own.with_margin(), own.oriented_box].into_iter().find(|own| !holds_camera(own));
        let boxes = self.own.iter().filter_map(|own| Some((outside(own)?.turned(), &own.states)));
        let boxes: Vec<(TurnedBox, &Vec<bool>)> = boxes.collect();
        let width = camera.width_px.max(1) as usize;
        let mut of_states = vec![Vec::new(); states];
        for &pixel in if boxes.is_empty() { &[] } else { pixels } {
            let ray = camera.ray((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            let mut shows_it = vec![false; states];
            for (_, stands) in boxes.iter().filter(|(own, _)| own.is_met_by(&ray)) {
                shows_it.iter_mut().zip(*stands).for_each(|(shows, stands)| *shows |= stands);
            }
            of_states
                .iter_mut()
                .zip(shows_it)
                .filter(|(_, shows)| *shows)
                .for_each(|(of_state, _)| of_state.push(pixel));
        }
        of_states
    }

    /// Returns the points of the ground that the pixels of a camera look at, row by row: distance along the ray and
    /// position, metres. `None` where a pixel looks at no ground that is judged: above the horizon, or too near.
    pub fn ground_points(&self, camera: &PinholeCamera) -> Vec<Option<Ground>> {
        let (width, height) = (camera.width_px, camera.height_px);
        let is_judged = self.judged_ground();
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        pixels
            .map(|(x, y)| {
                let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let (origin, direction) = (ray.origin.map(f64::from), ray.direction.map(f64::from));
                let distance_m = (self.ground_m - origin[2]) / direction[2];
                let is_below = direction[2] < 0.0 && distance_m.is_finite() && distance_m >= self.nearest_m;
                is_below.then(|| {
                    let at_m = [0, 1].map(|i| origin[i] + distance_m * direction[i]);
                    Ground { distance_m, at_m, on_lanes: is_judged(at_m) }
                })
            })
            .collect()
    }
}

impl OwnBox {
    fn with_margin(&self) -> OrientedBox {
        OrientedBox { half_size: self.oriented_box.half_size.map(|half| half + self.margin_m), ..self.oriented_box }
    }
}

/// A point of the ground that a pixel looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// Distance from the camera along the ray, metres.
    pub distance_m: f64,
    /// Position, x and y, metres, world space.
    pub at_m: [f64; 2],
    /// True on the lanes.
    pub on_lanes: bool,
}

/// The residual that known states leave on each cell of the ground: the field's own errors, in deviations of a pixel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorMap {
    /// Low corner, x and y, metres.
    origin_m: [f64; 2],
    /// Side of a cell, metres.
    cell_m: f64,
    /// Cells along x and y.
    size: [usize; 2],
    /// Residual of each cell that known states hardly exceed, row by row.
    residual: Vec<f32>,
}

impl ErrorMap {
    /// A map over the bounds of lanes in which known states leave `residual` everywhere.
    pub fn even(lanes: &Lanes, residual: f32) -> Self {
        let [low, high] = lanes.bounds_m;
        let side = (high[0] - low[0]).max(high[1] - low[1]).max(1e-6);
        let cell_m = side * CELL_SHARE;
        let size = [0, 1].map(|i| (((high[i] - low[i]) / cell_m).ceil() as usize).max(1));
        Self { origin_m: low, cell_m, size, residual: vec![residual; size[0] * size[1]] }
    }

    /// Returns the index of a point's cell; points outside the map belong to its nearest cell.
    fn cell(&self, at_m: [f64; 2]) -> usize {
        let [x, y] =
            [0, 1].map(|i| (((at_m[i] - self.origin_m[i]) / self.cell_m).max(0.0) as usize).min(self.size[i] - 1));
        y * self.size[0] + x
    }

    /// Returns the residual at a point of the ground.
    pub fn at(&self, at_m: [f64; 2]) -> f32 {
        self.residual.get(self.cell(at_m)).copied().unwrap_or(1.0)
    }

    /// Fits a map on residuals of known images: points of the ground with the residual of the pixel that looks at it.
    /// A cell has the 90th percentile of its own and its neighbours' residuals, but at least the median cell's and one
    /// deviation.
    pub fn fit(lanes: &Lanes, points: &[([f64; 2], f32)]) -> Self {
        let mut map = Self::even(lanes, 1.0);
        let [columns, rows] = map.size;
        let mut of_cell: Vec<Vec<f32>> = vec![Vec::new(); columns * rows];
        for (at_m, residual) in points {
            of_cell[map.cell(*at_m)].push(*residual);
        }
        let around = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
        let mut measured = Vec::new();
        for y in 0..rows {
            for x in 0..columns {
                let mut near: Vec<f32> = around(y, rows)
                    .flat_map(|y| around(x, columns).map(move |x| y * columns + x))
                    .flat_map(|cell| of_cell[cell].iter().copied())
                    .collect();
                near.sort_by(f32::total_cmp);
                let value = near.get(near.len() * 9 / 10).copied().unwrap_or(0.0);
                map.residual[y * columns + x] = value;
                measured.extend((!near.is_empty()).then_some(value));
            }
        }
        measured.sort_by(f32::total_cmp);
        let median = measured.get(measured.len() / 2).copied().unwrap_or(1.0).max(1.0);
        map.residual.iter_mut().for_each(|value| *value = value.max(median));
        map
    }

    /// Reports whether the map can be used: sizes that agree, and residuals above 0.
    pub(crate) fn is_valid(&self) -> bool {
        self.size[0] * self.size[1] == self.residual.len()
            && !self.residual.is_empty()
            && self.cell_m > 0.0
            && self.residual.iter().all(|v| v.is_finite() && *v > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lanes() -> Lanes {
        Lanes {
            areas: vec![OrientedBox { center: [0.0, 0.0, 0.0], half_size: [10.0, 2.0, 1.0], yaw: 0.0 }],
            ground_m: 0.0,
            bounds_m: [[-8.0, -8.0], [8.0, 8.0]],
            nearest_m: 2.0,
            own: Vec::new(),
        }
    }

    /// A point counts on an area and within the bounds, at any height of the area's box.
    #[test]
    fn lanes_are_areas_within_the_bounds() {
        let lanes = lanes();
        let is_judged = lanes.judged_ground();
        assert!(is_judged([7.0, -1.9]));
        assert!(!is_judged([9.0, 0.0]) && !is_judged([0.0, 2.1]));
    }

    /// A camera that looks down at the lane sees it in the middle, and no ground above the horizon.
    #[test]
    fn pixels_look_at_the_ground() {
        let camera = PinholeCamera::look_at([0.0, -6.0, 3.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 33, 33, 100.0);
        let points = lanes().ground_points(&camera);
        let middle = points[16 * 33 + 16].expect("ground in the middle");
        assert!(middle.on_lanes && middle.at_m.iter().all(|v| v.abs() < 0.3), "{middle:?}");
        assert!((middle.distance_m - 45.0_f64.sqrt()).abs() < 0.5);
        assert_eq!(points[16], None);
    }

    /// The pixels of the vehicle itself are those that its box with its margin covers, in the states in which it is
    /// there. A camera next to it has no margin, and a camera on it no such pixels.
    #[test]
    fn own_pixels_are_those_of_the_vehicle() {
        let oriented_box = OrientedBox { center: [0.0, 0.0, 0.5], half_size: [2.0, 1.0, 0.5], yaw: 0.0 };
        let own = OwnBox { oriented_box, margin_m: 0.5, states: vec![true, false] };
        let lanes = Lanes { own: vec![own], ..lanes() };
        let share = |from_m: [f64; 3], state: usize| {
            let camera = PinholeCamera::look_at(from_m, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 32, 32, 90.0);
            let all: Vec<usize> = (0..32 * 32).collect();
            lanes.own_pixels(&camera, 2, &all)[state].len() as f64 / all.len() as f64
        };
        // Seen from above: 5 m x 3 m at the height of the roof, of 17 m x 17 m.
        let above = share([0.0, 0.0, 10.0], 0);
        assert!((above - 15.0 / 289.0).abs() < 0.02, "{above}");
        assert_eq!(share([0.0, 0.0, 10.0], 1), 0.0, "it stands elsewhere");
        assert!((0.1..0.9).contains(&share([2.2, 0.0, 1.2], 0)), "beside it");
        assert_eq!(share([1.9, 0.0, 1.2], 0), 0.0, "on it");
    }

    /// A cell with large residuals tolerates more than the others, which tolerate the median.
    #[test]
    fn errors_are_local() {
        let points: Vec<([f64; 2], f32)> = (0..160)
            .flat_map(|i| {
                let x = -8.0 + 0.1 * f64::from(i);
                [([x, 0.0], 1.0), ([x, 0.0], if x > 6.5 { 9.0 } else { 1.0 })]
            })
            .collect();
        let map = ErrorMap::fit(&lanes(), &points);
        assert!(map.is_valid());
        assert_eq!((map.at([0.0, 0.0]), map.at([7.5, 0.0])), (1.0, 9.0));
        assert_eq!(map.at([0.0, -7.0]), 1.0, "a cell that no image showed");
    }
}
