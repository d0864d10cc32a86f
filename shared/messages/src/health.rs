//! Heartbeats.

use crate::{Header, HealthState, Invalid, Stage, message};
use iceoryx2::prelude::ZeroCopySend;

/// A stage's heartbeat: it lives, how it does, and what it has counted since its start.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, ZeroCopySend)]
#[type_name("carff.Health.v1")]
pub struct Health {
    /// Header; the frame is the last one worked on.
    pub header: Header,
    /// Code of a [`Stage`].
    pub stage: u32,
    /// Code of a [`HealthState`].
    pub state: u32,
    /// Process id.
    pub pid: u32,
    /// Not used; 0.
    pub reserved: u32,
    /// Valid inputs received.
    pub received: u64,
    /// Outputs published.
    pub published: u64,
    /// Inputs skipped because a newer one was there.
    pub skipped: u64,
    /// Inputs dropped because they were not valid.
    pub invalid: u64,
    /// Errors of its own.
    pub errors: u64,
    /// Time that the last output took, nanoseconds.
    pub last_latency_ns: u64,
    /// Longest time that an output took, nanoseconds.
    pub max_latency_ns: u64,
    /// When its main loop last went round, or now while it waits for input: monotonic clock, nanoseconds.
    pub last_progress_ns: u64,
    /// Resident memory, bytes.
    pub rss_bytes: u64,
}

impl Health {
    /// Which stage.
    pub fn stage(&self) -> Result<Stage, Invalid> {
        Stage::try_from(self.stage)
    }

    /// How it does.
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
