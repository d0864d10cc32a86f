//! Subscribes to a graph under test and checks its actions against the controller's inputs.
//!
//! All checks of actions use the times that the controller wrote into them.

use super::answer::Answer;
use anyhow::Context;
use carff_checkpoint::load_policy;
use carff_config::Contract;
use carff_config::GraphConfig;
use carff_decision::{Approach, Evidence, Policy};
use carff_messages::{Action, ActionCode, Belief, Health, HealthState, ImageCheck, Message, Reason, Stage};
use carff_transport::{Input, Node, Receiver, Waiter, monotonic_now_ns, topics};
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

/// Number of frames whose beliefs are remembered.
const FRAMES: usize = 64;
/// Number of messages that are kept as evidence.
const EVIDENCE: usize = 400;
/// Longest sleep between two reads of the inputs, nanoseconds.
const LOOK_NS: u64 = 20_000_000;
/// A longer pause of the soak itself counts for no stage.
const STALL_NS: u64 = 100_000_000;
const NS_PER_MS: f64 = 1e6;

/// Limits on the graph's actions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Terms {
    pub(super) policy: Policy,
    approach: Approach,
    deadline_ns: u64,
    period_ns: u64,
    slack_ns: u64,
}

impl Terms {
    pub(super) fn new(graph: &GraphConfig, checkpoint: &Path, contract: &Contract) -> anyhow::Result<Self> {
        let controller = &graph.controller;
        let (rule, approach) = (controller.rule, controller.approach);
        let policy = load_policy(rule, controller.threshold, checkpoint, graph.remembers(), approach)?;
        Ok(Self {
            policy: Policy { ignores_unknown: graph.checks.ignores_unknown(), ..policy },
            approach,
            deadline_ns: controller.deadline_ms * 1_000_000,
            period_ns: (1e9 / controller.rate_hz) as u64,
            slack_ns: contract.slack_ms * 1_000_000,
        })
    }
}

/// Inputs and actions of the controller: pure logic.
#[derive(Clone, Debug)]
pub(super) struct Judge {
    terms: Terms,
    /// Beliefs by capture time.
    frames: BTreeMap<u64, Vec<Belief>>,
    /// The last decision based on a belief.
    decision: Option<Action>,
    last: Option<Action>,
    /// Times before this do not count: the controller was killed or stopped, or the machine was paused.
    excused_until_ns: u64,
    /// Number of decisions of which a belief was not received.
    pub(super) unjudged: u64,
    pub(super) judged: u64,
    pub(super) worst_safe_action_ns: u64,
    pub(super) worst_gap_ns: u64,
}

impl Judge {
    pub(super) fn new(terms: Terms) -> Self {
        Self {
            terms,
            frames: BTreeMap::new(),
            decision: None,
            last: None,
            excused_until_ns: 0,
            unjudged: 0,
            judged: 0,
            worst_safe_action_ns: 0,
            worst_gap_ns: 0,
        }
    }

    /// Excludes the time until `until_ns`.
    pub(super) fn excuse(&mut self, until_ns: u64) {
        self.excused_until_ns = self.excused_until_ns.max(until_ns);
    }

    /// Ends the excluded time at `from_ns`.
    pub(super) fn excuse_no_more(&mut self, from_ns: u64) {
        self.excused_until_ns = self.excused_until_ns.min(from_ns);
    }

    /// Records a new controller process: it remembers nothing, and neither does its judge.
    pub(super) fn restarted(&mut self, now_ns: u64) {
        (self.decision, self.last) = (None, None);
        self.excuse(now_ns);
    }

    pub(super) fn given(&mut self, belief: &Belief) {
        self.frames.entry(belief.header.capture_time_ns).or_default().push(*belief);
        while self.frames.len() > FRAMES {
            self.frames.pop_first();
        }
    }

