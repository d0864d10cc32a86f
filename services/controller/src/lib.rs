//! The controller's logic: from beliefs to actions, without topics and without a clock of its own.
//!
//! `carff-decision` holds the decision rules; this crate decides when one is applied, and what is valid in between.

use carff_decision::{Decision, Evidence, Policy};
use carff_messages::{Action, ActionCode, Belief, Header, MAX_HORIZON, Message, Reason};

/// The settings of a controller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The decision rule and its threshold.
    pub policy: Policy,
    /// A belief older than this since capture is not acted on, and after this long without a new one the car halts.
    pub deadline_ns: u64,
    /// Time between two ticks.
    pub period_ns: u64,
    /// The run's seed, for headers.
    pub seed: u64,
}

/// What one step of a frame's belief says. A step that comes twice must say the same twice.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Step {
    hazard_probability: f32,
    path_probability: f32,
    sample_count: u32,
    resolved_state: i32,
    is_final: u32,
}

impl Step {
    fn of(belief: &Belief) -> Self {
        Self {
            hazard_probability: belief.hazard_probability,
            path_probability: belief.path_probability,
            sample_count: belief.sample_count,
            resolved_state: belief.resolved_state,
            is_final: belief.is_final,
        }
    }
}

/// The frame whose steps are arriving.
#[derive(Clone, Copy, Debug)]
struct Pending {
    header: Header,
    horizon: u32,
    steps: [Option<Step>; MAX_HORIZON as usize],
    evidence: Evidence,
}

/// The action that stands.
#[derive(Clone, Copy, Debug)]
struct Standing {
    action: Action,
    decided_ns: u64,
}

/// Decides on beliefs as they come, and says at each tick what stands.
///
/// Frames are ordered by their time of capture: the clock is one for all, and no message can be ahead of it, so whatever
/// once arrived, a later frame is newer.
#[derive(Clone, Debug)]
pub struct Controller {
    settings: Settings,
    pending: Option<Pending>,
    standing: Option<Standing>,
    /// Capture time and number of the newest frame that was decided on or refused.
    settled: Option<(u64, u64)>,
    /// Why the last belief was not acted on, until one is.
    refused: Option<Reason>,
}

impl Controller {
    /// One that has seen nothing yet: its ticks say halt.
    pub fn new(settings: Settings) -> Self {
        Self { settings, pending: None, standing: None, settled: None, refused: None }
    }

    /// Takes in a belief. Acts at once when it is the frame's last one: by the rule when all steps are there and fresh,
    /// else by halting. A belief of a frame that is settled or passed over is ignored, so none is acted on twice. One
    /// that contradicts its frame's other steps settles the frame by halting; one from the future is dropped.
    pub fn on_belief(&mut self, belief: &Belief, now_ns: u64) -> Option<Action> {
        if belief.validate().is_err() {
            self.on_invalid();
            return None;
        }
        let captured_ns = belief.header.capture_time_ns;
        if captured_ns > now_ns {
            self.refused = Some(Reason::ContradictoryBelief);
            return None;
        }
        let newest_ns = self.pending.map(|p| p.header.capture_time_ns).max(self.settled.map(|(at_ns, _)| at_ns));
        let is_settled = self.settled.is_some_and(|(at_ns, _)| at_ns == captured_ns);
        if is_settled || newest_ns.is_some_and(|newest_ns| captured_ns < newest_ns) {
            return None;
        }
        let pending = match &mut self.pending {
            Some(pending) if pending.header.capture_time_ns == captured_ns => pending,
            slot => slot.insert(Pending::begin(belief)),
        };
        if !pending.take(belief) {
            return Some(self.refuse(&belief.header, Reason::ContradictoryBelief, now_ns));
        }
        if !belief.is_final() {
            return None;
        }
        let pending = self.pending.take()?;
        let age_ns = now_ns.saturating_sub(captured_ns);
        let steps = &pending.steps[..belief.header.step as usize];
        if steps.iter().any(Option::is_none) {
            return Some(self.refuse(&belief.header, Reason::IncompleteBelief, now_ns));
        }
        if age_ns > self.settings.deadline_ns {
            return Some(self.refuse(&belief.header, Reason::StaleBelief, now_ns));
        }
        let decision = self.settings.policy.decide(&pending.evidence);
        let action = self.act(&pending, decision, now_ns);
        self.settled = Some((captured_ns, belief.header.frame_id));
        self.standing = Some(Standing { action, decided_ns: now_ns });
        self.refused = None;
        Some(action)
    }

