//! How far an image shows a lane clear: the way along it on which nothing stands, as far as the camera sees.
//!
//! A vehicle that crosses the lane then knows when anybody can arrive first: from the end of that way, at the highest
//! speed (reachable sets behind the edge of sight, Orzechowski et al. 2018).

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
/// Rendered depth that counts as the ground behind it: a share of its distance, and a way, metres.
const DEPTH_SHARE: f64 = 0.85;
const DEPTH_M: f64 = 0.5;
/// Ratio of a state with a hazard, against the best state without one, below which the image excludes it.
const EXCLUDED: f32 = 0.01;
/// Noise from which on an image shows too little, of 1.
const MOST_NOISE: f32 = 0.06;
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
        Self {
            camera: comparison.camera,
            ground_m,
            depth_m: depth_m.iter().zip(&comparison.judged).map(depth).collect(),
            feet_m: unexplained.iter().flat_map(|blob| blob.feet_m.iter().copied()).collect(),
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
                Some(&depth_m) => f64::from(depth_m) >= DEPTH_SHARE * distance_m - DEPTH_M,
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
        Sighting { camera, ground_m: 0.0, depth_m, feet_m: Vec::new(), is_excluded: vec![true] }
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
