//! Tests of the controller process, with a test in place of the prober that publishes invalid beliefs.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::{
    Action, ActionCode, Belief, Header, Health, HealthState, ImageCheck, ImageCondition, Message, Reason, Stage,
};
use carff_tests::{Process, TestGraph, eventually};
use carff_transport::{Node, Publisher, Receiver, monotonic_now_ns, topics};
use rustix::process::Signal;
use std::path::Path;
use std::sync::OnceLock;

const HORIZON: u32 = 2;

/// Returns a valid belief of two states. All steps of a frame have one capture time, and a later frame has a later one.
fn belief(run_id: u64, frame_id: u64, step: u32, hazard: f32) -> Belief {
    static START_NS: OnceLock<u64> = OnceLock::new();
    let captured_ns = START_NS.get_or_init(|| monotonic_now_ns() - 1_000_000) + frame_id;
    let mut header = Header::of_frame(frame_id, captured_ns, 1).at_step(step);
    header.run_id = run_id;
    let mut belief = Belief::empty(header, HORIZON);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (2, 1, 1, 1);
    belief.component_weights[0] = 1.0;
    (belief.state_probability[0], belief.state_probability[1]) = (hazard, 1.0 - hazard);
    belief.samples[0].state = 1;
    belief.samples[0].hazard_likelihood = hazard;
    belief.resolved_state = 1;
    belief.hazard_probability = hazard;
    belief
}

/// A controller under test, with its messages.
struct Controlled {
    graph: TestGraph,
    process: Process,
    beliefs: Publisher<Belief>,
    actions: Receiver<Action>,
    healths: Receiver<Health>,
    /// All actions so far.
    seen: Vec<Action>,
    health: Option<Health>,
    // This field is dropped last: it closes the run.
    node: Node,
}

impl Controlled {
    fn start(deadline_ms: u64) -> Self {
        let rest = format!(
            "[controller]\nrule = \"calibrated\"\nthreshold = 0.5\nrate_hz = 4.0\ndeadline_ms = {deadline_ms}\n"
        );
        let graph = TestGraph::new(Path::new("none"), Path::new("none"), &rest);
        let node = Node::open(graph.run(), "test").unwrap();
        let beliefs = node.publisher(&topics::BELIEF).unwrap();
        let actions = node.receiver(&topics::ACTION).unwrap();
        let healths = node.receiver(topics::health(Stage::Controller)).unwrap();
        let process = graph.stage(Stage::Controller);
        let mut controlled = Self { graph, process, beliefs, actions, healths, seen: Vec::new(), health: None, node };
        controlled.until("it is ready", |c| c.health.is_some_and(|h| h.state == HealthState::Ok.code()));
        controlled
    }

    fn until(&mut self, what: &str, mut holds: impl FnMut(&Self) -> bool) {
        let came = eventually(|| {
            while let Some(action) = self.actions.next().unwrap() {
                self.seen.push(*action);
            }
            if let Some(health) = self.healths.newest().unwrap() {
                self.health = Some(*health);
            }
            holds(self)
        });
        assert!(came, "waited in vain until {what}:\n{}", self.process.text());
    }

    fn until_decided(&mut self, frame_id: u64) -> Action {
        let decides = |a: &&Action| a.is_decision() && a.based_on_frame == frame_id;
        self.until("it decides", |c| c.seen.iter().any(|a| decides(&a)));
        *self.seen.iter().find(decides).unwrap()
    }

    fn until_invalid(&mut self, count: u64) {
        self.until("it counts what it drops", |c| c.health.is_some_and(|h| h.invalid == count));
    }

    fn stop(self) {
        self.process.signal(Signal::TERM);
        self.process.end().assert_success();
        drop((self.beliefs, self.actions, self.healths));
    }
}

