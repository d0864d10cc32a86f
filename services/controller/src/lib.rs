//! The controller's logic: from beliefs to actions, without topics and without its own clock.
//!
//! `carff-decision` contains the decision rules; this crate decides when a rule is applied, and which action is valid
//! in between.

use carff_decision::{Approach, Decision, Evidence, Look, Motion, Policy, Speeds};
use carff_messages::{Action, Belief, EgoMotion, Header, ImageCheck, LookGain, MAX_HORIZON, Message, Reason};

/// Settings of a controller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The decision rule and its threshold.
    pub policy: Policy,
    /// Largest age of a belief since capture, and longest validity of a decision; the car then halts.
    pub deadline_ns: u64,
    /// Interval between two ticks.
    pub period_ns: u64,
    /// Seed of the run, for headers.
    pub seed: u64,
    /// Behaviour of the vehicle while the rule does not let it advance.
    pub approach: Approach,
    /// Speeds of the vehicle.
    pub speeds: Speeds,
}

/// Content of one step of a frame's belief. A repeated step must be equal.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Step {
    hazard_probability: f32,
    unknown_probability: f32,
    path_probability: f32,
    sample_count: u32,
    resolved_state: i32,
    is_final: u32,
}

impl Step {
    fn of(belief: &Belief) -> Self {
        Self {
            hazard_probability: belief.hazard_probability,
            unknown_probability: belief.unknown_probability,
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

/// The current action.
#[derive(Clone, Copy, Debug)]
struct Standing {
    action: Action,
    decided_ns: u64,
}

/// Decides on beliefs as they arrive, and returns the current action at each tick.
///
/// Frames are ordered by capture time: all processes share the clock, and no message can be ahead of it. So for any
/// message that has arrived, a later frame is newer.
#[derive(Clone, Debug)]
pub struct Controller {
    settings: Settings,
    pending: Option<Pending>,
    standing: Option<Standing>,
    /// Capture time and number of the newest settled frame, which was decided on or refused.
    settled: Option<(u64, u64)>,
    /// Reason why the last belief was refused, until a belief is accepted.
    refused: Option<Reason>,
    /// Capture time of the newest checked image.
    checked_ns: u64,
    /// Reason why the newest image is not usable.
    unusable: Option<Reason>,
    /// The newest motion of the vehicle, and the newest look from further on.
    motion: Option<EgoMotion>,
    look: Option<LookGain>,
}

impl Controller {
    /// Creates a controller without beliefs: its ticks return halt.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            pending: None,
            standing: None,
            settled: None,
            refused: None,
            checked_ns: 0,
            unusable: None,
            motion: None,
            look: None,
        }
    }

    /// Records the motion of the vehicle. Decisions use it while it is not older than the deadline.
    pub fn on_motion(&mut self, motion: &EgoMotion) {
        self.motion = Some(*motion);
    }

    /// Records the value of a look from further on. Only decisions on its frame use it.
    pub fn on_look(&mut self, look: &LookGain) {
        self.look = Some(*look);
    }

    /// Processes a belief. The frame's last belief causes an action at once: by the rule if all steps are present and
    /// fresh, else halt. A belief of a settled or older frame is ignored, so no frame is decided twice. A belief that
    /// contradicts its frame's other steps settles the frame with halt; a belief from the future is dropped.
    pub fn on_belief(&mut self, belief: &Belief, now_ns: u64) -> Option<Action> {
        if belief.validate().is_err() {
            self.on_invalid();
            return None;
        }
        let captured_ns = belief.header.capture_time_ns;
        if self.unusable.is_some() {
            return None;
        }
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

    /// Processes the check of an image. An image that is not usable is decided on at once, with the safe action and its
    /// condition as the reason; no belief is acted on until a newer image is usable. An older check than the newest is
    /// ignored.
    pub fn on_check(&mut self, check: &ImageCheck, now_ns: u64) -> Option<Action> {
        let captured_ns = check.header.capture_time_ns;
        let reason = check.condition().ok()?.reason();
        // Without an advancing clock of the camera, the order of arrival counts.
        if captured_ns < self.checked_ns && reason != Some(Reason::CameraClock) {
            return None;
        }
        self.checked_ns = self.checked_ns.max(captured_ns.min(now_ns));
        self.unusable = reason;
        let reason = reason?;
        (self.pending, self.standing) = (None, None);
        Some(Action {
            header: check.header.at_step(0),
            is_decision: 1,
            based_on_frame: check.header.frame_id,
            latency_ns: now_ns.saturating_sub(captured_ns),
            ..self.safe_action(reason, now_ns)
        })
    }

    /// Records that an invalid belief arrived and was dropped.
    pub fn on_invalid(&mut self) {
        self.refused = Some(Reason::InvalidBelief);
    }

    /// Returns the current action: the last decision while it is fresh, else the safe action with its reason.
    pub fn on_tick(&mut self, now_ns: u64) -> Action {
        if now_ns >= self.expires_ns() {
            self.standing = None;
        }
        if let Some(standing) = &self.standing {
            return Action { is_decision: 0, ..standing.action };
        }
        let quiet = if self.settled.is_some() { Reason::StaleBelief } else { Reason::NoBeliefYet };
        self.safe_action(self.unusable.or(self.refused).unwrap_or(quiet), now_ns)
    }

    /// Returns the last action: the safe action.
    pub fn on_stop(&self, now_ns: u64) -> Action {
        self.safe_action(Reason::Stopping, now_ns)
    }

    /// Returns the time at which the current action expires, nanoseconds: from then on a tick returns the safe action.
    /// `u64::MAX` without a current action.
    pub fn expires_ns(&self) -> u64 {
        self.standing.map_or(u64::MAX, |s| s.decided_ns.saturating_add(self.settings.deadline_ns + 1))
    }

    /// Settles a frame with halt.
    fn refuse(&mut self, header: &Header, reason: Reason, now_ns: u64) -> Action {
        self.settled = Some((header.capture_time_ns, header.frame_id));
        (self.pending, self.standing, self.refused) = (None, None, Some(reason));
        self.safe_action(reason, now_ns)
    }

    fn act(&self, pending: &Pending, decision: Decision, now_ns: u64) -> Action {
        let deadline_ns = self.settings.deadline_ns;
        let is_fresh = |motion: &&EgoMotion| now_ns.saturating_sub(motion.header.capture_time_ns) <= deadline_ns;
        let motion = self.motion.as_ref().filter(is_fresh);
        let motion = motion.map(Motion::from);
        let is_of_frame = |look: &&LookGain| look.header.capture_time_ns == pending.header.capture_time_ns;
        let look = self.look.as_ref().filter(is_of_frame).map(Look::from).unwrap_or_default();
        let Settings { approach, speeds, .. } = self.settings;
        let (code, target_mps) = approach.drive(decision.halt, look, motion, speeds);
        Action {
            header: pending.header.at_step(0),
            action: code.code(),
            reason: Reason::Belief.code(),
            rule: self.settings.policy.rule.code(),
            sample_count: pending.evidence.sample_count() as u32,
            confidence: decision.confidence as f32,
            hazard_probability: pending.evidence.hazard_probability() as f32,
            is_decision: 1,
            unknown_probability: pending.evidence.unknown_probability() as f32,
            valid_until_ns: now_ns.saturating_add(self.settings.deadline_ns),
            based_on_frame: pending.header.frame_id,
            latency_ns: now_ns.saturating_sub(pending.header.capture_time_ns),
            target_speed_mps: target_mps as f32,
            look_gain_bits: look.gain_bits as f32,
            clear_m: look.clear_m as f32,
        }
    }

    fn safe_action(&self, reason: Reason, now_ns: u64) -> Action {
        let header = Header::of_frame(self.settled.map_or(0, |(_, id)| id), now_ns, self.settings.seed);
        Action {
            valid_until_ns: now_ns.saturating_add(2 * self.settings.period_ns),
            ..Action::halt(header, reason, self.settings.policy.rule)
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

    /// Records a step. Returns false if it contradicts the frame's other messages.
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
