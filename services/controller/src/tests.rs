use super::*;
use carff_messages::{ActionCode, ImageCheck, ImageCondition, ProbeResult, Rule};

const MS: u64 = 1_000_000;
const HORIZON: u32 = 2;

fn controller(rule: Rule) -> Controller {
    let policy = Policy::new(rule, 0.3);
    Controller::new(settings(policy))
}

fn settings(policy: Policy) -> Settings {
    let (deadline_ns, period_ns) = (150 * MS, 50 * MS);
    let speeds = Speeds { advance_mps: 5.0, creep_mps: 1.5, others_mps: 5.0 };
    Settings { policy, deadline_ns, period_ns, seed: 1, approach: Approach::Stop, speeds }
}

fn calibrated() -> Controller {
    controller(Rule::Calibrated)
}

/// Returns a belief of ten samples, of which `hazardous` show the hazard, for a frame captured at `frame_id` x 100 ms.
fn belief(frame_id: u64, step: u32, hazard_probability: f32, hazardous: usize) -> Belief {
    let header = Header::of_frame(frame_id, frame_id * 100 * MS, 1).at_step(step);
    let mut belief = Belief::empty(header, HORIZON);
    belief.state_count = 6;
    belief.place_count = 1;
    belief.component_count = 1;
    belief.component_weights[0] = 1.0;
    belief.sample_count = 10;
    belief.hazard_probability = hazard_probability;
    for (i, sample) in belief.samples.iter_mut().enumerate().take(10) {
        let likelihood = if i < hazardous { 1.0 } else { 0.0 };
        *sample = ProbeResult { state: 1, confidence: 1.0, hazard_likelihood: likelihood, ..ProbeResult::NONE };
    }
    belief
}

fn told(action: &Action) -> (ActionCode, Reason) {
    (action.code().unwrap(), action.reason().unwrap())
}

/// Before any message, each tick returns halt with its reason.
#[test]
fn quiet_from_the_start_is_halt() {
    let mut controller = calibrated();
    for tick in 0..10 {
        let action = controller.on_tick(tick * 50 * MS);
        action.validate().unwrap();
        assert_eq!(told(&action), (ActionCode::Halt, Reason::NoBeliefYet));
        assert_eq!(action.based_on_frame, u64::MAX);
    }
}

/// Nothing is decided before the last step; then at once, by the largest hazard of all steps, weighted by the path.
#[test]
fn decides_on_all_steps_of_a_frame() {
    let mut controller = calibrated();
    assert!(controller.on_belief(&belief(3, 1, 0.05, 0), 310 * MS).is_none());
    let mut last = belief(3, 2, 0.9, 0);
    last.path_probability = 0.2;
    let action = controller.on_belief(&last, 330 * MS).unwrap();
    action.validate().unwrap();
    assert_eq!(told(&action), (ActionCode::Advance, Reason::Belief), "0.9 x 0.2 is below 0.3");
    assert!((action.hazard_probability - 0.18).abs() < 1e-6);
    assert_eq!((action.based_on_frame, action.latency_ns, action.is_decision), (3, 30 * MS, 1));

    assert!(controller.on_belief(&belief(4, 1, 0.4, 4), 410 * MS).is_none());
    let action = controller.on_belief(&belief(4, 2, 0.0, 0), 420 * MS).unwrap();
    assert_eq!(told(&action), (ActionCode::Halt, Reason::Belief), "the first step is enough");
}

/// A final belief causes one action; older and repeated frames are ignored.
#[test]
fn each_frame_is_decided_once_and_in_order() {
    let mut controller = calibrated();
    assert!(controller.on_belief(&belief(5, 1, 0.0, 0), 510 * MS).is_none());
    assert!(controller.on_belief(&belief(5, 2, 0.0, 0), 520 * MS).is_some());
    assert!(controller.on_belief(&belief(5, 2, 0.9, 9), 530 * MS).is_none(), "a repetition");
    assert!(controller.on_belief(&belief(4, 1, 0.9, 9), 530 * MS).is_none());
    assert!(controller.on_belief(&belief(4, 2, 0.9, 9), 530 * MS).is_none(), "an older frame");
    assert_eq!(told(&controller.on_tick(540 * MS)), (ActionCode::Advance, Reason::Belief));
}

