//! How far an image shows a lane clear: the way along it on which nothing stands, as far as the camera sees.
//!
//! A vehicle that crosses the lane then knows when anybody can arrive first: from the end of that way, at the highest
//! speed (reachable sets behind the edge of sight, Orzechowski et al. 2018).

use crate::lanes::is_nearer;
use crate::{Blob, Comparison};
use carff_base::geometry::{OrientedBox, PinholeCamera};

/// Distance between two points of a lane, metres.
const STEP_M: f64 = 0.5;
/// Most points along a lane.
const MOST_STEPS: u32 = 400;
/// Points across a lane, as shares of its half width.
const ACROSS: [f64; 3] = [-0.6, 0.0, 0.6];
/// Way next to the crossing that a camera may not have in view, metres: shorter than a vehicle.
const BLIND_M: f64 = 3.0;
/// Ratio of a state with a hazard, against the best state without one, below which the image excludes it.
const EXCLUDED: f32 = 0.01;
/// Noise from which on an image shows too little, of 1.
const MOST_NOISE: f32 = 0.06;
/// Step of the search for vehicles on a lane, metres, and the number of steps.
const SCAN_M: f64 = 0.2;
const SCANS: u32 = 200;
/// Smallest overlap of a vehicle's outline with what is unexplained, and the shares of the best overlap from which a
/// place counts as equally good, and as possible.
const LEAST_OVERLAP: f64 = 0.5;
const EQUAL: f64 = 0.98;
const POSSIBLE: f64 = 0.9;
/// Smallest outline, pixels at the compared size.
const LEAST_PX: usize = 12;
/// Pixels around an outline that count against it, as a share of its size.
const AROUND: f64 = 0.25;
/// Space next to a lane that still belongs to it, metres.
const ASIDE_M: f64 = 0.5;

/// The clear ground of one image.
#[derive(Clone, Debug)]
pub struct Sighting {
    camera: PinholeCamera,
    /// Height of the ground, metres.
    ground_m: f64,
    /// For each pixel, the rendered depth of the clear scene, metres; 0 where nothing was compared.
    depth_m: Vec<f32>,
    /// Ground points at which columns of something stand that the best state without a hazard does not have.
    feet_m: Vec<[f64; 2]>,
    /// For each pixel, true if it shows something that the best state without a hazard does not have.
    is_unexplained: Vec<bool>,
    /// For each known state with a hazard, true if the image excludes it.
    is_excluded: Vec<bool>,
}

/// A lane through a place, with the way of a vehicle that crosses it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crossing {
    /// Box of a vehicle on the lane, heading along it.
    pub place: OrientedBox,
    /// A point of the crossing vehicle's way, x and y, metres.
    pub from_m: [f64; 2],
    /// Heading of the crossing vehicle about +Z, radians.
    pub heading_rad: f64,
}

impl Sighting {
    /// Describes a comparison with the states' `ratios`. `unexplained` are the blobs of the best state without a hazard,
    /// `depth_m` its rendered depth, and `best_ratio` its ratio.
    pub(crate) fn new(
        comparison: &Comparison,
        ratios: &[f32],
        best_ratio: f32,
        unexplained: &[Blob],
        depth_m: &[f32],
        ground_m: f64,
    ) -> Self {
        let is_sharp = comparison.fit.noise <= MOST_NOISE;
        let depth = |(depth, judged): (&f32, &bool)| if *judged && is_sharp { *depth } else { 0.0 };
        let mut is_unexplained = vec![false; comparison.judged.len()];
        unexplained.iter().flat_map(|blob| &blob.pixels).for_each(|&pixel| is_unexplained[pixel] = true);
        Self {
            camera: comparison.camera,
            ground_m,
            depth_m: depth_m.iter().zip(&comparison.judged).map(depth).collect(),
            feet_m: unexplained.iter().flat_map(|blob| blob.feet_m.iter().copied()).collect(),
            is_unexplained,
            is_excluded: ratios.iter().map(|ratio| *ratio < EXCLUDED * best_ratio).collect(),
        }
    }

