//! The speed of a vehicle on a lane, by its places in the last images.

use crate::LaneVehicle;
use std::collections::VecDeque;

/// Longest time between the first and the last place, and between two of them, seconds.
const LONGEST_S: f64 = 1.0;
const GAP_S: f64 = 0.35;
/// Smallest number of places that make a speed.
const LEAST: usize = 5;
/// Widest range of places of one image that counts, metres.
const WIDEST_M: f64 = 3.0;
/// Farthest way to the next image's place, metres, beyond that of the fastest vehicle, m/s.
const JUMP_M: f64 = 1.0;
const FASTEST_MPS: f64 = 20.0;

/// The places of one vehicle in the last images.
///
/// ```
/// use carff_unknown::{LaneVehicle, Track};
/// let mut track = Track::default();
/// let at = |at_m: f64| LaneVehicle { at_m, range_m: [at_m; 2], center_m: [-at_m, 0.0], overlap: 0.9 };
/// // A vehicle approaches at 4 m/s. Five images make a speed.
/// let speeds: Vec<_> = (0..8).map(|i| 0.1 * f64::from(i)).map(|t| track.see(t, Some(&at(12.0 - 4.0 * t)))).collect();
/// assert_eq!(speeds[3], None);
/// assert!((speeds[7].unwrap() - 4.0).abs() < 1e-9);
/// ```
#[derive(Clone, Debug, Default)]
pub struct Track {
    /// Times, seconds, and ways from the crossing, metres.
    places: VecDeque<(f64, f64)>,
}

impl Track {
    /// Adds the next vehicle of an image, and returns its least-squares speed towards the crossing over the last second,
    /// m/s; negative if it drives away. `None` until enough images show it. Another vehicle, or an image without one,
    /// begins anew.
    pub fn see(&mut self, time_s: f64, vehicle: Option<&LaneVehicle>) -> Option<f64> {
        let Some(vehicle) = vehicle.filter(|v| v.range_m[1] - v.range_m[0] <= WIDEST_M) else {
            self.places.clear();
            return None;
        };
        if let Some(&(last_s, last_m)) = self.places.back() {
            let (passed_s, moved_m) = (time_s - last_s, last_m - vehicle.at_m);
            let is_next = passed_s > 0.0 && passed_s <= GAP_S;
            if !is_next || !(-JUMP_M..=JUMP_M + FASTEST_MPS * passed_s).contains(&moved_m) {
                self.places.clear();
            }
        }
        self.places.push_back((time_s, vehicle.at_m));
        while self.places.front().is_some_and(|(at_s, _)| time_s - at_s > LONGEST_S) {
            self.places.pop_front();
        }
        self.speed_mps()
    }

    fn speed_mps(&self) -> Option<f64> {
        let n = self.places.len();
        if n < LEAST {
            return None;
        }
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| self.places.iter().map(of).sum::<f64>() / n as f64;
        let (time_s, way_m) = (mean(&|p| p.0), mean(&|p| p.1));
        let common = mean(&|p| (p.0 - time_s) * (p.1 - way_m));
        let speed_mps = -common / mean(&|p| (p.0 - time_s).powi(2));
        speed_mps.is_finite().then_some(speed_mps)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(at_m: f64) -> LaneVehicle {
        LaneVehicle { at_m, range_m: [at_m - 0.5, at_m + 0.5], center_m: [-at_m, 0.0], overlap: 0.8 }
    }

    /// Errors of places average out. A jump, a pause, a hidden vehicle, one whose place is hardly known, and a time that
    /// stands still begin anew.
    #[test]
    fn other_vehicles_begin_anew() {
        let follow = |track: &mut Track, wobble_m: f64| {
            let place = |i: u32| at(14.0 - 0.5 * f64::from(i) + if i.is_multiple_of(2) { wobble_m } else { -wobble_m });
            (0..10).map(|i| track.see(0.1 * f64::from(i), Some(&place(i)))).last().flatten()
        };
        assert!((follow(&mut Track::default(), 0.0).unwrap() - 5.0).abs() < 1e-9);
        assert!((follow(&mut Track::default(), 0.3).unwrap() - 5.0).abs() < 0.5);
        let wide = LaneVehicle { range_m: [7.0, 12.0], ..at(9.0) };
        let next = [(0.1, Some(at(40.0))), (0.9, Some(at(9.0))), (0.1, None), (0.1, Some(wide)), (0.0, Some(at(9.5)))];
        for (after_s, next) in next {
            let mut track = Track::default();
            assert!(follow(&mut track, 0.0).is_some());
            assert_eq!(track.see(0.9 + after_s, next.as_ref()), None, "{next:?}");
        }
        let mut standing = Track::default();
        let speed = (0..10).map(|i| standing.see(0.1 * f64::from(i), Some(&at(8.0)))).last().flatten();
        assert!(speed.unwrap().abs() < 1e-9);
    }
}
