//! The motion of the vehicle: its speed, and the way to the place where others drive, from another program.

use carff_messages::{Header, Invalid, ZeroCopySend, check, described, message};
use carff_transport::{Topic, topics};

/// Speed and way ahead of the vehicle, from its planner or a simulator.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("carff.EgoMotion.v1")]
pub struct EgoMotion {
    /// Header; its capture time is the time of the motion.
    pub header: Header,
    /// Speed, m/s, 0..=100.
    pub speed_mps: f64,
    /// Way until the vehicle would be in the way of others, metres, -1000..=1000; negative within and behind the place.
    pub to_conflict_m: f64,
    /// Heading, radians about +Z, world space.
    pub heading: f64,
}

/// Topic of the vehicle's motion. Approaches other than `stop` use the newest one.
pub const EGO_MOTION: Topic<EgoMotion> = Topic::new("ego/motion", topics::STATUS, 500);

impl EgoMotion {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::finite_f64("speed_mps, to_conflict_m, heading", &[self.speed_mps, self.to_conflict_m, self.heading])?;
        check::within("speed_mps", &[self.speed_mps as f32], 0.0, 100.0)?;
        check::within("to_conflict_m", &[self.to_conflict_m as f32], -1000.0, 1000.0)
    }
}

message!(EgoMotion);
described!(EgoMotion { header, speed_mps, to_conflict_m, heading });

/// The value of a look from further on, of one frame.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("carff.Look.v1")]
pub struct Look {
    /// Header of the frame.
    pub header: Header,
    /// Expected drop of the uncertainty about the hazard, bits, 0..=1.
    pub gain_bits: f32,
    /// Way to the place from where the look shows most, metres, 0..=100.
    pub ahead_m: f32,
}

/// Topic of looks from further on, from prober to controller; published with `controller.approach = "look"`.
pub const LOOK: Topic<Look> = Topic::new("prober/look", topics::MESSAGES, 500);

impl Look {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::probability("gain_bits", self.gain_bits)?;
        check::within("ahead_m", &[self.ahead_m], 0.0, 100.0)
    }
}

message!(Look);
described!(Look { header, gain_bits, ahead_m });