/// Beliefs with a NaN, an infinity, a wrong count, another schema or another run are dropped and counted one by one. No
/// action is based on them; valid beliefs before and after them are decided on.
#[test]
fn rogue_beliefs_never_reach_an_action() {
    let mut controller = Controlled::start(60_000);
    let run_id = controller.graph.run().id();
    for step in 1..=HORIZON {
        controller.beliefs.send(belief(run_id, 0, step, 0.0)).unwrap();
    }
    assert_eq!(controller.until_decided(0).code().unwrap(), ActionCode::Advance);

    let faults: [fn(&mut Belief); 10] = [
        |b| b.hazard_probability = f32::NAN,
        |b| b.path_probability = f32::NAN,
        |b| b.state_probability[1] = f32::NAN,
        |b| b.component_weights[0] = f32::NAN,
        |b| b.samples[0].hazard_likelihood = f32::NAN,
        |b| b.samples[0].occupancies[0] = f32::INFINITY,
        |b| b.resolved.mean[3] = f32::NAN,
        |b| b.sample_count = 65,
        |b| b.header.schema_version += 1,
        |b| b.header.run_id += 1,
    ];
    for (i, fault) in faults.iter().enumerate() {
        let frame_id = 1 + i as u64;
        controller.beliefs.send(belief(run_id, frame_id, 1, 0.0)).unwrap();
        let mut rogue = belief(run_id, frame_id, HORIZON, 0.0);
        fault(&mut rogue);
        controller.beliefs.send_unchecked(rogue).unwrap();
        controller.until_invalid(frame_id);
    }

    for step in 1..=HORIZON {
        controller.beliefs.send(belief(run_id, 100, step, 0.9)).unwrap();
    }
    assert_eq!(controller.until_decided(100).code().unwrap(), ActionCode::Halt);
    for action in &controller.seen {
        assert!(action.validate().is_ok(), "{action:?}");
        let rests_on = action.based_on_frame;
        assert!([0, 100, u64::MAX].contains(&rests_on), "an action is based on the rogue frame {rests_on}");
    }
    controller.stop();
}

/// Without a valid belief the car halts: first because none has arrived, then because the last one was not valid.
#[test]
fn what_is_not_valid_halts() {
    let mut controller = Controlled::start(150);
    let halts = |reason: Reason| {
        move |c: &Controlled| c.seen.iter().any(|a| a.reason == reason.code() && a.action == ActionCode::Halt.code())
    };
    controller.until("it halts without a belief", halts(Reason::NoBeliefYet));
    let run_id = controller.graph.run().id();
    let mut rogue = belief(run_id, 0, HORIZON, 0.0);
    rogue.hazard_probability = f32::NAN;
    controller.beliefs.send_unchecked(rogue).unwrap();
    controller.until("it halts on an invalid belief", halts(Reason::InvalidBelief));
    assert!(controller.seen.iter().all(|a| a.code().unwrap() == ActionCode::Halt && !a.is_decision()));
    controller.stop();
}

/// The condition of an image is logged by its name, once for all images that have it. Each of them is decided on.
#[test]
fn conditions_of_images_are_logged_when_they_change() {
    let mut controller = Controlled::start(60_000);
    let mut checks = controller.node.publisher(&topics::CHECK).unwrap();
    let (covered, usable) = (ImageCondition::Covered, ImageCondition::Usable);
    for (frame_id, condition) in (1_u64..).zip([covered, covered, covered, usable, usable, covered]) {
        let mut header = Header::of_frame(frame_id, monotonic_now_ns(), 1);
        header.run_id = controller.graph.run().id();
        checks.send(ImageCheck { condition: condition.code(), ..ImageCheck::of_frame(header) }).unwrap();
        if condition == covered {
            assert_eq!(controller.until_decided(frame_id).reason().unwrap(), Reason::CoveredLens);
        }
    }
    drop(checks);
    controller.process.signal(Signal::TERM);
    let text = controller.process.end().text;
    let logged: Vec<&str> = text.lines().filter(|line| line.contains("the image is")).collect();
    assert_eq!(logged.len(), 3, "{text}");
    assert!(logged[0].contains("not usable: covered") && logged[1].contains("usable again"), "{text}");
}