/// A newer frame's first step abandons the older frame, whose last step then causes no decision.
#[test]
fn newest_frame_wins() {
    let mut controller = calibrated();
    assert!(controller.on_belief(&belief(1, 1, 0.0, 0), 110 * MS).is_none());
    assert!(controller.on_belief(&belief(2, 1, 0.9, 9), 210 * MS).is_none());
    assert!(controller.on_belief(&belief(1, 2, 0.0, 0), 215 * MS).is_none());
    let action = controller.on_belief(&belief(2, 2, 0.0, 0), 220 * MS).unwrap();
    assert_eq!((told(&action), action.based_on_frame), ((ActionCode::Halt, Reason::Belief), 2));
}

/// A decision is valid until the deadline, then the car halts, and the next fresh belief lets it continue.
#[test]
fn halts_when_beliefs_stop_and_recovers() {
    let mut controller = calibrated();
    controller.on_belief(&belief(1, 1, 0.0, 0), 110 * MS);
    assert!(controller.on_belief(&belief(1, 2, 0.0, 0), 120 * MS).is_some());
    let held = controller.on_tick(270 * MS);
    assert_eq!((told(&held), held.is_decision), ((ActionCode::Advance, Reason::Belief), 0));
    assert_eq!(told(&controller.on_tick(271 * MS)), (ActionCode::Halt, Reason::StaleBelief));
    controller.on_belief(&belief(9, 1, 0.0, 0), 910 * MS);
    assert!(controller.on_belief(&belief(9, 2, 0.0, 0), 920 * MS).is_some());
    assert_eq!(told(&controller.on_tick(921 * MS)), (ActionCode::Advance, Reason::Belief));
}

/// A belief that is late, or without its first step, causes halt with its reason, also at ticks.
#[test]
fn late_and_incomplete_beliefs_halt() {
    let mut controller = calibrated();
    controller.on_belief(&belief(1, 1, 0.0, 0), 260 * MS);
    let late = controller.on_belief(&belief(1, 2, 0.0, 0), 260 * MS).unwrap();
    assert_eq!(told(&late), (ActionCode::Halt, Reason::StaleBelief));
    let incomplete = controller.on_belief(&belief(3, 2, 0.0, 0), 310 * MS).unwrap();
    incomplete.validate().unwrap();
    assert_eq!(told(&incomplete), (ActionCode::Halt, Reason::IncompleteBelief));
    assert_eq!(told(&controller.on_tick(311 * MS)), (ActionCode::Halt, Reason::IncompleteBelief));
}

/// An invalid belief causes no action: the current decision is valid until its deadline, then the car halts with the
/// reason.
#[test]
fn invalid_beliefs_are_never_acted_on() {
    let mut controller = calibrated();
    controller.on_belief(&belief(1, 1, 0.0, 0), 110 * MS);
    controller.on_belief(&belief(1, 2, 0.0, 0), 120 * MS);
    let mut bad = belief(2, 2, f32::NAN, 0);
    assert!(controller.on_belief(&bad, 210 * MS).is_none());
    bad.hazard_probability = 0.0;
    bad.header.step = 40;
    assert!(controller.on_belief(&bad, 215 * MS).is_none());
    assert_eq!(told(&controller.on_tick(220 * MS)), (ActionCode::Advance, Reason::Belief));
    assert_eq!(told(&controller.on_tick(300 * MS)), (ActionCode::Halt, Reason::InvalidBelief));
}

/// A look-ahead that ends early (nothing resolved at step 1) causes a decision.
#[test]
fn an_early_end_is_decided_on() {
    let mut controller = calibrated();
    let mut early = belief(1, 1, 0.8, 8);
    early.is_final = 1;
    let action = controller.on_belief(&early, 110 * MS).unwrap();
    assert_eq!(told(&action), (ActionCode::Halt, Reason::Belief));
}

/// The other rules also determine the action: the paper's rule halts on one sample in ten, the two extremes never
/// change.
#[test]
fn every_rule_is_wired() {
    let run = |rule: Rule, hazardous: usize| {
        let mut controller = controller(rule);
        controller.on_belief(&belief(1, 1, hazardous as f32 / 10.0, hazardous), 110 * MS);
        let action = controller.on_belief(&belief(1, 2, 0.0, 0), 120 * MS).unwrap();
        assert_eq!(action.rule, rule.code());
        action.code().unwrap()
    };
    assert_eq!(run(Rule::Paper, 1), ActionCode::Halt);
    assert_eq!(run(Rule::Paper, 0), ActionCode::Advance);
    assert_eq!(run(Rule::Underconfident, 0), ActionCode::Halt);
    assert_eq!(run(Rule::Overconfident, 10), ActionCode::Advance);
}

