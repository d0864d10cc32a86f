//! The messages that cross process boundaries, and their validation. This crate does not send or receive.
//!
//! Each message is `#[repr(C)]`, `Copy` and made of plain numbers, so that any bit pattern is a value of the type.
//! A field with few meanings (a state, an action) is sent as a number and becomes an enum by a checked conversion.
//! Receivers call [`Message::validate`] on arrival; it never panics, for any bytes.
//!
//! ```
//! use carff_messages::{Gaussian, Header, Message, Posterior};
//! let header = Header::of_frame(7, 1_000, 42);
//! let mut posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 };
//! assert!(posterior.validate().is_ok());
//! posterior.gaussian.mean[3] = f32::NAN;
//! assert!(posterior.validate().unwrap_err().to_string().contains("gaussian.mean"));
//! ```
//!
//! Stages of other crates define their own messages: see [`message!`].

pub mod check;
mod codes;
mod convert;
mod decision;
mod fields;
pub mod forms;
mod frame;
mod health;
mod latent;
pub mod layout;
mod motion;
mod novelty;
mod occupancy;

pub use check::Invalid;
pub use codes::{
    ActionCode, ForecastSource, HealthState, ImageCondition, Observability, Reason, Rule, Stage, ViewKind,
};
pub use convert::row_major;
pub use decision::Action;
pub use frame::{DatasetView, FrameMeta, Intrinsics, ViewMeta};
pub use health::Health;
pub use latent::{Belief, Forecast, Gaussian, Posterior, ProbeResult};
pub use motion::{EgoMotion, EgoPose, LookGain};
pub use novelty::{ImageCheck, MAX_UNKNOWNS, UnknownBox, Unknowns};
pub use occupancy::{MAX_CELLS, Occupancy};

/// Marks a type as suitable for shared memory, with a name. Derive it with `#[repr(C)]` and `#[type_name(..)]`.
pub use iceoryx2::prelude::ZeroCopySend;

use check::{at_most, equals};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt::Debug;

/// Version of all layouts in this crate. A process drops messages of another version.
pub const SCHEMA_VERSION: u32 = 4;
/// Maximum absolute value of a latent in a valid message. The prior has deviation 1; larger values would overflow in the
/// networks, and end the stage that sends their result.
pub const MAX_ABS_LATENT: f32 = 1e4;
/// Dimensions of the scene latent.
pub const LATENT_DIM: usize = 8;
/// Maximum number of components of a mixture.
pub const MAX_COMPONENTS: usize = 8;
/// Maximum number of latents drawn from a mixture.
pub const MAX_SAMPLES: usize = 64;
/// Maximum number of states (branch, time step) of a scenario.
pub const MAX_STATES: usize = 64;
/// Maximum number of probed boxes.
pub const MAX_PLACES: usize = 48;
/// Maximum number of steps of a forecast.
pub const MAX_HORIZON: u32 = 8;
/// Maximum width or height of an image, pixels.
pub const MAX_SIDE_PX: u32 = 4096;
/// Maximum number of bytes of an image on a topic (RGB, 8 bit).
pub const MAX_IMAGE_BYTES: usize = 1 << 24;

/// Common fields of all messages: enough to follow one frame through every stage.
///
/// ```
/// use carff_messages::Header;
/// let observed = Header::of_frame(7, 1_000, 42);
/// let forecast = observed.at_step(2);
/// assert_eq!((forecast.frame_id, forecast.step), (7, 2));
/// assert!(observed.at_step(9).validate().unwrap_err().to_string().contains("header.step"));
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.Header.v1")]
pub struct Header {
    /// Version of the message's layout, [`SCHEMA_VERSION`]. Set on send.
    pub schema_version: u32,
    /// Horizon step: 0 for the observation, 1 for the first forecast.
    pub step: u32,
    /// The run of the message; in JSON, 16 hexadecimal digits. Set on send.
    #[serde(with = "fields::hex")]
    #[schemars(with = "String")]
    pub run_id: u64,
    /// The camera frame that the message is based on, counted from 0 in a run.
    pub frame_id: u64,
    /// Number of the message from its publisher, from 0. Set on send.
    pub sequence: u64,
    /// Capture time of the frame: monotonic clock, nanoseconds.
    pub capture_time_ns: u64,
    /// Publication time of this message: monotonic clock, nanoseconds. Set on send.
    pub publish_time_ns: u64,
    /// The run's random seed.
    pub seed: u64,
}