    /// Checks an action; the error describes the violation.
    pub(super) fn acted(&mut self, action: &Action) -> Result<(), String> {
        let wrong = |what: String| Err(format!("{what}: {action:?}"));
        if let Err(error) = action.validate() {
            return wrong(format!("an action that is not valid ({error})"));
        }
        let (published_ns, excused_ns) = (action.header.publish_time_ns, self.excused_until_ns);
        // A belief that was not received proves nothing.
        if self.last.is_some_and(|last| action.header.sequence != last.header.sequence.wrapping_add(1)) {
            (self.last, self.decision) = (None, None);
        }
        if let Some(last) = self.last.replace(*action)
            && last.header.publish_time_ns >= excused_ns
        {
            let gap_ns = published_ns.saturating_sub(last.header.publish_time_ns);
            self.worst_gap_ns = self.worst_gap_ns.max(gap_ns);
            if gap_ns > self.terms.period_ns + self.terms.slack_ns {
                return wrong(format!("no action for {:.1} ms", gap_ns as f64 / NS_PER_MS));
            }
        }
        let moves = |action: &Action| action.code().is_ok_and(|code| !code.is_safe());
        if action.reason() != Ok(Reason::Belief) {
            if moves(action) {
                return wrong("it moves without a belief".to_owned());
            }
            // The safe action must follow soon after the last decision expired.
            if let Some(decision) = self.decision.take()
                && decision.valid_until_ns >= excused_ns
                && moves(&decision)
            {
                let late_ns = published_ns.saturating_sub(decision.valid_until_ns);
                self.worst_safe_action_ns = self.worst_safe_action_ns.max(late_ns);
                if late_ns > self.terms.slack_ns {
                    return wrong(format!("the safe action came {:.1} ms late", late_ns as f64 / NS_PER_MS));
                }
            }
            return Ok(());
        }
        if action.is_decision() { self.decided(action, wrong) } else { self.repeated(action, wrong) }
    }

    fn repeated(&self, action: &Action, wrong: impl Fn(String) -> Result<(), String>) -> Result<(), String> {
        match &self.decision {
            Some(decision)
                if (decision.based_on_frame, decision.action, decision.valid_until_ns)
                    != (action.based_on_frame, action.action, action.valid_until_ns) =>
            {
                wrong(format!("it repeats another decision than the last one, which was {decision:?}"))
            }
            _ => Ok(()),
        }
    }

    fn decided(&mut self, action: &Action, wrong: impl Fn(String) -> Result<(), String>) -> Result<(), String> {
        let captured_ns = action.header.capture_time_ns;
        let before = self.decision.replace(*action);
        if before.is_some_and(|before| before.header.capture_time_ns >= captured_ns) {
            return wrong("it decides twice, or out of order".to_owned());
        }
        if action.latency_ns > self.terms.deadline_ns {
            return wrong("it rests on a stale belief".to_owned());
        }
        if action.valid_until_ns > captured_ns + action.latency_ns + self.terms.deadline_ns {
            return wrong("it is valid for longer than the deadline".to_owned());
        }
        let beliefs = self.frames.get(&captured_ns).map(Vec::as_slice).unwrap_or_default();
        let step = |step: u32| beliefs.iter().find(|b| b.header.step == step);
        let Some(last) = beliefs.iter().find(|b| b.is_final()) else {
            self.unjudged += 1;
            return Ok(());
        };
        let Some(steps) = (1..=last.header.step).map(step).collect::<Option<Vec<&Belief>>>() else {
            self.unjudged += 1;
            return Ok(());
        };
        self.judged += 1;
        let mut evidence = Evidence::NONE;
        for belief in steps {
            evidence.add_belief(belief);
        }
        let halts = self.terms.policy.decide(&evidence).halt;
        // Where the rule halts, only an approach lets the vehicle creep.
        let is_right = match action.code() {
            Ok(ActionCode::Advance) => !halts,
            Ok(ActionCode::Creep) => halts && self.terms.approach != Approach::Stop,
            _ => halts,
        };
        if !is_right {
            return wrong(format!("a wrong action: its beliefs require {}", if halts { "halt" } else { "advance" }));
        }
        Ok(())
    }
}

