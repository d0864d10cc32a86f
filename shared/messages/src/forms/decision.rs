//! The form of actions.

use super::{FormError, code_of, name_of};
use crate::{Action, ActionCode, Header, Message, Reason, Rule};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The vehicle's action until the next one, and its reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ActionForm {
    /// Header of the frame that it is based on.
    pub header: Header,
    /// `halt`, `creep` or `advance`.
    pub action: String,
    /// Reason of the action.
    pub reason: String,
    /// The active decision rule.
    pub rule: String,
    /// Number of samples in the belief.
    pub sample_count: u32,
    /// Confidence of the rule, 0..=1.
    pub confidence: f32,
    /// Probability of the hazard at any step of the look-ahead, 0..=1.
    pub hazard_probability: f32,
    /// True for the first action based on its frame.
    pub is_decision: bool,
    /// Probability of something that no known state explains, 0..=1; recordings before it have 0.
    #[serde(default)]
    pub unknown_probability: f32,
    /// End of its validity: monotonic clock, nanoseconds.
    pub valid_until_ns: u64,
    /// The frame that it is based on, if any.
    pub based_on_frame: Option<u64>,
    /// Time from capture to the decision, nanoseconds; 0 without a frame.
    pub latency_ns: u64,
    /// Speed to reach and hold, m/s; recordings before it have 0.
    #[serde(default)]
    pub target_speed_mps: f32,
    /// Expected drop of the uncertainty by a look from further on, bits; recordings before it have 0.
    #[serde(default)]
    pub look_gain_bits: f32,
    /// Way along the others' lane that the image shows clear, metres; recordings before it have 0.
    #[serde(default)]
    pub clear_m: f32,
}

impl From<&Action> for ActionForm {
    fn from(action: &Action) -> Self {
        Self {
            header: action.header,
            action: name_of!(ActionCode, action.action),
            reason: name_of!(Reason, action.reason),
            rule: name_of!(Rule, action.rule),
            sample_count: action.sample_count,
            confidence: action.confidence,
            hazard_probability: action.hazard_probability,
            is_decision: action.is_decision(),
            unknown_probability: action.unknown_probability,
            valid_until_ns: action.valid_until_ns,
            based_on_frame: (action.based_on_frame != u64::MAX).then_some(action.based_on_frame),
            latency_ns: action.latency_ns,
            target_speed_mps: action.target_speed_mps,
            look_gain_bits: action.look_gain_bits,
            clear_m: action.clear_m,
        }
    }
}

impl TryFrom<&ActionForm> for Action {
    type Error = FormError;

    fn try_from(form: &ActionForm) -> Result<Self, FormError> {
        let action = Self {
            header: form.header,
            action: code_of!(ActionCode, "action", form.action)?,
            reason: code_of!(Reason, "reason", form.reason)?,
            rule: code_of!(Rule, "rule", form.rule)?,
            sample_count: form.sample_count,
            confidence: form.confidence,
            hazard_probability: form.hazard_probability,
            is_decision: form.is_decision.into(),
            unknown_probability: form.unknown_probability,
            valid_until_ns: form.valid_until_ns,
            based_on_frame: form.based_on_frame.unwrap_or(u64::MAX),
            latency_ns: form.latency_ns,
            target_speed_mps: form.target_speed_mps,
            look_gain_bits: form.look_gain_bits,
            clear_m: form.clear_m,
        };
        action.validate()?;
        Ok(action)
    }
}