    /// Returns the way along a lane, from the place where a vehicle crosses it against the direction of travel, that the
    /// image shows clear, metres; 0 if something unexplained stands elsewhere. `taken_in` marks the states that have a
    /// vehicle at the lane's place.
    pub fn clear_m(&self, crossing: &Crossing, taken_in: &[bool]) -> f64 {
        let Some(lane) = Line::of(crossing) else { return 0.0 };
        let mut ways_m = (0..MOST_STEPS).map(|i| f64::from(i) * STEP_M);
        let mut clear_m = ways_m.find(|way_m| !self.sees(&lane, *way_m)).unwrap_or(f64::from(MOST_STEPS) * STEP_M);
        for foot in &self.feet_m {
            match lane.behind(self.eye_m(), *foot) {
                Some(at_m) if at_m > -lane.length_m => clear_m = clear_m.min(at_m.max(0.0)),
                Some(_) => {}
                None => return 0.0,
            }
        }
        let is_possible = taken_in.iter().zip(&self.is_excluded).any(|(taken, excluded)| *taken && !excluded);
        if is_possible && lane.front_m > -lane.length_m { clear_m.min(lane.front_m.max(0.0)) } else { clear_m }
    }

    /// Returns the vehicles that the image shows on a lane, the next to the crossing first. The box of the lane's vehicle
    /// is moved along the lane: where its outline covers what no state without a hazard has, and little else, a vehicle
    /// stands.
    pub fn vehicles(&self, crossing: &Crossing) -> Vec<LaneVehicle> {
        let Some(lane) = Line::of(crossing).filter(|_| self.is_unexplained.contains(&true)) else { return Vec::new() };
        let ways_m: Vec<f64> = (0..SCANS).map(|i| f64::from(i) * SCAN_M - lane.length_m).collect();
        let overlaps: Vec<f64> = ways_m.iter().map(|at_m| self.overlap(&lane.vehicle_at(crossing, *at_m))).collect();
        let near = ((lane.length_m / SCAN_M) as usize).max(1);
        let mut found: Vec<LaneVehicle> = Vec::new();
        for (i, &overlap) in overlaps.iter().enumerate() {
            let rivals = &overlaps[i.saturating_sub(near)..(i + near + 1).min(overlaps.len())];
            if overlap < LEAST_OVERLAP || rivals.iter().any(|rival| *rival > overlap) {
                continue;
            }
            // Places next to it that cover nearly as much are as possible: their middle is the estimate.
            let at_least = |share: f64| {
                let covers = |j: &usize| overlaps[*j] >= share * overlap;
                let low = (0..=i).rev().take_while(covers).last().unwrap_or(i);
                let high = (i..overlaps.len()).take_while(covers).last().unwrap_or(i);
                [ways_m[low], ways_m[high]]
            };
            let [low, high] = at_least(EQUAL);
            let at_m = 0.5 * (low + high);
            if found.last().is_none_or(|last| at_m - last.at_m > 0.5 * lane.length_m) {
                found.push(LaneVehicle { at_m, range_m: at_least(POSSIBLE), center_m: lane.point(at_m, 0.0), overlap });
            }
        }
        found
    }

    /// Share that the outline of a vehicle and what is unexplained there have in common: twice the common pixels over the
    /// pixels of both.
    fn overlap(&self, place: &OrientedBox) -> f64 {
        let Some([low, high]) = self.span(place, AROUND) else { return 0.0 };
        let (vehicle, eye) = (place.turned(), self.camera.position_m());
        let way_m = (0..3).map(|i| (place.center[i] - eye[i]).powi(2)).sum::<f64>().sqrt() - place.half_size[0];
        let (width, mut common, mut outline, mut seen) = (self.camera.width_px as usize, 0, 0, 0);
        let is_empty = |row: usize| !self.is_unexplained[row * width + low[0]..=row * width + high[0]].contains(&true);
        if (low[1]..=high[1]).all(is_empty) {
            return 0.0;
        }
        for (row, column) in (low[1]..=high[1]).flat_map(|row| (low[0]..=high[0]).map(move |column| (row, column))) {
            let pixel = row * width + column;
            let depth_m = f64::from(self.depth_m.get(pixel).copied().unwrap_or(0.0));
            // Where nothing was compared, or something is nearer, the vehicle cannot be seen.
            if depth_m <= 0.0 || is_nearer(depth_m, way_m) {
                continue;
            }
            let ray = self.camera.ray(column as f64 + 0.5, row as f64 + 0.5);
            let (is_met, is_unexplained) = (vehicle.is_met_by(&ray), self.is_unexplained[pixel]);
            outline += usize::from(is_met);
            seen += usize::from(is_unexplained);
            common += usize::from(is_met && is_unexplained);
        }
        if outline < LEAST_PX { 0.0 } else { 2.0 * common as f64 / (outline + seen) as f64 }
    }

