//! An example of a stage outside the shipped graph. It computes a speed limit from the controller's action and from the
//! share of the scene that is known. It uses public crates only and joins any running graph. The book's chapter "Write
//! a stage" explains it.

use carff_messages::{Action, ActionCode, Belief, Header, Invalid, ZeroCopySend, check, message};
use carff_transport::{Topic, topics};

/// The limit for a known scene and the action to advance, metres per second.
pub const FREE_M_S: f32 = 8.0;

/// A speed limit, published for each action.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("speed-gate.SpeedLimit.v1")]
pub struct SpeedLimit {
    /// Header of the action's frame.
    pub header: Header,
    /// Speed limit, metres per second, 0 to [`FREE_M_S`].
    pub limit_m_s: f32,
    /// Probability of all known states together, 0 to 1; the rest is the probability of an unknown scene.
    pub known: f32,
}

/// Topic of the speed limits.
pub const SPEED_LIMIT: Topic<SpeedLimit> = Topic::new("speed-gate/limit", topics::MESSAGES, 500);

impl SpeedLimit {
    /// Returns 0 while the action is to halt, and otherwise a limit in proportion to the known probability.
    pub fn of(action: &Action, belief: Option<&Belief>) -> Self {
        let states = |b: &Belief| b.state_probability.iter().take(b.state_count as usize).sum::<f32>();
        let known = belief.map_or(0.0, states).clamp(0.0, 1.0);
        let advance = action.code() == Ok(ActionCode::Advance);
        Self { header: action.header, limit_m_s: if advance { FREE_M_S * known } else { 0.0 }, known }
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::within("limit_m_s", [&self.limit_m_s], 0.0, FREE_M_S)?;
        check::probability("known", self.known)
    }
}

message!(SpeedLimit);

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Message, Reason, Rule};

    fn action(code: ActionCode) -> Action {
        Action {
            action: code.code(),
            is_decision: 1,
            based_on_frame: 7,
            ..Action::halt(Header::of_frame(7, 1_000, 42), Reason::Belief, Rule::Calibrated)
        }
    }

    fn belief(states: [f32; 2]) -> Belief {
        let mut belief = Belief::empty(Header::of_frame(7, 1_000, 42).at_step(1), 1);
        belief.state_count = 2;
        belief.state_probability[..2].copy_from_slice(&states);
        belief
    }

    /// The limit is 0 on halt, proportional to the known probability on advance, and 0 without a belief.
    #[test]
    fn limits() {
        let limit = |code, belief: Option<Belief>| SpeedLimit::of(&action(code), belief.as_ref()).limit_m_s;
        assert_eq!(limit(ActionCode::Halt, Some(belief([0.5, 0.5]))), 0.0);
        assert_eq!(limit(ActionCode::Advance, Some(belief([0.5, 0.5]))), FREE_M_S);
        assert_eq!(limit(ActionCode::Advance, Some(belief([0.25, 0.25]))), FREE_M_S / 2.0);
        assert_eq!(limit(ActionCode::Advance, None), 0.0);
    }

    /// A limit is valid and keeps its frame; a limit out of range or not finite is refused.
    #[test]
    fn validation() {
        let limit = SpeedLimit::of(&action(ActionCode::Advance), Some(&belief([1.0, 0.0])));
        assert_eq!((limit.validate(), limit.header.frame_id), (Ok(()), 7));
        for wrong in [-1.0, f32::NAN, FREE_M_S * 2.0] {
            assert!(SpeedLimit { limit_m_s: wrong, ..limit }.validate().is_err(), "{wrong}");
        }
    }
}