/// Subscriptions to a running graph.
pub(super) struct Watcher {
    beliefs: Receiver<Belief>,
    checks: Receiver<ImageCheck>,
    actions: Receiver<Action>,
    healths: Vec<Receiver<Health>>,
    waiter: Waiter,
    looked_ns: u64,
    /// The latest heartbeat of each stage.
    pub(super) health: BTreeMap<Stage, Health>,
    /// Time of the latest decision based on a belief.
    pub(super) decided_ns: u64,
    /// Time in which the soak itself got no processor, nanoseconds.
    pub(super) stalled_ns: u64,
    // This field is dropped last: it closes the run.
    _node: Node,
}

/// Observations that outlive the watcher, while the graph starts and stops.
pub(super) struct Notes {
    pub(super) judge: Judge,
    /// The answer to the bad images of the current fault.
    pub(super) answer: Option<Answer>,
    /// Times from camera to decision of undisturbed frames, milliseconds.
    pub(super) latency_ms: Vec<f64>,
    /// True while frames are undisturbed.
    pub(super) calm: bool,
    /// The latest messages, as text.
    pub(super) evidence: VecDeque<String>,
    pub(super) violation: Option<String>,
}

impl Watcher {
    pub(super) fn open(node: Node, waiter: Waiter) -> anyhow::Result<Self> {
        let healths = Stage::ALL.iter().map(|&stage| node.receiver(topics::health(stage)));
        Ok(Self {
            beliefs: node.receiver(&topics::BELIEF)?,
            checks: node.receiver(&topics::CHECK)?,
            actions: node.receiver(&topics::ACTION)?,
            healths: healths.collect::<Result<_, _>>().context("cannot subscribe to the stages")?,
            waiter,
            looked_ns: monotonic_now_ns(),
            health: BTreeMap::new(),
            decided_ns: 0,
            stalled_ns: 0,
            _node: node,
        })
    }

    /// Sleeps briefly, and reads all messages.
    pub(super) fn look(&mut self, notes: &mut Notes) -> anyhow::Result<()> {
        let mut inputs: Vec<&dyn Input> = vec![&self.beliefs, &self.checks, &self.actions];
        inputs.extend(self.healths.iter().map(|h| h as &dyn Input));
        let begun_ns = monotonic_now_ns();
        self.waiter.wait_until(&inputs, begun_ns + LOOK_NS)?;
        let now_ns = monotonic_now_ns();
        let own_ns = now_ns - std::mem::replace(&mut self.looked_ns, now_ns);
        if own_ns > STALL_NS {
            self.stalled_ns += own_ns;
            notes.judge.excuse(now_ns + STALL_NS);
        }
        while let Some(belief) = self.beliefs.next()? {
            notes.judge.given(&belief);
            notes.note(format!(
                "belief frame {} step {} captured {} published {} hazard {} path {} final {}",
                belief.header.frame_id,
                belief.header.step,
                belief.header.capture_time_ns,
                belief.header.publish_time_ns,
                belief.hazard_probability,
                belief.path_probability,
                belief.is_final
            ));
        }
        for receiver in &mut self.healths {
            while let Some(health) = receiver.next()? {
                let Ok(stage) = health.stage() else { continue };
                let before = self.health.insert(stage, *health);
                if before.is_none_or(|before| before.pid != health.pid) {
                    notes.note(format!(
                        "stage {stage} is process {} from {}",
                        health.pid, health.header.publish_time_ns
                    ));
                    if stage == Stage::Controller {
                        notes.judge.restarted(now_ns + STALL_NS);
                    }
                }
            }
        }
        while let Some(check) = self.checks.next()? {
            if !check.is_usable() {
                notes.note(format!("{:?}", *check));
            }
            notes.answered(|answer| answer.checked(&check));
        }
        while let Some(action) = self.actions.next()? {
            notes.note(format!("{:?}", *action));
            notes.answered(|answer| answer.acted(&action));
            if action.is_decision() && action.reason() == Ok(Reason::Belief) {
                self.decided_ns = action.header.publish_time_ns;
                if notes.calm {
                    notes.latency_ms.push((self.decided_ns - action.header.capture_time_ns) as f64 / NS_PER_MS);
                }
            }
            if let Err(violation) = notes.judge.acted(&action) {
                notes.violation.get_or_insert(violation);
            }
        }
        Ok(())
    }

