//! The vehicle's pose and motion, from another program (a localisation, a planner, a simulator), and the value of a look
//! from further on.

use crate::{Header, Invalid, check, described, message};
use carff_base::geometry::is_rigid;
use iceoryx2::prelude::ZeroCopySend;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The pose of the vehicle in the world.
///
/// ```
/// use carff_messages::{EgoPose, Header, Message};
/// let world_from_vehicle = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 7.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
/// let ego = EgoPose::new(Header::of_frame(0, 1, 0), &world_from_vehicle);
/// assert_eq!(ego.validate(), Ok(()));
/// let mut vehicle_from_camera = world_from_vehicle;
/// vehicle_from_camera[2][3] = 1.5;
/// let world_from_camera = ego.world_from_camera(&vehicle_from_camera);
/// assert_eq!([world_from_camera[0][3], world_from_camera[1][3], world_from_camera[2][3]], [10.0, 14.0, 1.5]);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.EgoPose.v1")]
pub struct EgoPose {
    /// Header; its capture time is the time of the pose.
    pub header: Header,
    /// Row-major 4x4: vehicle space to world space (metres).
    pub world_from_vehicle: [f64; 16],
}

impl EgoPose {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::finite_f64("world_from_vehicle", &self.world_from_vehicle)?;
        let field = "world_from_vehicle (1: a rotation and a translation)";
        check::equals(field, is_rigid(&self.pose()).into(), 1)
    }
}

message!(EgoPose);
described!(EgoPose { header, world_from_vehicle });

/// Speed and way ahead of the vehicle.
///
/// ```
/// use carff_messages::{EgoMotion, Header, Message};
/// let header = Header::of_frame(0, 1, 0);
/// let motion = EgoMotion {
///     header,
///     speed_mps: 4.0,
///     to_conflict_m: 12.0,
///     through_conflict_m: 18.5,
///     heading_rad: 1.57,
///     crossing_m: [1.8, -4.5],
///     along_conflict_m: 0.0,
/// };
/// assert_eq!(motion.validate(), Ok(()));
/// assert!(EgoMotion { speed_mps: -1.0, ..motion }.validate().is_err());
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.EgoMotion.v3")]
pub struct EgoMotion {
    /// Header; its capture time is the time of the motion.
    pub header: Header,
    /// Speed, m/s, 0..=100.
    pub speed_mps: f64,
    /// Way until the vehicle would be in the way of others, metres, -1000..=1000; negative within and behind the place.
    pub to_conflict_m: f64,
    /// Way until the vehicle has left that place, metres, at least `to_conflict_m`.
    pub through_conflict_m: f64,
    /// Heading about +Z, world space, radians.
    pub heading_rad: f64,
    /// Centre of the vehicle, x and y, world space, metres, where it is first in the way of others.
    pub crossing_m: [f64; 2],
    /// Way along the others' lane, in their direction, that the vehicle's rear has then made when it has left the place,
    /// metres, 0..=1000: 0 for a vehicle that crosses the lane, and above it for one that merges.
    pub along_conflict_m: f64,
}

impl EgoMotion {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        let numbers = [self.speed_mps, self.to_conflict_m, self.through_conflict_m, self.heading_rad];
        check::finite_f64("speed_mps, to_conflict_m, through_conflict_m, heading_rad", &numbers)?;
        check::within("crossing_m", &self.crossing_m.map(|at_m| at_m as f32), -1e6, 1e6)?;
        check::within("along_conflict_m", &[self.along_conflict_m as f32], 0.0, 1000.0)?;
        check::within("speed_mps", &[self.speed_mps as f32], 0.0, 100.0)?;
        let ways_m = [self.to_conflict_m, self.through_conflict_m].map(|way_m| way_m as f32);
        check::within("to_conflict_m and through_conflict_m", &ways_m, -1000.0, 1000.0)?;
        let is_ahead = self.through_conflict_m >= self.to_conflict_m;
        check::equals("through_conflict_m (1: not before to_conflict_m)", is_ahead.into(), 1)
    }
}

