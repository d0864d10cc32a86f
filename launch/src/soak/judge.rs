//! Checks the actions of a graph under test against the controller's inputs: pure logic.
//!
//! All checks of actions use the times that the controller wrote into them.

use crate::NS_PER_MS;
use carff_checkpoint::load_policy;
use carff_config::{Contract, GraphConfig};
use carff_decision::{Approach, Evidence, Look, Motion, Policy, Speeds};
use carff_messages::{Action, Belief, EgoMotion, Message, Reason};
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

/// Number of frames whose beliefs are remembered.
const FRAMES: usize = 64;
/// Number of motions of the vehicle that are remembered: more than the controller's deadline has.
const MOTIONS: usize = 1024;

/// Limits on the graph's actions.
#[derive(Clone, Copy, Debug)]
pub(super) struct Terms {
    pub(super) policy: Policy,
    approach: Approach,
    speeds: Speeds,
    deadline_ns: u64,
    period_ns: u64,
    slack_ns: u64,
}

impl Terms {
    pub(super) fn new(graph: &GraphConfig, checkpoint: &Path, contract: &Contract) -> anyhow::Result<Self> {
        let controller = &graph.controller;
        let policy = load_policy(controller.rule, controller.threshold, checkpoint, graph.remembers())?;
        Ok(Self {
            policy: Policy { ignores_unknown: graph.checks.ignores_unknown(), ..policy },
            approach: controller.approach,
            speeds: controller.speeds(),
            deadline_ns: controller.deadline_ms * 1_000_000,
            period_ns: (1e9 / controller.rate_hz) as u64,
            slack_ns: contract.slack_ms * 1_000_000,
        })
    }
}

/// Inputs and actions of the controller.
#[derive(Clone, Debug)]
pub(super) struct Judge {
    terms: Terms,
    /// Beliefs by capture time.
    frames: BTreeMap<u64, Vec<Belief>>,
    /// Motions of the vehicle, the oldest first.
    motions: VecDeque<EgoMotion>,
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
            motions: VecDeque::new(),
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

    pub(super) fn moved(&mut self, motion: &EgoMotion) {
        if self.motions.len() >= MOTIONS {
            self.motions.pop_front();
        }
        self.motions.push_back(*motion);
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
                return wrong(format!("no action for {:.1} ms", gap_ns as f64 / NS_PER_MS as f64));
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
                    return wrong(format!("the safe action came {:.1} ms late", late_ns as f64 / NS_PER_MS as f64));
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
        if !self.is_right(action, halts) {
            return wrong(format!("a wrong action: its beliefs require {}", if halts { "halt" } else { "advance" }));
        }
        Ok(())
    }

    /// Reports whether a decision follows from the rule's halt or advance: with a motion of the vehicle that the
    /// controller can have used, or with none.
    fn is_right(&self, action: &Action, halts: bool) -> bool {
        let Terms { approach, speeds, deadline_ns, .. } = self.terms;
        let decided_ns = action.header.capture_time_ns + action.latency_ns;
        let is_fresh = |at_ns: u64| at_ns <= decided_ns && decided_ns - at_ns <= deadline_ns;
        let fresh = self.motions.iter().filter(|motion| is_fresh(motion.header.capture_time_ns));
        let used = fresh.filter(|_| approach != Approach::Stop);
        let used = used.map(|motion| Some(Motion::from(motion)));
        used.chain([None]).any(|motion| {
            let (code, target_mps) = approach.drive(halts, Look::from(action), motion, speeds);
            (code.code(), target_mps as f32) == (action.action, action.target_speed_mps)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{ActionCode, Header, ProbeResult, Rule};

    const MS: u64 = 1_000_000;
    const SPEEDS: Speeds = Speeds { advance_mps: 5.0, creep_mps: 1.5, others_mps: 5.0 };

    fn judge() -> Judge {
        judge_of(Policy::new(Rule::Calibrated, 0.3), Approach::Stop)
    }

    fn judge_of(policy: Policy, approach: Approach) -> Judge {
        let (deadline_ns, period_ns, slack_ns) = (150 * MS, 50 * MS, 50 * MS);
        Judge::new(Terms { policy, approach, speeds: SPEEDS, deadline_ns, period_ns, slack_ns })
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
            action: code.code(),
            sample_count: 2,
            confidence: 1.0,
            hazard_probability: 0.0,
            is_decision: 1,
            valid_until_ns: (at_ms + 150) * MS,
            based_on_frame: frame_id,
            latency_ns: (at_ms - frame_id * 100) * MS,
            target_speed_mps: if code == ActionCode::Advance { 5.0 } else { 0.0 },
            ..Action::halt(header, Reason::Belief, Rule::Calibrated)
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

    /// Something unknown halts unless it is ignored.
    #[test]
    fn something_unknown_is_known() {
        for (ignores_unknown, unknown_probability, halts) in
            [(false, 0.0, false), (true, 0.9, false), (false, 0.9, true)]
        {
            let said = |code| {
                let policy = Policy { ignores_unknown, ..Policy::new(Rule::Calibrated, 0.3) };
                let mut judge = judge_of(policy, Approach::Stop);
                for step in 1..=2 {
                    judge.given(&Belief { unknown_probability, ..belief(1, step, 0.1) });
                }
                judge.next(action(1, code, 120)).is_ok()
            };
            assert_eq!([ActionCode::Advance, ActionCode::Halt].map(said), [!halts, halts]);
        }
    }

    /// A vehicle that the rule halts creeps or leaves the place only by an approach and its fresh motion, at the speed
    /// that follows from them.
    #[test]
    fn the_motion_explains_an_approach() {
        use ActionCode::{Advance, Creep, Halt};
        let said = |approach, to_conflict_m: f64, moved_ms: u64, (code, target_speed_mps)| {
            let mut judge = judge_of(Policy::new(Rule::Calibrated, 0.3), approach);
            (1..=2).for_each(|step| judge.given(&belief(1, step, 0.9)));
            let header = Header::of_frame(1, moved_ms * MS, 1);
            let through_conflict_m = to_conflict_m + 6.0;
            judge.moved(&EgoMotion {
                header,
                speed_mps: 1.0,
                to_conflict_m,
                through_conflict_m,
                ..EgoMotion::default()
            });
            judge.next(Action { target_speed_mps, ..action(1, code, 120) }).is_ok()
        };
        let (look, stop) = (Approach::Look, Approach::Stop);
        assert!(said(look, 9.0, 100, (Creep, 1.5)));
        assert!(!said(look, 9.0, 100, (Creep, 5.0)), "too fast");
        assert!(!said(look, 9.0, 100, (Advance, 5.0)), "it can still stop");
        assert!(said(look, -0.5, 100, (Advance, 5.0)), "it leaves the place");
        for (approach, moved_ms, why) in [(stop, 100, "no approach"), (look, 121, "from the future")] {
            assert!(!said(approach, -0.5, moved_ms, (Advance, 5.0)), "{why}");
            assert!(!said(approach, 9.0, moved_ms, (Creep, 1.5)), "{why}");
            assert!(said(approach, 9.0, moved_ms, (Halt, 0.0)), "{why}");
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