    /// Notes that a belief arrived which was not valid and was dropped.
    pub fn on_invalid(&mut self) {
        self.refused = Some(Reason::InvalidBelief);
    }

    /// What stands now: the last decision while it is fresh, else the safe action with its reason.
    pub fn on_tick(&mut self, now_ns: u64) -> Action {
        if now_ns >= self.expires_ns() {
            self.standing = None;
        }
        if let Some(standing) = &self.standing {
            return Action { is_decision: 0, ..standing.action };
        }
        let quiet = if self.settled.is_some() { Reason::StaleBelief } else { Reason::NoBeliefYet };
        self.safe_action(self.refused.unwrap_or(quiet), now_ns)
    }

    /// The last word: the safe action.
    pub fn on_stop(&self, now_ns: u64) -> Action {
        self.safe_action(Reason::Stopping, now_ns)
    }

    /// When what stands stops to stand, nanoseconds: from then on a tick says the safe action. `u64::MAX` when nothing
    /// stands.
    pub fn expires_ns(&self) -> u64 {
        self.standing.map_or(u64::MAX, |s| s.decided_ns.saturating_add(self.settings.deadline_ns + 1))
    }

    /// Settles a frame by halting.
    fn refuse(&mut self, header: &Header, reason: Reason, now_ns: u64) -> Action {
        self.settled = Some((header.capture_time_ns, header.frame_id));
        (self.pending, self.standing, self.refused) = (None, None, Some(reason));
        self.safe_action(reason, now_ns)
    }

    fn act(&self, pending: &Pending, decision: Decision, now_ns: u64) -> Action {
        let code = if decision.halt { ActionCode::Halt } else { ActionCode::Advance };
        Action {
            header: pending.header.at_step(0),
            action: code.code(),
            reason: Reason::Belief.code(),
            rule: self.settings.policy.rule.code(),
            sample_count: pending.evidence.sample_count() as u32,
            confidence: decision.confidence as f32,
            hazard_probability: pending.evidence.hazard_probability() as f32,
            is_decision: 1,
            reserved: 0,
            valid_until_ns: now_ns.saturating_add(self.settings.deadline_ns),
            based_on_frame: pending.header.frame_id,
            latency_ns: now_ns.saturating_sub(pending.header.capture_time_ns),
        }
    }

    fn safe_action(&self, reason: Reason, now_ns: u64) -> Action {
        Action {
            header: Header::of_frame(self.settled.map_or(0, |(_, id)| id), now_ns, self.settings.seed),
            action: ActionCode::Halt.code(),
            reason: reason.code(),
            rule: self.settings.policy.rule.code(),
            sample_count: 0,
            confidence: 0.0,
            hazard_probability: 1.0,
            is_decision: 0,
            reserved: 0,
            valid_until_ns: now_ns.saturating_add(2 * self.settings.period_ns),
            based_on_frame: u64::MAX,
            latency_ns: 0,
        }
    }
}

impl Pending {
    fn begin(belief: &Belief) -> Self {
        Self {
            header: belief.header,
            horizon: belief.horizon,
            steps: [None; MAX_HORIZON as usize],
            evidence: Evidence::NONE,
        }
    }

    /// Takes in a step. False when it contradicts what the frame's other messages said.
    fn take(&mut self, belief: &Belief) -> bool {
        let index = belief.header.step as usize - 1;
        let (own, step) = (&self.header, Step::of(belief));
        let same_frame = own.frame_id == belief.header.frame_id
            && own.seed == belief.header.seed
            && self.horizon == belief.horizon
            && self.steps[index].is_none_or(|there| there == step);
        if !same_frame {
            return false;
        }
        self.steps[index] = Some(step);
        self.evidence.add_belief(belief);
        true
    }
}

#[cfg(test)]
mod tests;
