//! How a vehicle approaches a place where others drive: from a rule's decision to an action with a target speed.
//!
//! A rule decides whether the place must be assumed taken. The approach decides how fast the vehicle drives on until then. It
//! never drives faster than it can stop before that place, and it leaves the place once it can no longer stop.

use carff_messages::ActionCode;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Braking that a planned stop uses, chosen by times to goal (docs/RESULTS.md), and the hardest braking, m/s².
const BRAKING_MPS2: f64 = 3.5;
const HARDEST_MPS2: f64 = 6.0;
/// Time until a vehicle brakes as planned, and as hard as it can, seconds.
const REACTION_S: f64 = 0.5;
const HARDEST_REACTION_S: f64 = 0.25;
/// Space between a stopped vehicle and the place where others drive, metres.
const SPACE_M: f64 = 0.6;
/// Distance of the first stop of [`Approach::Peek`] from that place, metres.
const STOP_LINE_M: f64 = 3.0;
/// A look that is expected to show less than this, in bits, is not worth driving on for.
const LEAST_GAIN_BITS: f64 = 0.1;
/// Acceleration of a vehicle that crosses ahead of others, m/s², and the time until it accelerates, seconds.
const CROSSING_MPS2: f64 = 2.5;
const CROSSING_REACTION_S: f64 = 0.25;
/// Time and way that it leaves to others, seconds and metres; the way holds half of its own width.
const CROSSING_MARGIN_S: f64 = 0.3;
const CROSSING_MARGIN_M: f64 = 1.5;
/// Slowest speed at which a vehicle creeps, m/s; below, it halts.
const SLOWEST_MPS: f64 = 0.05;

/// Behaviour of a vehicle while its rule does not let it advance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Approach {
    /// It halts where it is.
    #[default]
    Stop,
    /// It assumes that somebody is coming: it creeps up to the place, and waits there.
    Phantom,
    /// It stops ahead of the place, then creeps up to it, as Autoware's module for occluded intersections does.
    Peek,
    /// It crosses where the image shows the others' lane clear so far that nobody can arrive first. Else it drives on while
    /// a look from further on is expected to show more, as fast as it can still stop; else it creeps.
    Look,
}

/// Motion of the vehicle with respect to the place where others drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Way until the vehicle would be in the way of others, metres; negative within and behind the place.
    pub to_conflict_m: f64,
    /// Way until it has left that place, metres.
    pub through_conflict_m: f64,
    /// Way along the others' lane, in their direction, that its rear has then made, metres: 0 for a vehicle that crosses
    /// the lane, and above it for one that merges.
    pub along_conflict_m: f64,
}

/// The view of the others' lane in one image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Look {
    /// Expected drop of the uncertainty about the hazard by a look from further on, bits, 0..=1.
    pub gain_bits: f64,
    /// Way along the lane that the image shows clear, from the place where the vehicle crosses it, metres.
    pub clear_m: f64,
}

/// Speeds of a vehicle, m/s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Speeds {
    /// Speed of [`ActionCode::Advance`].
    pub advance_mps: f64,
    /// Highest speed of a creeping vehicle.
    pub creep_mps: f64,
    /// Highest speed of others; 0 if it is not known.
    pub others_mps: f64,
}

/// An action with its target speed, m/s.
pub type ActionAndSpeed = (ActionCode, f64);

