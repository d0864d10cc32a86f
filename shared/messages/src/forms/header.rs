//! The form of the header.

use super::FormError;
use crate::Header;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Common fields of all messages.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HeaderForm {
    /// Version of the message's layout.
    pub schema_version: u32,
    /// The run, as 16 hexadecimal digits.
    pub run_id: String,
    /// The camera frame that the message is based on.
    pub frame_id: u64,
    /// Horizon step: 0 for the observation, 1 for the first forecast.
    pub step: u32,
    /// Number of the message from its publisher, from 0.
    pub sequence: u64,
    /// Capture time of the frame: monotonic clock, nanoseconds.
    pub capture_time_ns: u64,
    /// Publication time of this message: monotonic clock, nanoseconds.
    pub publish_time_ns: u64,
    /// The run's random seed.
    pub seed: u64,
}

impl From<&Header> for HeaderForm {
    fn from(header: &Header) -> Self {
        Self {
            schema_version: header.schema_version,
            run_id: format!("{:016x}", header.run_id),
            frame_id: header.frame_id,
            step: header.step,
            sequence: header.sequence,
            capture_time_ns: header.capture_time_ns,
            publish_time_ns: header.publish_time_ns,
            seed: header.seed,
        }
    }
}

impl TryFrom<&HeaderForm> for Header {
    type Error = FormError;

    fn try_from(form: &HeaderForm) -> Result<Self, FormError> {
        let run_id = u64::from_str_radix(&form.run_id, 16)
            .map_err(|_| FormError::Number { field: "header.run_id", found: form.run_id.clone() })?;
        Ok(Self {
            schema_version: form.schema_version,
            step: form.step,
            run_id,
            frame_id: form.frame_id,
            sequence: form.sequence,
            capture_time_ns: form.capture_time_ns,
            publish_time_ns: form.publish_time_ns,
            seed: form.seed,
        })
    }
}
