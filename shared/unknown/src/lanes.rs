//! The ground on which something unknown counts, and the field's own errors there.

use carff_base::geometry::{OrientedBox, PinholeCamera, TurnedBox};
use carff_field::Field;
use serde::{Deserialize, Serialize};

/// Side of a cell of the error map, as a share of the bounds' longer side.
const CELL_SHARE: f64 = 1.0 / 32.0;

/// Margin of the vehicle itself in the field, metres: its surface is not sharp.
const SURFACE_M: f64 = 0.5;
/// Height above the ground that stays when the vehicle itself is left out of images, metres.
const GROUND_M: f64 = 0.12;

/// A rendered depth hides what is more than this share, and this many metres, behind it: the field's surfaces are not sharp.
const DEPTH_SHARE: f64 = 0.85;
const DEPTH_M: f64 = 0.5;

/// Reports whether a surface at the rendered depth hides what is at a distance along the same ray, metres.
pub(crate) fn is_nearer(depth_m: f64, distance_m: f64) -> bool {
    depth_m < DEPTH_SHARE * distance_m - DEPTH_M
}

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
    /// Boxes of the vehicle itself in the known states.
    pub own: Vec<OwnBox>,
}

/// A place of the vehicle itself in some of the known states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OwnBox {
    /// Box of the vehicle, metres, world space.
    pub oriented_box: OrientedBox,
    /// Margin of its pose, metres: the place varies.
    pub margin_m: f64,
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

    /// Returns a copy of a field whose images do not show the vehicle itself; `None` if no state has it. The ground under
    /// it stays.
    pub fn without_own(&self, field: &Field) -> Option<Field> {
        let above_ground = |own: &OwnBox| {
            let OrientedBox { center, half_size, .. } = own.oriented_box;
            let (low, high) = (self.ground_m + GROUND_M, center[2] + half_size[2] + SURFACE_M);
            let center = [center[0], center[1], f64::midpoint(low, high)];
            let half_size = [half_size[0] + SURFACE_M, half_size[1] + SURFACE_M, 0.5 * (high - low)];
            OrientedBox { center, half_size, ..own.oriented_box }.turned()
        };
        let boxes: Vec<TurnedBox> = self.own.iter().map(above_ground).collect();
        let is_own = |at_m: [f32; 3]| boxes.iter().any(|own| own.contains(at_m.map(f64::from)));
        (!boxes.is_empty()).then(|| field.without(is_own))
    }

    /// Returns those of some pixels (by index, row by row, ascending) that look at a place of the vehicle itself, or past its
    /// margin.
    pub(crate) fn own_pixels(&self, camera: &PinholeCamera, pixels: &[usize]) -> Vec<usize> {
        let holds_camera = |own: &OrientedBox| own.contains(camera.position_m());
        // Every pixel of a camera inside a box looks past that box: a camera next to the vehicle has no margin, and one
        // in its place none of it.
        let outside = |own: &OwnBox| [own.with_margin(), own.oriented_box].into_iter().find(|own| !holds_camera(own));
        let boxes: Vec<TurnedBox> = self.own.iter().filter_map(|own| Some(outside(own)?.turned())).collect();
        let width = camera.width_px.max(1) as usize;
        let shows_it = |pixel: &usize| {
            let ray = camera.ray((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            boxes.iter().any(|own| own.is_met_by(&ray))
        };
        pixels.iter().copied().filter(shows_it).collect()
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

    /// Takes those points off the lanes that something next to the lanes hides in every known state, such as a building.
    /// `depths` has the rendered distance of each pixel in each state, metres, 0 where nothing was rendered.
    pub(crate) fn leave_out_hidden(&self, camera: &PinholeCamera, depths: &[&[f32]], ground: &mut [Option<Ground>]) {
        let (width, is_judged) = (camera.width_px.max(1) as usize, self.judged_ground());
        for (pixel, ground) in ground.iter_mut().enumerate() {
            let Some(ground) = ground.as_mut().filter(|ground| ground.on_lanes) else { continue };
            let ray = camera.ray((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            let at = |depth_m: f64, axis: usize| f64::from(ray.origin[axis]) + depth_m * f64::from(ray.direction[axis]);
            let is_hidden = |depths: &&[f32]| {
                let depth_m = depths.get(pixel).map_or(0.0, |depth| f64::from(*depth));
                let is_rendered = depth_m > 0.0;
                is_rendered && is_nearer(depth_m, ground.distance_m) && !is_judged([0, 1].map(|i| at(depth_m, i)))
            };
            ground.on_lanes = depths.is_empty() || !depths.iter().all(is_hidden);
        }
    }
}

impl OwnBox {
    /// The box with its margin to the sides: the vehicle's height does not vary.
    fn with_margin(&self) -> OrientedBox {
        let [length, width, height] = self.oriented_box.half_size;
        OrientedBox { half_size: [length + self.margin_m, width + self.margin_m, height], ..self.oriented_box }
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

    /// A wall next to the lane hides the lane behind it if every state has the wall. A vehicle on the lane hides no lane:
    /// something else may be in its place.
    #[test]
    fn a_wall_hides_the_lane_behind_it() {
        let camera = PinholeCamera::look_at([0.0, -6.0, 3.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 33, 33, 100.0);
        let (lanes, middle) = (lanes(), 16 * 33 + 16);
        let in_sight = |depths_m: &[f32]| {
            let images: Vec<Vec<f32>> = depths_m.iter().map(|depth_m| vec![*depth_m; 33 * 33]).collect();
            let mut ground = lanes.ground_points(&camera);
            lanes.leave_out_hidden(&camera, &images.iter().map(Vec::as_slice).collect::<Vec<_>>(), &mut ground);
            ground[middle].is_some_and(|ground| ground.on_lanes)
        };
        // The ground is 6.7 m away along this ray, and the edge of the lane 4.5 m.
        assert!(!in_sight(&[3.0, 2.0]), "a wall");
        assert!(in_sight(&[3.0, 6.7]), "a state without the wall");
        assert!(in_sight(&[5.0, 5.0]), "a vehicle on the lane");
        assert!(in_sight(&[6.6, 6.8]) && in_sight(&[0.0, 0.0]) && in_sight(&[]), "nothing");
    }

    /// The pixels of the vehicle itself are those that its box with its margin covers. A camera next to it has no margin,
    /// one on it sees what is below, and one in its place none of it.
    #[test]
    fn own_pixels_are_those_of_the_vehicle() {
        let oriented_box = OrientedBox { center: [0.0, 0.0, 0.5], half_size: [2.0, 1.0, 0.5], yaw: 0.0 };
        let own = OwnBox { oriented_box, margin_m: 0.5 };
        let lanes = Lanes { own: vec![own], ..lanes() };
        let share = |from_m: [f64; 3], to_m: [f64; 3]| {
            let camera = PinholeCamera::look_at(from_m, to_m, [0.0, 1.0, 0.0], 32, 32, 90.0);
            let all: Vec<usize> = (0..32 * 32).collect();
            lanes.own_pixels(&camera, &all).len() as f64 / all.len() as f64
        };
        // Seen from above: 5 m x 3 m at the height of the roof, of 18 m x 18 m.
        let above = share([0.0, 0.0, 10.0], [0.0; 3]);
        assert!((above - 15.0 / 324.0).abs() < 0.02, "{above}");
        assert!(share([2.2, 0.0, 0.8], [0.0; 3]) > 0.9, "beside it");
        assert!((0.3..0.7).contains(&share([0.0, 0.0, 1.2], [9.0, 0.0, 1.2])), "on it, ahead");
        assert_eq!(share([1.9, 0.0, 0.8], [0.0; 3]), 0.0, "in its place");
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