impl Approach {
    /// Returns the action of a vehicle by its rule's decision to halt or not. Without a known motion, the vehicle halts or
    /// advances by the rule.
    ///
    /// ```
    /// use carff_decision::{Approach, Look, Motion, Speeds};
    /// use carff_messages::ActionCode;
    /// let speeds = Speeds { advance_mps: 5.0, creep_mps: 1.5, others_mps: 5.0 };
    /// let far = Some(Motion { speed_mps: 5.0, to_conflict_m: 10.0, through_conflict_m: 16.0, along_conflict_m: 0.0 });
    /// let look = Look { gain_bits: 0.8, clear_m: 9.0 };
    /// assert_eq!(Approach::Stop.drive(true, look, far, speeds), (ActionCode::Halt, 0.0));
    /// assert_eq!(Approach::Phantom.drive(true, look, far, speeds), (ActionCode::Creep, 1.5));
    /// assert_eq!(Approach::Look.drive(true, look, far, speeds), (ActionCode::Creep, 5.0));
    /// // Nobody can arrive in the time in which the vehicle leaves the lane.
    /// let clear = Look { clear_m: 21.0, ..look };
    /// assert_eq!(Approach::Look.drive(true, clear, far, speeds), (ActionCode::Advance, 5.0));
    /// ```
    pub fn drive(self, halt: bool, look: Look, motion: Option<Motion>, speeds: Speeds) -> ActionAndSpeed {
        if !halt || motion.is_some_and(Motion::is_committed) {
            return (ActionCode::Advance, speeds.advance_mps);
        }
        let Some(motion) = motion else { return (ActionCode::Halt, 0.0) };
        if self == Self::Look && motion.crosses_first(look.clear_m, speeds) {
            return (ActionCode::Advance, speeds.advance_mps);
        }
        let within = |limit_mps: f64, stop_m: f64| limit_mps.min(motion.stopping_mps(stop_m));
        let speed_mps = match self {
            Self::Stop => 0.0,
            Self::Peek if motion.to_conflict_m > STOP_LINE_M + SPACE_M => within(speeds.advance_mps, STOP_LINE_M),
            Self::Look if look.gain_bits >= LEAST_GAIN_BITS => within(speeds.advance_mps, SPACE_M),
            Self::Phantom | Self::Peek | Self::Look => within(speeds.creep_mps, SPACE_M),
        };
        if speed_mps < SLOWEST_MPS { (ActionCode::Halt, 0.0) } else { (ActionCode::Creep, speed_mps) }
    }
}

impl Motion {
    /// Reports whether the vehicle is in the way of others, or cannot stop before it is.
    fn is_committed(self) -> bool {
        let stops_within_m = self.speed_mps * HARDEST_REACTION_S + self.speed_mps.powi(2) / (2.0 * HARDEST_MPS2);
        self.to_conflict_m <= 0.0 || stops_within_m > self.to_conflict_m
    }

    /// Reports whether the vehicle has left the others' lane before anybody arrives who is not on its clear part.
    fn crosses_first(self, clear_m: f64, speeds: Speeds) -> bool {
        // The gap to those behind a vehicle that merges is smallest at the end if none of them is slower than it.
        let is_merging = self.along_conflict_m > 0.0;
        let others_mps = if is_merging { speeds.others_mps.max(speeds.advance_mps) } else { speeds.others_mps };
        let way_m = clear_m + self.along_conflict_m - CROSSING_MARGIN_M;
        let arrival_s = way_m / others_mps.max(f64::MIN_POSITIVE);
        speeds.others_mps > 0.0 && arrival_s >= self.crossing_s(speeds.advance_mps) + CROSSING_MARGIN_S
    }

    /// Time in which the vehicle leaves the place if it drives on, seconds.
    fn crossing_s(self, advance_mps: f64) -> f64 {
        let speed_mps = self.speed_mps.min(advance_mps);
        let way_m = (self.through_conflict_m - speed_mps * CROSSING_REACTION_S).max(0.0);
        let accelerating_m = (advance_mps.powi(2) - speed_mps.powi(2)) / (2.0 * CROSSING_MPS2);
        let (speeding_m, steady_m) = (way_m.min(accelerating_m), (way_m - accelerating_m).max(0.0));
        let speeding_s = ((speed_mps.powi(2) + 2.0 * CROSSING_MPS2 * speeding_m).sqrt() - speed_mps) / CROSSING_MPS2;
        CROSSING_REACTION_S + speeding_s + steady_m / advance_mps.max(f64::MIN_POSITIVE)
    }