impl Header {
    /// Returns the header of a frame at step 0. Sending fills in the fields that are 0.
    pub fn of_frame(frame_id: u64, capture_time_ns: u64, seed: u64) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            step: 0,
            run_id: 0,
            frame_id,
            sequence: 0,
            capture_time_ns,
            publish_time_ns: 0,
            seed,
        }
    }

    /// Returns the header of the same frame at another step.
    #[must_use]
    pub fn at_step(self, step: u32) -> Self {
        Self { step, ..self }
    }

    /// Checks the schema version and the step.
    pub fn validate(&self) -> Result<(), Invalid> {
        equals("header.schema_version", u64::from(self.schema_version), u64::from(SCHEMA_VERSION))?;
        at_most("header.step", u64::from(self.step), u64::from(MAX_HORIZON))
    }
}

/// A message as the transport handles it.
pub trait Message: ZeroCopySend + Debug + Copy + Send + Sync + 'static {
    /// Returns the header.
    fn header(&self) -> &Header;
    /// Returns the header, to be stamped on send.
    fn header_mut(&mut self) -> &mut Header;
    /// Checks all fields: finite, in range, known codes, schema version. Never panics.
    fn validate(&self) -> Result<(), Invalid>;
}

/// A message that describes an image. Its default is not valid: a loan contains it until the real one is written.
pub trait ImageMeta: Message + Default {
    /// Returns width and height of the image, pixels.
    fn size_px(&self) -> [u32; 2];

    /// Returns the number of bytes of the image, RGB, 8 bit. Only meaningful after [`Message::validate`] has passed.
    fn image_bytes(&self) -> usize {
        let [width_px, height_px] = self.size_px();
        rgb_bytes(width_px, height_px)
    }
}

/// Returns the bytes of an RGB image of 8 bit a channel.
pub const fn rgb_bytes(width_px: u32, height_px: u32) -> usize {
    width_px as usize * height_px as usize * 3
}

/// Implements [`Message`] for a type with a field `header: Header` and a method `check(&self) -> Result<(), Invalid>`.
/// Change the version in `#[type_name]` whenever the layout changes: processes with different layouts then refuse each
/// other's topics.
///
/// ```
/// use carff_messages::{Header, Invalid, Message, ZeroCopySend, check, message};
///
/// /// Speed limit of the car.
/// #[repr(C)]
/// #[derive(Clone, Copy, Debug, ZeroCopySend)]
/// #[type_name("example.SpeedLimit.v1")]
/// struct SpeedLimit {
///     header: Header,
///     limit_m_s: f64,
/// }
///
/// impl SpeedLimit {
///     fn check(&self) -> Result<(), Invalid> {
///         self.header.validate()?;
///         check::finite_f64("limit_m_s", [&self.limit_m_s])
///     }
/// }
///
/// message!(SpeedLimit);
///
/// let limit = SpeedLimit { header: Header::of_frame(7, 1_000, 42), limit_m_s: f64::NAN };
/// assert!(limit.validate().unwrap_err().to_string().contains("limit_m_s"));
/// ```
#[macro_export]
macro_rules! message {
    ($type:ty) => {
        impl $crate::Message for $type {
            fn header(&self) -> &$crate::Header {
                &self.header
            }
            fn header_mut(&mut self) -> &mut $crate::Header {
                &mut self.header
            }
            fn validate(&self) -> Result<(), $crate::Invalid> {
                self.check()
            }
        }
    };
}

#[cfg(test)]
mod tests;