message!(EgoMotion);
described!(EgoMotion {
    header,
    speed_mps,
    to_conflict_m,
    through_conflict_m,
    heading_rad,
    crossing_m,
    along_conflict_m
});

/// The clear part of the others' lane in one frame, the next vehicle on it, and the value of a look from further on.
///
/// ```
/// use carff_messages::{Header, LookGain, Message};
/// let header = Header::of_frame(0, 1, 0);
/// let gain = LookGain { header, gain_bits: 0.5, ahead_m: 3.0, clear_m: 12.5, ..LookGain::default() };
/// assert_eq!(gain.validate(), Ok(()));
/// assert!(LookGain { gain_bits: 1.5, ..gain }.validate().is_err());
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.LookGain.v3")]
pub struct LookGain {
    /// Header of the frame.
    pub header: Header,
    /// Expected drop of the uncertainty about the hazard, bits, 0..=1.
    pub gain_bits: f32,
    /// Way to the place from where the look shows most, metres, 0..=100.
    pub ahead_m: f32,
    /// Way along the others' lane that the frame shows clear, from the place where the vehicle crosses it, metres,
    /// 0..=1000; 0 if it was not compared.
    pub clear_m: f32,
    /// Number of vehicles that the frame shows on that lane.
    #[serde(default)]
    pub vehicles: u32,
    /// Centre of the one next to the crossing, x and y, world space, metres; 0 without one.
    #[serde(default)]
    pub vehicle_m: [f32; 2],
    /// Half of the range of its place along the lane that the frame allows, metres; a part of it may be hidden.
    #[serde(default)]
    pub vehicle_within_m: f32,
    /// Heading of that vehicle about +Z, radians: that of the lane.
    #[serde(default)]
    pub vehicle_heading_rad: f32,
    /// Its speed along the lane by its places in the last second, m/s, -100..=100; 0 if it is not known.
    #[serde(default)]
    pub vehicle_mps: f32,
    /// 1 if its speed is known, else 0.
    #[serde(default)]
    pub has_vehicle_mps: u32,
}

impl LookGain {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::probability("gain_bits", self.gain_bits)?;
        check::within("ahead_m", &[self.ahead_m], 0.0, 100.0)?;
        check::within("clear_m", &[self.clear_m], 0.0, 1000.0)?;
        check::within("vehicle_m", &self.vehicle_m, -1e6, 1e6)?;
        check::within("vehicle_within_m", &[self.vehicle_within_m], 0.0, 1000.0)?;
        check::within("vehicle_heading_rad", &[self.vehicle_heading_rad], -10.0, 10.0)?;
        check::within("vehicle_mps", &[self.vehicle_mps], -100.0, 100.0)?;
        check::at_most("has_vehicle_mps", self.has_vehicle_mps.into(), 1)
    }
}

message!(LookGain);
described!(LookGain {
    header,
    gain_bits,
    ahead_m,
    clear_m,
    vehicles,
    vehicle_m,
    vehicle_within_m,
    vehicle_heading_rad,
    vehicle_mps,
    has_vehicle_mps
});

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Message;

    /// A camera one metre ahead of a vehicle that has turned left by a right angle and moved is where both together
    /// place it. A pose that is not a rigid motion is not valid.
    #[test]
    fn poses_are_composed() {
        let mut ego = EgoPose { header: Header::of_frame(0, 1, 0), ..EgoPose::default() };
        assert!(ego.validate().is_err());
        ego.world_from_vehicle = [0.0, -1.0, 0.0, 5.0, 1.0, 0.0, 0.0, 7.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(ego.validate(), Ok(()));
        let ahead = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.5], [0.0, 0.0, 0.0, 1.0]];
        let pose = ego.world_from_camera(&ahead);
        assert_eq!([pose[0][3], pose[1][3], pose[2][3]], [5.0, 8.0, 1.5]);
        assert_eq!([pose[0][0], pose[1][0]], [0.0, 1.0]);
        ego.world_from_vehicle[0] = f64::NAN;
        assert!(ego.validate().is_err());
    }
}