    /// Highest speed from which the vehicle stops a distance ahead of the place.
    fn stopping_mps(self, ahead_m: f64) -> f64 {
        stopping_mps(self.to_conflict_m - ahead_m)
    }
}

/// Returns the highest speed from which a vehicle stops within a distance, m/s, with planned braking after its reaction
/// time; 0 for a negative distance.
///
/// ```
/// assert_eq!(carff_decision::stopping_mps(0.0), 0.0);
/// assert!((carff_decision::stopping_mps(5.0) - 4.4).abs() < 0.1);
/// ```
pub fn stopping_mps(distance_m: f64) -> f64 {
    let reaction_mps = BRAKING_MPS2 * REACTION_S;
    (reaction_mps.powi(2) + 2.0 * BRAKING_MPS2 * distance_m.max(0.0)).sqrt() - reaction_mps
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPEEDS: Speeds = Speeds { advance_mps: 5.0, creep_mps: 1.5, others_mps: 5.0 };

    fn at(to_conflict_m: f64, speed_mps: f64) -> Motion {
        Motion { speed_mps, to_conflict_m, through_conflict_m: to_conflict_m + 6.0, along_conflict_m: 0.0 }
    }

    fn gain(gain_bits: f64) -> Look {
        Look { gain_bits, clear_m: 0.0 }
    }

    /// No approach lets a vehicle be faster than it can stop before the place, wherever it is; at the place it halts.
    #[test]
    fn every_approach_can_stop() {
        for approach in [Approach::Stop, Approach::Phantom, Approach::Peek, Approach::Look] {
            for gain in [gain(0.0), gain(1.0)] {
                for tenths in 0..200 {
                    let to_conflict_m = f64::from(tenths) / 10.0 + 0.05;
                    let (code, speed_mps) = approach.drive(true, gain, Some(at(to_conflict_m, 0.0)), SPEEDS);
                    assert_ne!(code, ActionCode::Advance);
                    assert!(speed_mps.powi(2) / (2.0 * BRAKING_MPS2) <= to_conflict_m, "{approach:?} {to_conflict_m}");
                    assert_eq!(code == ActionCode::Halt, speed_mps == 0.0);
                }
                assert_eq!(approach.drive(true, gain, Some(at(SPACE_M, 0.0)), SPEEDS), (ActionCode::Halt, 0.0));
            }
        }
    }

    /// A vehicle that can no longer stop, or already is in the way, drives on.
    #[test]
    fn a_committed_vehicle_leaves() {
        let advance = (ActionCode::Advance, 5.0);
        assert_eq!(Approach::Look.drive(true, gain(0.0), Some(at(-1.0, 0.0)), SPEEDS), advance);
        assert_eq!(Approach::Stop.drive(true, gain(0.0), Some(at(1.0, 4.0)), SPEEDS), advance);
        assert_eq!(Approach::Stop.drive(true, gain(0.0), Some(at(3.0, 4.0)), SPEEDS).0, ActionCode::Halt);
        assert_eq!(Approach::Look.drive(false, gain(0.0), None, SPEEDS), advance);
    }

    /// Without anything to learn from further on, a vehicle that looks creeps; peeking stops first.
    #[test]
    fn approaches_differ() {
        assert_eq!(Approach::Look.drive(true, gain(0.01), Some(at(10.0, 3.0)), SPEEDS).1, SPEEDS.creep_mps);
        assert!(Approach::Peek.drive(true, gain(0.0), Some(at(STOP_LINE_M + SPACE_M + 0.1, 3.0)), SPEEDS).1 < 2.0);
        assert_eq!(Approach::Peek.drive(true, gain(0.0), Some(at(STOP_LINE_M, 0.0)), SPEEDS).1, SPEEDS.creep_mps);
        assert_eq!(Approach::Look.drive(true, gain(1.0), None, SPEEDS), (ActionCode::Halt, 0.0));
    }
}