    /// Returns true if all stages are ok by heartbeats newer than `since_ns`; heartbeats of a killed process do not
    /// count.
    pub(super) fn all_well(&self, since_ns: u64, killed: Option<u32>) -> bool {
        Stage::ALL.iter().all(|stage| {
            self.health.get(stage).is_some_and(|h| {
                let well =
                    h.state().is_ok_and(|s| matches!(s, HealthState::Ok | HealthState::Slow | HealthState::Stale));
                well && h.header.publish_time_ns > since_ns && Some(h.pid) != killed
            })
        })
    }
}

impl Notes {
    pub(super) fn new(terms: Terms) -> Self {
        Self {
            judge: Judge::new(terms),
            answer: None,
            latency_ms: Vec::new(),
            calm: false,
            evidence: VecDeque::new(),
            violation: None,
        }
    }

    /// Passes a message to the awaited answer.
    fn answered(&mut self, take: impl FnOnce(&mut Answer) -> Result<(), String>) {
        if let Some(Err(violation)) = self.answer.as_mut().map(take) {
            self.violation.get_or_insert(violation);
        }
    }

    pub(super) fn note(&mut self, text: String) {
        if self.evidence.len() >= EVIDENCE {
            self.evidence.pop_front();
        }
        self.evidence.push_back(text);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Header, ProbeResult, Rule};

    const MS: u64 = 1_000_000;

    fn judge() -> Judge {
        judge_of(Policy::new(Rule::Calibrated, 0.3), Approach::Stop)
    }

    fn judge_of(policy: Policy, approach: Approach) -> Judge {
        Judge::new(Terms { policy, approach, deadline_ns: 150 * MS, period_ns: 50 * MS, slack_ns: 50 * MS })
    }

    fn belief(frame_id: u64, step: u32, hazard_probability: f32) -> Belief {
        let header = Header::of_frame(frame_id, frame_id * 100 * MS, 1).at_step(step);
        let mut belief = Belief::empty(header, 2);
        (belief.sample_count, belief.hazard_probability) = (2, hazard_probability);
        belief.samples[0] = ProbeResult { state: 1, ..ProbeResult::NONE };
        belief
    }

    fn action(frame_id: u64, code: ActionCode, at_ms: u64) -> Action {
        let mut header = Header::of_frame(frame_id, frame_id * 100 * MS, 1);
        header.publish_time_ns = at_ms * MS;
        Action {
            header,
            action: code.code(),
            reason: Reason::Belief.code(),
            rule: Rule::Calibrated.code(),
            sample_count: 2,
            confidence: 1.0,
            hazard_probability: 0.0,
            is_decision: 1,
            unknown_probability: 0.0,
            valid_until_ns: (at_ms + 150) * MS,
            based_on_frame: frame_id,
            latency_ns: (at_ms - frame_id * 100) * MS,
            target_speed_mps: 0.0,
            look_gain_bits: 0.0,
        }
    }

    impl Judge {
        /// Passes the next action in the controller's sequence.
        fn next(&mut self, mut action: Action) -> Result<(), String> {
            action.header.sequence = self.last.map_or(0, |last| last.header.sequence + 1);
            self.acted(&action)
        }
    }

    /// Returns a safe action.
    fn halt(at_ms: u64) -> Action {
        Action { reason: Reason::StaleBelief.code(), is_decision: 0, ..action(0, ActionCode::Halt, at_ms) }
    }

    /// The vehicle creeps only by an approach, and only where the rule halts. Something unknown halts unless it is ignored.
    #[test]
    fn approach_and_unknown_are_known() {
        use ActionCode::{Advance, Creep, Halt};
        let said = |approach, ignores_unknown, unknown_probability, code| {
            let mut judge = judge_of(Policy { ignores_unknown, ..Policy::new(Rule::Calibrated, 0.3) }, approach);
            for step in 1..=2 {
                judge.given(&Belief { unknown_probability, ..belief(1, step, 0.1) });
            }
            judge.next(action(1, code, 120)).is_ok()
        };
        for approach in [Approach::Stop, Approach::Look] {
            assert_eq!([Advance, Creep, Halt].map(|code| said(approach, false, 0.0, code)), [true, false, false]);
            assert_eq!([Advance, Creep, Halt].map(|code| said(approach, true, 0.9, code)), [true, false, false]);
            let creeps = approach == Approach::Look;
            assert_eq!([Advance, Creep, Halt].map(|code| said(approach, false, 0.9, code)), [false, creeps, true]);
        }
    }

