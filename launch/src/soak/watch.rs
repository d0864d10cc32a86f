//! Subscribes to a graph under test, and keeps notes of its messages.

use super::answer::Answer;
use super::judge::{Judge, Terms};
use crate::NS_PER_MS;
use anyhow::Context;
use carff_messages::{Action, Belief, EgoMotion, Health, HealthState, ImageCheck, Reason, Stage};
use carff_transport::{Input, Node, Receiver, Waiter, monotonic_now_ns, topics};
use std::collections::{BTreeMap, VecDeque};

/// Number of messages that are kept as evidence.
const EVIDENCE: usize = 400;
/// Longest sleep between two reads of the inputs, nanoseconds.
const LOOK_NS: u64 = 20_000_000;
/// A longer pause of the soak itself counts for no stage.
const STALL_NS: u64 = 100_000_000;

/// Subscriptions to a running graph.
pub(super) struct Watcher {
    beliefs: Receiver<Belief>,
    motions: Receiver<EgoMotion>,
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
            motions: node.receiver(&topics::EGO_MOTION)?.polled(),
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
        while let Some(motion) = self.motions.next()? {
            notes.judge.moved(&motion);
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
                    notes.latency_ms.push((self.decided_ns - action.header.capture_time_ns) as f64 / NS_PER_MS as f64);
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
