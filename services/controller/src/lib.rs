//! From beliefs to actions, at any time: pure logic, without topics and without a clock of its own.
//! The decision rules themselves live in `carff-planning`.

use carff_messages::{
    Action, ActionCode, Belief, Header, MAX_HORIZON, MAX_SAMPLES, Message, ProbeResult, Reason, RuleCode,
};
use carff_planning::{Decision, Evidence, Rule, decide};

/// A sample shows the hazard from this likelihood on.
const SHOWS_HAZARD: f32 = 0.5;

/// What a controller is told at its start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The decision rule.
    pub rule: Rule,
    /// A belief older than this since capture is not acted on, and after this long without a new one the car halts.
    pub deadline_ns: u64,
    /// Time between two ticks.
    pub period_ns: u64,
    /// The run's seed, for headers.
    pub seed: u64,
}

/// What one step of a frame's belief says.
#[derive(Clone, Copy, Debug)]
struct Step {
    /// Lower bound on the probability that the hazard is met at this step: the path's times the step's.
    hazard_probability: f64,
}

/// The frame whose steps are arriving.
#[derive(Clone, Copy, Debug)]
struct Pending {
    header: Header,
    steps: [Option<Step>; MAX_HORIZON as usize],
    sample_count: usize,
    states: [Option<usize>; MAX_SAMPLES],
    shows_hazard: [bool; MAX_SAMPLES],
}

/// The action that stands.
#[derive(Clone, Copy, Debug)]
struct Standing {
    action: Action,
    decided_ns: u64,
}

/// Decides on beliefs as they come, and says at each tick what stands.
#[derive(Clone, Debug)]
pub struct Controller {
    settings: Settings,
    pending: Option<Pending>,
    standing: Option<Standing>,
    /// The newest frame that was decided on.
    decided_frame: Option<u64>,
    /// Why the last belief was not acted on, until one is.
    refused: Option<Reason>,
}

impl Controller {
    /// One that has seen nothing yet: its ticks say halt.
    pub fn new(settings: Settings) -> Self {
        Self { settings, pending: None, standing: None, decided_frame: None, refused: None }
    }

    /// Takes in a belief. Acts at once when it is the frame's last one: by the rule when all steps are there and fresh,
    /// else by halting. A belief of a frame that is decided or passed over is ignored, so none is acted on twice.
    pub fn on_belief(&mut self, belief: &Belief, now_ns: u64) -> Option<Action> {
        if belief.validate().is_err() {
            self.on_invalid();
            return None;
        }
        let frame_id = belief.header.frame_id;
        let newest = self.pending.map(|p| p.header.frame_id).max(self.decided_frame);
        if self.decided_frame == Some(frame_id) || newest.is_some_and(|newest| frame_id < newest) {
            return None;
        }
        let pending = match &mut self.pending {
            Some(pending) if pending.header.frame_id == frame_id => pending,
            slot => slot.insert(Pending {
                header: belief.header,
                steps: [None; MAX_HORIZON as usize],
                sample_count: 0,
                states: [None; MAX_SAMPLES],
                shows_hazard: [false; MAX_SAMPLES],
            }),
        };
        pending.take(belief);
        if belief.is_final == 0 {
            return None;
        }
        let pending = self.pending.take()?;
        self.decided_frame = Some(frame_id);
        let age_ns = now_ns.saturating_sub(belief.header.capture_time_ns);
        let last_step = belief.header.step as usize;
        if pending.steps[..last_step].iter().any(Option::is_none) {
            return Some(self.refuse(Reason::IncompleteBelief, now_ns));
        }
        if age_ns > self.settings.deadline_ns {
            return Some(self.refuse(Reason::StaleBelief, now_ns));
        }
        let hazard_probability =
            pending.steps[..last_step].iter().flatten().map(|s| s.hazard_probability).fold(0.0, f64::max);
        let evidence = Evidence {
            states: &pending.states[..pending.sample_count],
            shows_hazard: &pending.shows_hazard[..pending.sample_count],
            hazard_probability,
        };
        let decision = decide(self.settings.rule, &evidence);
        let action = self.act(&pending, decision, hazard_probability, now_ns);
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
        match &self.standing {
            Some(standing) if now_ns.saturating_sub(standing.decided_ns) <= self.settings.deadline_ns => {
                Action { is_decision: 0, ..standing.action }
            }
            standing => {
                let quiet = if standing.is_some() { Reason::StaleBelief } else { Reason::NoBeliefYet };
                self.safe_action(self.refused.unwrap_or(quiet), now_ns)
            }
        }
    }

    fn refuse(&mut self, reason: Reason, now_ns: u64) -> Action {
        self.refused = Some(reason);
        self.standing = None;
        self.safe_action(reason, now_ns)
    }

    fn act(&self, pending: &Pending, decision: Decision, hazard_probability: f64, now_ns: u64) -> Action {
        let code = if decision.halt { ActionCode::Halt } else { ActionCode::Advance };
        Action {
            header: pending.header.at_step(0),
            action: code.code(),
            reason: Reason::Belief.code(),
            rule: rule_code(self.settings.rule).code(),
            sample_count: pending.sample_count as u32,
            confidence: decision.confidence as f32,
            hazard_probability: hazard_probability as f32,
            is_decision: 1,
            reserved: 0,
            valid_until_ns: now_ns.saturating_add(self.settings.deadline_ns),
            based_on_frame: pending.header.frame_id,
            latency_ns: now_ns.saturating_sub(pending.header.capture_time_ns),
        }
    }

    fn safe_action(&self, reason: Reason, now_ns: u64) -> Action {
        Action {
            header: Header::of_frame(self.decided_frame.unwrap_or(0), now_ns, self.settings.seed),
            action: ActionCode::Halt.code(),
            reason: reason.code(),
            rule: rule_code(self.settings.rule).code(),
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
    fn take(&mut self, belief: &Belief) {
        let index = belief.header.step as usize - 1;
        let hazard_probability = f64::from(belief.path_probability) * f64::from(belief.hazard_probability);
        self.steps[index] = Some(Step { hazard_probability });
        let samples = belief.samples();
        if index == 0 {
            self.sample_count = samples.len();
        }
        for (i, sample) in samples.iter().enumerate().take(self.sample_count) {
            if index == 0 {
                self.states[i] = state_of(sample);
            }
            self.shows_hazard[i] |= sample.hazard_likelihood >= SHOWS_HAZARD;
        }
    }
}

fn state_of(sample: &ProbeResult) -> Option<usize> {
    usize::try_from(sample.state).ok()
}

/// The code by which messages name a rule.
pub fn rule_code(rule: Rule) -> RuleCode {
    match rule {
        Rule::Underconfident => RuleCode::Underconfident,
        Rule::Overconfident => RuleCode::Overconfident,
        Rule::Paper => RuleCode::Paper,
        Rule::Calibrated { .. } => RuleCode::Calibrated,
    }
}

#[cfg(test)]
mod tests;