/// Different messages for one step of a frame, steps that disagree on the horizon, and two frames with one capture time
/// settle the frame with halt at once; the next frame is decided on.
#[test]
fn contradictory_beliefs_halt() {
    let contradict: [fn(&mut Belief); 3] =
        [|b| b.hazard_probability = 0.2, |b| b.horizon = 3, |b| b.header.frame_id += 1];
    for change in contradict {
        let mut controller = calibrated();
        controller.on_belief(&belief(1, 1, 0.0, 0), 110 * MS);
        assert!(controller.on_belief(&belief(1, 1, 0.0, 0), 112 * MS).is_none(), "a repetition is not a contradiction");
        let mut other = belief(1, 1, 0.0, 0);
        change(&mut other);
        let action = controller.on_belief(&other, 115 * MS).unwrap();
        action.validate().unwrap();
        assert_eq!(told(&action), (ActionCode::Halt, Reason::ContradictoryBelief));
        assert!(controller.on_belief(&belief(1, 2, 0.0, 0), 120 * MS).is_none(), "the frame is settled");
        assert_eq!(told(&controller.on_tick(130 * MS)), (ActionCode::Halt, Reason::ContradictoryBelief));
        controller.on_belief(&belief(2, 1, 0.0, 0), 210 * MS);
        assert_eq!(told(&controller.on_belief(&belief(2, 2, 0.0, 0), 220 * MS).unwrap()).0, ActionCode::Advance);
    }
}

/// A belief about a frame in the future causes no action and blocks nothing: the current action stays valid, and later
/// frames are decided on. The same is true for frame numbers beyond all others.
#[test]
fn no_belief_poisons_the_future() {
    let mut controller = calibrated();
    controller.on_belief(&belief(1, 1, 0.0, 0), 110 * MS);
    controller.on_belief(&belief(1, 2, 0.0, 0), 120 * MS).unwrap();
    for step in 1..=2 {
        assert!(controller.on_belief(&belief(50, step, 0.0, 0), 130 * MS).is_none());
    }
    assert_eq!(told(&controller.on_tick(140 * MS)), (ActionCode::Advance, Reason::Belief));
    assert_eq!(told(&controller.on_tick(300 * MS)), (ActionCode::Halt, Reason::ContradictoryBelief));

    for step in 1..=2 {
        let mut last_of_all = belief(3, step, 0.0, 0);
        last_of_all.header.frame_id = u64::MAX;
        controller.on_belief(&last_of_all, 310 * MS);
    }
    controller.on_belief(&belief(4, 1, 0.9, 9), 410 * MS);
    let action = controller.on_belief(&belief(4, 2, 0.0, 0), 420 * MS).unwrap();
    assert_eq!((told(&action), action.based_on_frame), ((ActionCode::Halt, Reason::Belief), 4));
}

/// The current action has an expiry, and a tick at that time halts; without a current action there is no wake-up. The
/// last action is the safe action.
#[test]
fn a_decision_expires_on_time() {
    let mut controller = calibrated();
    assert_eq!(controller.expires_ns(), u64::MAX);
    controller.on_belief(&belief(1, 1, 0.0, 0), 110 * MS);
    let action = controller.on_belief(&belief(1, 2, 0.0, 0), 120 * MS).unwrap();
    assert_eq!(controller.expires_ns(), action.valid_until_ns + 1);
    assert_eq!(told(&controller.on_tick(controller.expires_ns() - 1)).0, ActionCode::Advance);
    assert_eq!(told(&controller.on_tick(action.valid_until_ns + 1)), (ActionCode::Halt, Reason::StaleBelief));
    assert_eq!(controller.expires_ns(), u64::MAX);
    assert_eq!(told(&controller.on_stop(300 * MS)), (ActionCode::Halt, Reason::Stopping));
}

