//! The controller's action.

use crate::check::{at_most, probability, within};
use crate::{ActionCode, Header, Invalid, MAX_SAMPLES, Reason, Rule, message};
use iceoryx2::prelude::ZeroCopySend;

/// Largest target speed of an action, m/s.
const MAX_SPEED_MPS: f32 = 100.0;

/// The vehicle's action until the next one, and its reason.
///
/// ```
/// use carff_messages::{Action, ActionCode, Header, Message, Reason, Rule};
/// let action = Action {
///     header: Header::of_frame(7, 1_000, 42),
///     action: ActionCode::Halt.code(),
///     reason: Reason::Belief.code(),
///     rule: Rule::Calibrated.code(),
///     sample_count: 10,
///     confidence: 0.9,
///     hazard_probability: 0.9,
///     is_decision: 1,
///     unknown_probability: 0.0,
///     valid_until_ns: 100_001_000,
///     based_on_frame: 7,
///     latency_ns: 20_000,
///     target_speed_mps: 0.0,
///     look_gain_bits: 0.0,
///     clear_m: 0.0,
/// };
/// assert!(action.validate().is_ok() && action.is_decision());
/// assert_eq!(action.code(), Ok(ActionCode::Halt));
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("carff.Action.v4")]
pub struct Action {
    /// Header of the frame that it is based on.
    pub header: Header,
    /// Code of an [`ActionCode`].
    pub action: u32,
    /// Code of a [`Reason`].
    pub reason: u32,
    /// Code of a [`Rule`].
    pub rule: u32,
    /// Number of samples in the belief.
    pub sample_count: u32,
    /// Confidence of the rule, 0..=1.
    pub confidence: f32,
    /// Probability of the hazard at any step of the look-ahead, 0..=1.
    pub hazard_probability: f32,
    /// 1 for the first action based on its frame; 0 for a repetition or the safe action.
    pub is_decision: u32,
    /// Probability that something is there which no known state explains, 0..=1; 0 if the image was not compared.
    pub unknown_probability: f32,
    /// End of its validity: monotonic clock, nanoseconds.
    pub valid_until_ns: u64,
    /// The frame that it is based on; `u64::MAX` for none.
    pub based_on_frame: u64,
    /// Time from capture to the decision, nanoseconds; 0 without a frame.
    pub latency_ns: u64,
    /// Speed to reach and hold until [`Self::valid_until_ns`], m/s, 0..=100; 0 for [`ActionCode::Halt`].
    pub target_speed_mps: f32,
    /// Expected drop of the uncertainty about the hazard by a look from further on, bits, 0..=1; 0 if not computed.
    pub look_gain_bits: f32,
    /// Way along the others' lane that the image shows clear, metres, 0..=1000; 0 if not computed.
    pub clear_m: f32,
}

impl Action {
    /// Returns the safe action of a rule, for a reason: to halt, without a frame that it is based on and without samples,
    /// with the hazard taken for certain. It has no time of validity yet.
    ///
    /// ```
    /// use carff_messages::{Action, ActionCode, Header, Message, Reason, Rule};
    /// let action = Action::halt(Header::of_frame(7, 1_000, 42), Reason::StaleBelief, Rule::Calibrated);
    /// assert!(action.validate().is_ok() && !action.is_decision());
    /// assert_eq!((action.code(), action.hazard_probability), (Ok(ActionCode::Halt), 1.0));
    /// ```
    pub fn halt(header: Header, reason: Reason, rule: Rule) -> Self {
        Self {
            header,
            action: ActionCode::Halt.code(),
            reason: reason.code(),
            rule: rule.code(),
            sample_count: 0,
            confidence: 0.0,
            hazard_probability: 1.0,
            is_decision: 0,
            unknown_probability: 0.0,
            valid_until_ns: 0,
            based_on_frame: u64::MAX,
            latency_ns: 0,
            target_speed_mps: 0.0,
            look_gain_bits: 0.0,
            clear_m: 0.0,
        }
    }

    /// Returns the action of the vehicle.
    pub fn code(&self) -> Result<ActionCode, Invalid> {
        ActionCode::try_from(self.action)
    }

    /// Returns the reason of the action.
    pub fn reason(&self) -> Result<Reason, Invalid> {
        Reason::try_from(self.reason)
    }

    /// Reports whether this is the first action that rests on its frame.
    pub fn is_decision(&self) -> bool {
        self.is_decision == 1
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        ActionCode::try_from(self.action)?;
        Reason::try_from(self.reason)?;
        Rule::try_from(self.rule)?;
        at_most("sample_count", self.sample_count.into(), MAX_SAMPLES as u64)?;
        at_most("is_decision", self.is_decision.into(), 1)?;
        probability("confidence", self.confidence)?;
        probability("unknown_probability", self.unknown_probability)?;
        probability("look_gain_bits", self.look_gain_bits)?;
        within("clear_m", [&self.clear_m], 0.0, 1000.0)?;
        let limit = if self.action == ActionCode::Halt.code() { 0.0 } else { MAX_SPEED_MPS };
        within("target_speed_mps", [&self.target_speed_mps], 0.0, limit)?;
        probability("hazard_probability", self.hazard_probability)
    }
}

message!(Action);
