//! Heartbeats of stages.

use crate::{Header, HealthState, Invalid, Stage, fields, message};
use iceoryx2::prelude::ZeroCopySend;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A stage's heartbeat: its state and its counts since its start.
///
/// ```
/// use carff_messages::{Header, Health, HealthState, Message, Stage};
/// let health = Health {
///     header: Header::of_frame(7, 1_000, 42),
///     stage: Stage::Prober.code(),
///     state: HealthState::Ok.code(),
///     pid: 4711,
///     received: 20,
///     published: 19,
///     skipped: 1,
///     invalid: 0,
///     errors: 0,
///     last_latency_ns: 1_200_000,
///     max_latency_ns: 2_500_000,
///     last_progress_ns: 90_000_000,
///     rss_bytes: 30 << 20,
/// };
/// assert_eq!((health.validate(), health.stage()), (Ok(()), Ok(Stage::Prober)));
/// assert!(Health { state: 99, ..health }.validate().is_err());
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.Health.v1")]
pub struct Health {
    /// Header; its frame is the last processed frame.
    pub header: Header,
    /// Code of a [`Stage`]; in JSON, its name.
    #[serde(with = "fields::stage")]
    #[schemars(with = "String")]
    pub stage: u32,
    /// Code of a [`HealthState`]; in JSON, its name.
    #[serde(with = "fields::state")]
    #[schemars(with = "String")]
    pub state: u32,
    /// Process id.
    pub pid: u32,
    /// Number of valid inputs received.
    pub received: u64,
    /// Number of outputs published.
    pub published: u64,
    /// Number of inputs skipped in favour of newer ones.
    pub skipped: u64,
    /// Number of inputs dropped because they were invalid.
    pub invalid: u64,
    /// Number of the stage's own errors.
    pub errors: u64,
    /// Duration of the last output, nanoseconds.
    pub last_latency_ns: u64,
    /// Longest duration of an output, nanoseconds.
    pub max_latency_ns: u64,
    /// Last round of the main loop, or the current time while it waits for input: monotonic clock, nanoseconds.
    pub last_progress_ns: u64,
    /// Resident memory, bytes.
    pub rss_bytes: u64,
}

impl Health {
    /// Returns the stage.
    pub fn stage(&self) -> Result<Stage, Invalid> {
        Stage::try_from(self.stage)
    }

    /// Returns the state of the stage.
    pub fn state(&self) -> Result<HealthState, Invalid> {
        HealthState::try_from(self.state)
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        Stage::try_from(self.stage)?;
        HealthState::try_from(self.state)?;
        Ok(())
    }
}

message!(Health);