/// An unusable image is decided on at once, with the safe action and its condition as the reason; beliefs are ignored
/// until a usable image arrives, and then count again.
#[test]
fn unusable_images_halt_until_a_usable_one() {
    let mut controller = calibrated();
    let check = |frame_id: u64, condition: ImageCondition| ImageCheck {
        condition: condition.code(),
        ..ImageCheck::of_frame(Header::of_frame(frame_id, frame_id * 100 * MS, 1))
    };
    assert!(controller.on_check(&check(1, ImageCondition::Usable), 101 * MS).is_none());
    for condition in ImageCondition::ALL.into_iter().filter(|c| *c != ImageCondition::Usable) {
        let action = controller.on_check(&check(2, condition), 202 * MS).unwrap();
        action.validate().unwrap();
        assert_eq!(told(&action), (ActionCode::Halt, condition.reason().unwrap()));
        assert_eq!((action.based_on_frame, action.is_decision), (2, 1));
    }
    controller.on_check(&check(2, ImageCondition::Frozen), 202 * MS);
    for step in 1..=2 {
        assert!(controller.on_belief(&belief(2, step, 0.0, 0), 210 * MS).is_none());
    }
    assert_eq!(told(&controller.on_tick(250 * MS)), (ActionCode::Halt, Reason::FrozenImage));
    // An older check, which was delayed, changes nothing.
    assert!(controller.on_check(&check(1, ImageCondition::Usable), 260 * MS).is_none());
    assert_eq!(told(&controller.on_tick(270 * MS)), (ActionCode::Halt, Reason::FrozenImage));
    assert!(controller.on_check(&check(3, ImageCondition::Usable), 301 * MS).is_none());
    assert!(controller.on_belief(&belief(3, 1, 0.0, 0), 310 * MS).is_none());
    let action = controller.on_belief(&belief(3, 2, 0.0, 0), 320 * MS).unwrap();
    assert_eq!(told(&action), (ActionCode::Advance, Reason::Belief));
}

/// Something unknown halts, unless the graph file ignores it.
#[test]
fn the_unknown_halts_unless_ignored() {
    for ignores_unknown in [false, true] {
        let policy = Policy { ignores_unknown, ..Policy::new(Rule::Calibrated, 0.3) };
        let mut controller = Controller::new(settings(policy));
        let mut last = None;
        for step in 1..=2 {
            let belief = Belief { unknown_probability: 0.9, ..belief(1, step, 0.0, 0) };
            belief.validate().unwrap();
            last = controller.on_belief(&belief, 110 * MS);
        }
        let wanted = if ignores_unknown { ActionCode::Advance } else { ActionCode::Halt };
        let action = last.unwrap();
        assert_eq!((action.code(), action.unknown_probability), (Ok(wanted), 0.9));
    }
}

/// A vehicle whose motion is known creeps by its approach, and crosses a lane that is clear far enough; a motion older
/// than the deadline, and a look from another frame, do not count.
#[test]
fn approaches_use_what_is_fresh() {
    let policy = Policy::new(Rule::Calibrated, 0.3);
    let mut controller = Controller::new(Settings { approach: Approach::Look, ..settings(policy) });
    let mut decide = |frame: u64, moved_at: u64, looked_at: u64, clear_m: f32| {
        let header = |frame: u64| Header::of_frame(frame, frame * 100 * MS, 1);
        controller.on_motion(&EgoMotion {
            header: header(moved_at),
            speed_mps: 2.0,
            to_conflict_m: 20.0,
            through_conflict_m: 26.0,
            ..EgoMotion::default()
        });
        let look = LookGain { header: header(looked_at), gain_bits: 0.8, ahead_m: 3.0, clear_m, ..LookGain::default() };
        controller.on_look(&look);
        controller.on_belief(&belief(frame, 1, 0.6, 6), frame * 100 * MS + MS);
        let action = controller.on_belief(&belief(frame, 2, 0.6, 6), frame * 100 * MS + 2 * MS).unwrap();
        action.validate().unwrap();
        (action.code().unwrap(), action.target_speed_mps, action.look_gain_bits)
    };
    assert_eq!(decide(3, 3, 3, 5.0), (ActionCode::Creep, 5.0, 0.8));
    assert_eq!(decide(4, 4, 3, 90.0), (ActionCode::Creep, 1.5, 0.0));
    assert_eq!(decide(6, 4, 6, 90.0), (ActionCode::Halt, 0.0, 0.8));
    assert_eq!(decide(7, 7, 7, 90.0), (ActionCode::Advance, 5.0, 0.8));
}