    /// First and last column and row of the pixels that a box covers, with pixels around it as a share of its size; `None`
    /// if it is behind the camera or out of view.
    fn span(&self, place: &OrientedBox, around: f64) -> Option<[[usize; 2]; 2]> {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for corner in 0..8 {
            let side = |axis: usize| if corner >> axis & 1 == 1 { 1.0 } else { -1.0 };
            let (at_px, _) = self.camera.project(place.point([side(0), side(1), side(2)]))?;
            for axis in 0..2 {
                (low[axis], high[axis]) = (low[axis].min(at_px[axis]), high[axis].max(at_px[axis]));
            }
        }
        let sides = [f64::from(self.camera.width_px), f64::from(self.camera.height_px)];
        let around = [0, 1].map(|axis| around * (high[axis] - low[axis]));
        let first = [0, 1].map(|axis| (low[axis] - around[axis]).max(0.0));
        let last = [0, 1].map(|axis| (high[axis] + around[axis]).min(sides[axis] - 1.0));
        (0..2).all(|axis| first[axis] <= last[axis]).then(|| [first, last].map(|at| at.map(|v| v as usize)))
    }

    fn eye_m(&self) -> [f64; 2] {
        let [x, y, _] = self.camera.position_m();
        [x, y]
    }

    /// Reports whether the camera sees the ground across a lane.
    fn sees(&self, lane: &Line, at_m: f64) -> bool {
        ACROSS.iter().all(|share| {
            let [x, y] = lane.point(at_m, share * lane.half_width_m);
            let point_m = [x, y, self.ground_m];
            let eye_m = self.camera.position_m();
            let distance_m = (0..3).map(|i| (point_m[i] - eye_m[i]).powi(2)).sum::<f64>().sqrt();
            match self.pixel(point_m).and_then(|pixel| self.depth_m.get(pixel)) {
                None => at_m <= BLIND_M,
                Some(&depth_m) => !is_nearer(f64::from(depth_m), distance_m),
            }
        })
    }

    /// The pixel that shows a point; `None` if it is out of view.
    fn pixel(&self, point_m: [f64; 3]) -> Option<usize> {
        let ([x_px, y_px], _) = self.camera.project(point_m)?;
        let (width, height) = (f64::from(self.camera.width_px), f64::from(self.camera.height_px));
        let is_inside = (0.0..width).contains(&x_px) && (0.0..height).contains(&y_px);
        is_inside.then(|| y_px as usize * self.camera.width_px as usize + x_px as usize)
    }
}

/// A vehicle on a lane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LaneVehicle {
    /// Way of its centre from the crossing, against the direction of travel, metres; negative behind the crossing.
    pub at_m: f64,
    /// Smallest and largest such way that the image allows: a part of the vehicle may be hidden or out of view.
    pub range_m: [f64; 2],
    /// Its centre, x and y, metres, world space.
    pub center_m: [f64; 2],
    /// Share that its outline has in common with what the image shows there, 0..=1.
    pub overlap: f64,
}

/// A straight lane, seen from the place where a vehicle crosses it. Ways count against the direction of travel.
#[derive(Clone, Copy, Debug)]
struct Line {
    crossing_m: [f64; 2],
    /// Unit vector against the direction of travel.
    back: [f64; 2],
    half_width_m: f64,
    /// Length of a vehicle, metres.
    length_m: f64,
    /// Way to the front of a vehicle at the lane's place, metres.
    front_m: f64,
}

impl Line {
    /// The lane of a crossing; `None` for a vehicle that drives along it.
    fn of(crossing: &Crossing) -> Option<Self> {
        let OrientedBox { center, half_size, yaw } = crossing.place;
        let (back, ahead) = ([-yaw.cos(), -yaw.sin()], [crossing.heading_rad.cos(), crossing.heading_rad.sin()]);
        let across = ahead[0] * back[1] - ahead[1] * back[0];
        if across.abs() < 0.2 {
            return None;
        }
        let to = [0, 1].map(|i| center[i] - crossing.from_m[i]);
        let way_m = (to[0] * back[1] - to[1] * back[0]) / across;
        let crossing_m = [0, 1].map(|i| crossing.from_m[i] + way_m * ahead[i]);
        let behind_m: f64 = (0..2).map(|i| (center[i] - crossing_m[i]) * back[i]).sum();
        let (half_width_m, length_m) = (half_size[1], 2.0 * half_size[0]);
        Some(Self { crossing_m, back, half_width_m, length_m, front_m: behind_m - half_size[0] })
    }

