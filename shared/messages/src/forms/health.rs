//! Heartbeats.

use super::{FormError, HeaderForm, code_of, name_of};
use crate::{Health, HealthState, Message, Stage};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A stage's heartbeat.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HealthForm {
    /// Header; the frame is the last one worked on.
    pub header: HeaderForm,
    /// Which stage.
    pub stage: String,
    /// How it does.
    pub state: String,
    /// Process id.
    pub pid: u32,
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

impl From<&Health> for HealthForm {
    fn from(health: &Health) -> Self {
        Self {
            header: (&health.header).into(),
            stage: name_of!(Stage, health.stage),
            state: name_of!(HealthState, health.state),
            pid: health.pid,
            received: health.received,
            published: health.published,
            skipped: health.skipped,
            invalid: health.invalid,
            errors: health.errors,
            last_latency_ns: health.last_latency_ns,
            max_latency_ns: health.max_latency_ns,
            last_progress_ns: health.last_progress_ns,
            rss_bytes: health.rss_bytes,
        }
    }
}

impl TryFrom<&HealthForm> for Health {
    type Error = FormError;

    fn try_from(form: &HealthForm) -> Result<Self, FormError> {
        let health = Self {
            header: (&form.header).try_into()?,
            stage: code_of!(Stage, "stage", form.stage)?,
            state: code_of!(HealthState, "state", form.state)?,
            pid: form.pid,
            reserved: 0,
            received: form.received,
            published: form.published,
            skipped: form.skipped,
            invalid: form.invalid,
            errors: form.errors,
            last_latency_ns: form.last_latency_ns,
            max_latency_ns: form.max_latency_ns,
            last_progress_ns: form.last_progress_ns,
            rss_bytes: form.rss_bytes,
        };
        health.validate()?;
        Ok(health)
    }
}
