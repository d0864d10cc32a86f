//! The messages that cross process boundaries, and their validation; nothing that sends or receives lives here.
//!
//! Each message is `#[repr(C)]`, `Copy` and made of plain numbers, so that any bit pattern is a value of the type.
//! What has few meanings (a state, an action) travels as a number and becomes an enum by a checked conversion.
//! [`Message::validate`] is called on arrival and never panics, whatever the bytes are.
//!
//! ```
//! use carff_messages::{Gaussian, Header, Message, Posterior};
//! let header = Header::of_frame(7, 1_000, 42);
//! let mut posterior = Posterior { header, gaussian: Gaussian::standard(), stage_latency_ns: 0 };
//! assert!(posterior.validate().is_ok());
//! posterior.gaussian.mean[3] = f32::NAN;
//! assert!(posterior.validate().unwrap_err().to_string().contains("gaussian.mean"));
//! ```
//!
//! Stages of other crates have messages of their own: see [`message!`].

pub mod check;
mod codes;
mod convert;
mod decision;
pub mod forms;
mod frame;
mod health;
mod latent;

pub use check::Invalid;
pub use codes::{ActionCode, ForecastSource, HealthState, Observability, Reason, Rule, Stage, ViewKind};
pub use convert::row_major;
pub use decision::Action;
pub use frame::{DatasetView, FrameMeta, Intrinsics, ViewMeta};
pub use health::Health;
pub use latent::{Belief, Forecast, Gaussian, Posterior, ProbeResult};

/// Says that a type may lie in shared memory, and under which name. Derive it with `#[repr(C)]` and `#[type_name(..)]`.
pub use iceoryx2::prelude::ZeroCopySend;

use check::{at_most, equals};
use std::fmt::Debug;

/// Version of all layouts in this crate. A process drops what carries another one.
pub const SCHEMA_VERSION: u32 = 2;
/// Dimensions of the scene latent.
pub const LATENT_DIM: usize = 8;
/// Most components that a mixture can have.
pub const MAX_COMPONENTS: usize = 4;
/// Most latents drawn from a mixture.
pub const MAX_SAMPLES: usize = 64;
/// Most states (branch, timestamp) that a scenario can have.
pub const MAX_STATES: usize = 64;
/// Most boxes that are probed for density.
pub const MAX_PLACES: usize = 48;
/// Most steps that a forecast looks ahead.
pub const MAX_HORIZON: u32 = 8;
/// Largest width or height of an image, pixels.
pub const MAX_SIDE_PX: u32 = 4096;
/// Most bytes that an image on a topic can have (RGB, 8 bit).
pub const MAX_IMAGE_BYTES: usize = 1 << 24;

/// What every message carries: enough to follow one frame through every stage.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("carff.Header.v1")]
pub struct Header {
    /// [`SCHEMA_VERSION`] of the sender. Set on send.
    pub schema_version: u32,
    /// Horizon step: 0 for what was observed, 1 for the first forecast.
    pub step: u32,
    /// The run that it belongs to. Set on send.
    pub run_id: u64,
    /// The camera frame that it rests on, counted from 0 in a run.
    pub frame_id: u64,
    /// Counts the messages of one publisher from 0. Set on send.
    pub sequence: u64,
    /// When the camera took the frame: monotonic clock, nanoseconds.
    pub capture_time_ns: u64,
    /// When this message was published: monotonic clock, nanoseconds. Set on send.
    pub publish_time_ns: u64,
    /// The run's random seed.
    pub seed: u64,
}

impl Header {
    /// The header of a frame, at step 0. Sending fills in what it leaves at 0.
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

    /// The same frame's header at another step.
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
    /// The header.
    fn header(&self) -> &Header;
    /// The header, to be stamped on send.
    fn header_mut(&mut self) -> &mut Header;
    /// Checks all fields: finite, in range, known codes, schema version. Never panics.
    fn validate(&self) -> Result<(), Invalid>;
}

/// A message that describes the image it comes with. Its default is not valid: a loan holds it until the real one is
/// written.
pub trait ImageMeta: Message + Default {
    /// Width and height of the image, pixels.
    fn size_px(&self) -> [u32; 2];

    /// Bytes of the image, RGB, 8 bit. Only meaningful once [`Message::validate`] has passed.
    fn image_bytes(&self) -> usize {
        self.size_px().iter().map(|&side| side as usize).product::<usize>() * 3
    }
}

/// Makes a type a [`Message`]: it has a field `header: Header`, and a method `check(&self) -> Result<(), Invalid>`. Of a
/// type, `#[type_name]` says name and version: processes that disagree about its layout must disagree about it too.
///
/// ```
/// use carff_messages::{Header, Invalid, Message, ZeroCopySend, check, message};
///
/// /// How fast the car may go.
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