    /// Decisions that follow the rule pass and are counted, repeated or not; others are violations, for both actions.
    #[test]
    fn decisions_are_held_against_the_beliefs() {
        for (hazard, code, right) in [
            (0.1, ActionCode::Advance, true),
            (0.1, ActionCode::Halt, false),
            (0.9, ActionCode::Halt, true),
            (0.9, ActionCode::Advance, false),
        ] {
            let mut judge = judge();
            judge.given(&belief(1, 1, 0.0));
            judge.given(&belief(1, 2, hazard));
            let said = judge.next(action(1, code, 120));
            assert_eq!(said.is_ok(), right, "{said:?}");
            assert_eq!(judge.judged, 1);
            let again = Action { is_decision: 0, ..action(1, code, 120) };
            assert!(judge.next(again).is_ok());
        }
        let mut judge = judge();
        judge.given(&belief(1, 2, 0.0));
        assert!(judge.next(action(1, ActionCode::Advance, 120)).is_ok(), "a belief that was not seen proves nothing");
        assert_eq!((judge.judged, judge.unjudged), (0, 1));
    }

    /// A decision that is repeated, out of order, based on a stale belief, or valid for too long is a violation. So is
    /// an advance without a belief, or a repetition of another decision.
    #[test]
    fn what_no_controller_may_do() {
        let decided = || {
            let mut judge = judge();
            judge.next(action(2, ActionCode::Advance, 210)).unwrap();
            judge
        };
        assert!(decided().next(action(2, ActionCode::Advance, 220)).unwrap_err().contains("twice"));
        assert!(decided().next(action(1, ActionCode::Advance, 230)).unwrap_err().contains("out of order"));
        let stale = Action { latency_ns: 151 * MS, ..action(3, ActionCode::Advance, 230 + 100) };
        assert!(judge().next(stale).unwrap_err().contains("stale"));
        let long = Action { valid_until_ns: 999 * MS, ..action(3, ActionCode::Advance, 310) };
        assert!(judge().next(long).unwrap_err().contains("deadline"));
        for moving in [ActionCode::Advance, ActionCode::Creep] {
            let blind = Action { action: moving.code(), ..halt(220) };
            assert!(decided().next(blind).unwrap_err().contains("without a belief"));
        }
        let other = Action { is_decision: 0, ..action(1, ActionCode::Advance, 220) };
        assert!(decided().next(other).unwrap_err().contains("repeats"));
    }

    /// The safe action must follow a decision's expiry within the slack, and actions must follow each other within
    /// period and slack; an excused time counts for neither.
    #[test]
    fn safe_actions_and_the_rate_are_timed() {
        let stands = |until: &[u64]| {
            let mut judge = judge();
            judge.next(action(2, ActionCode::Advance, 210)).unwrap();
            for &at_ms in until {
                let repeat = Action { is_decision: 0, ..action(2, ActionCode::Advance, 210) };
                let header = Header { publish_time_ns: at_ms * MS, ..repeat.header };
                judge.next(Action { header, ..repeat }).unwrap();
            }
            judge
        };
        assert!(stands(&[260, 310, 350]).next(halt(361)).is_ok());
        assert!(stands(&[260, 310, 350, 400]).next(halt(411)).unwrap_err().contains("late"));
        assert!(stands(&[260]).next(halt(361)).unwrap_err().contains("no action"));
        let mut excused = stands(&[260, 310]);
        excused.excuse(5000 * MS);
        assert!(excused.next(halt(4990)).is_ok());
        // Missed actions are not violations either.
        let mut missed = stands(&[260]);
        let mut late = halt(999);
        late.header.sequence = 77;
        assert!(missed.acted(&late).is_ok());
    }
}