    /// A point of the lane, x and y.
    fn point(&self, at_m: f64, aside_m: f64) -> [f64; 2] {
        let aside = [-self.back[1], self.back[0]];
        [0, 1].map(|i| self.crossing_m[i] + at_m * self.back[i] + aside_m * aside[i])
    }

    /// The box of the lane's vehicle with its centre at a way along the lane.
    fn vehicle_at(&self, crossing: &Crossing, at_m: f64) -> OrientedBox {
        let [x, y] = self.point(at_m, 0.0);
        OrientedBox { center: [x, y, crossing.place.center[2]], ..crossing.place }
    }

    /// A point in the lane's own axes: the way along it, and its distance to the left of the middle.
    fn local(&self, point_m: [f64; 2]) -> [f64; 2] {
        let from = [0, 1].map(|i| point_m[i] - self.crossing_m[i]);
        [from[0] * self.back[0] + from[1] * self.back[1], from[1] * self.back[0] - from[0] * self.back[1]]
    }

    /// The smallest way at which something on the lane can hide a foot from the eye; `None` if the foot is ahead of the
    /// lane, so that it is elsewhere.
    fn behind(&self, eye_m: [f64; 2], foot_m: [f64; 2]) -> Option<f64> {
        let ([eye_at, eye_aside], [at_m, aside_m]) = (self.local(eye_m), self.local(foot_m));
        let edge_m = eye_aside.signum() * self.half_width_m;
        if eye_aside.abs() <= self.half_width_m {
            return Some(0.0);
        }
        if eye_aside.signum() * aside_m > self.half_width_m + ASIDE_M {
            return None;
        }
        let share = ((eye_aside - edge_m) / (eye_aside - aside_m)).clamp(0.0, 1.0);
        Some(at_m.min(eye_at + share * (at_m - eye_at)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NORTH: f64 = std::f64::consts::FRAC_PI_2;

    /// A lane along x, on which others come from the left, and a vehicle 8 m south of it that heads north.
    fn crossing() -> Crossing {
        let place = OrientedBox { center: [-10.0, 0.0, 0.8], half_size: [2.5, 1.0, 0.8], yaw: 0.0 };
        Crossing { place, from_m: [0.0, -8.0], heading_rad: NORTH }
    }

    /// The view of a camera on that vehicle: level ground without anything on it; the only state has a hazard.
    fn sighting() -> Sighting {
        let camera = PinholeCamera::look_at([0.0, -8.0, 4.0], [-9.0, 0.0, 0.0], [0.0, 0.0, 1.0], 64, 64, 80.0);
        let depth_m = |i: u32| {
            let ray = camera.ray(f64::from(i % 64) + 0.5, f64::from(i / 64) + 0.5);
            if ray.direction[2] < 0.0 { ray.origin[2] / -ray.direction[2] } else { 100.0 }
        };
        let depth_m = (0..64 * 64).map(depth_m).collect();
        let is_unexplained = vec![false; 64 * 64];
        Sighting { camera, ground_m: 0.0, depth_m, feet_m: Vec::new(), is_unexplained, is_excluded: vec![true] }
    }

    fn clear_m(sighting: &Sighting) -> f64 {
        sighting.clear_m(&crossing(), &[true])
    }

    /// An empty lane is clear as far as the view reaches, up to a building, or to the edge of what was compared.
    #[test]
    fn a_lane_is_clear_as_far_as_it_is_in_sight() {
        let open = sighting();
        let all_m = clear_m(&open);
        assert!(all_m > 20.0, "{all_m}");
        for depth in [3.0, 0.0] {
            let mut hidden = open.clone();
            let beyond = open.pixel([-6.0, 0.0, 0.0]).unwrap() % 64;
            (0..64 * 64).filter(|i| i % 64 <= beyond).for_each(|i| hidden.depth_m[i] = depth);
            assert!((3.5..6.5).contains(&clear_m(&hidden)), "{}", clear_m(&hidden));
        }
    }

    /// The way ends at the smallest one at which something can stand in the direction of what is unexplained. What has
    /// passed the crossing does not count; what stands ahead of the lane leaves nothing clear.
    #[test]
    fn something_ends_the_clear_way() {
        let with = |foot: [f64; 2]| clear_m(&Sighting { feet_m: vec![[-15.0, 0.0], foot], ..sighting() });
        assert!((6.9..=7.1).contains(&with([-7.0, -1.0])), "{}", with([-7.0, -1.0]));
        // The lower part of what stands at 7 m may look like the road: the ground behind it is farther away.
        assert!((6.9..=7.1).contains(&with([-9.0, 1.0])), "{}", with([-9.0, 1.0]));
        assert!((12.0..15.0).contains(&with([9.0, 0.0])), "{}", with([9.0, 0.0]));
        assert_eq!(with([1.0, 0.0]), 0.0);
        assert_eq!(with([-7.0, -4.0]), 0.0);
    }

    /// A vehicle is found where its outline is unexplained. One with both ends hidden may be nearer or farther away; what has another outline is not a vehicle.
    #[test]
    fn vehicles_are_found_on_the_lane() {
        let with = |at_m: f64| {
            let mut sighting = sighting();
            let vehicle = Line::of(&crossing()).unwrap().vehicle_at(&crossing(), at_m).turned();
            for pixel in 0..64 * 64_u32 {
                let ray = sighting.camera.ray(f64::from(pixel % 64) + 0.5, f64::from(pixel / 64) + 0.5);
                sighting.is_unexplained[pixel as usize] = vehicle.is_met_by(&ray);
                let is_met = sighting.is_unexplained[pixel as usize];
                sighting.depth_m[pixel as usize] = if is_met { 30.0 } else { sighting.depth_m[pixel as usize] };
            }
            sighting
        };
        for at_m in [6.0, 7.3, 9.1, 12.4] {
            let found = with(at_m).vehicles(&crossing());
            assert_eq!(found.len(), 1);
            let found = found[0];
            assert!((found.at_m - at_m).abs() < 0.3 && (found.center_m[0] + at_m).abs() < 0.3, "{at_m} {found:?}");
        }
        let mut hidden = with(9.0);
        let [left, right] = [-10.0, -8.0].map(|x| hidden.pixel([x, 0.0, 1.0]).unwrap() % 64);
        for pixel in (0..64 * 64).filter(|pixel| !(left..right).contains(&(pixel % 64))) {
            (hidden.depth_m[pixel], hidden.is_unexplained[pixel]) = (3.0, false);
        }
        let found = hidden.vehicles(&crossing())[0];
        assert!(found.range_m[0] < 8.3 && found.range_m[1] > 9.7, "{found:?}");
        let mut other = with(9.0);
        (0..64 * 64).filter(|pixel| pixel / 64 % 4 > 0).for_each(|pixel| other.is_unexplained[pixel] = false);
        assert_eq!((other.vehicles(&crossing()), sighting().vehicles(&crossing())), (vec![], vec![]));
    }

    /// A state with a hazard that the image does not exclude ends the way at its vehicle, unless that is past the crossing.
    #[test]
    fn a_possible_hazard_ends_the_clear_way() {
        let possible = Sighting { is_excluded: vec![false], ..sighting() };
        assert_eq!(clear_m(&possible), 7.5);
        assert!(possible.clear_m(&crossing(), &[false]) > 20.0);
        let mut passed = crossing();
        passed.place.center[0] = 12.0;
        assert!(possible.clear_m(&passed, &[true]) > 20.0);
    }

    /// A vehicle that drives along a lane does not cross it, and one on it has nothing clear ahead of something.
    #[test]
    fn a_lane_that_is_not_crossed_is_not_clear() {
        assert_eq!(sighting().clear_m(&Crossing { heading_rad: 0.0, ..crossing() }, &[true]), 0.0);
        let mut on_it = Sighting { feet_m: vec![[-7.0, 0.0]], ..sighting() };
        on_it.camera.world_from_camera[1][3] = 0.0;
        assert_eq!(clear_m(&on_it), 0.0);
    }
}
