//! The form of heartbeats.

use super::{FormError, HeaderForm, code_of, name_of};
use crate::{Health, HealthState, Message, Stage};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A stage's heartbeat.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HealthForm {
    /// Header; its frame is the last processed frame.
    pub header: HeaderForm,
    /// Name of the stage.
    pub stage: String,
    /// State of the stage.
    pub state: String,
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
