//! The journal for the window's lists and plots: decisions and durations.

use carff_base::statistics::Spread;
use carff_messages::ActionCode;
use std::collections::VecDeque;

/// Maximum number of stored decisions.
const MOST_DECISIONS: usize = 500;
/// Maximum number of stored durations of each kind.
const MOST_TIMES: usize = 600;

/// A decision with its reason.
#[derive(Clone, Debug, PartialEq)]
pub struct ShownDecision {
    /// Basis of the decision: an image or a frame, and the number of steps.
    pub rests_on: String,
    /// The action.
    pub action: ActionCode,
    /// Confidence of the rule, 0..=1.
    pub confidence: f32,
    /// Probability of the hazard at any step looked at, 0..=1.
    pub hazard_probability: f32,
    /// The rule, or the reason for the safe action.
    pub reason: String,
    /// Latency from camera to action, if a graph decided.
    pub latency_ms: Option<f64>,
}

/// Durations of one kind, by frame number or count.
#[derive(Clone, Debug, PartialEq)]
pub struct OperationTimes {
    /// Name of the measured operation.
    pub name: &'static str,
    /// `[number, milliseconds]`, oldest first.
    pub values: VecDeque<[f64; 2]>,
}

impl OperationTimes {
    /// Returns p50, p99 and maximum, milliseconds.
    pub fn spread(&self) -> Option<Spread> {
        Spread::of(&self.values.iter().map(|v| v[1]).collect::<Vec<_>>())
    }
}

/// The newest decisions and durations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Journal {
    decisions: VecDeque<ShownDecision>,
    times: Vec<OperationTimes>,
}

impl Journal {
    /// Adds a decision.
    pub fn decided(&mut self, decision: ShownDecision) {
        if self.decisions.len() >= MOST_DECISIONS {
            self.decisions.pop_front();
        }
        self.decisions.push_back(decision);
    }

    /// Adds a duration. `at` is the frame's number, or the count of earlier durations.
    pub fn took(&mut self, name: &'static str, at: f64, milliseconds: f64) {
        let index = self.times.iter().position(|t| t.name == name).unwrap_or_else(|| {
            self.times.push(OperationTimes { name, values: VecDeque::new() });
            self.times.len() - 1
        });
        let values = &mut self.times[index].values;
        if values.len() >= MOST_TIMES {
            values.pop_front();
        }
        values.push_back([at, milliseconds]);
    }

    /// Adds a duration as [`Journal::took`] does, numbered by the count of earlier ones.
    pub fn took_next(&mut self, name: &'static str, milliseconds: f64) {
        let last = self.times.iter().find(|t| t.name == name).and_then(|t| t.values.back());
        self.took(name, last.map_or(0.0, |v| v[0] + 1.0), milliseconds);
    }

    /// Returns the decisions, oldest first.
    pub fn decisions(&self) -> impl DoubleEndedIterator<Item = &ShownDecision> + ExactSizeIterator {
        self.decisions.iter()
    }

    /// Returns the durations by kind.
    pub fn times(&self) -> &[OperationTimes] {
        &self.times
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The journal keeps the newest entries in order, and their numbers continue.
    #[test]
    fn is_bounded() {
        let mut journal = Journal::default();
        for i in 0..2 * MOST_TIMES {
            journal.took_next("encoder", i as f64);
            let rests_on = i.to_string();
            let (reason, hazard_probability) = (String::new(), 0.5);
            journal.decided(ShownDecision {
                rests_on,
                action: ActionCode::Halt,
                confidence: 0.5,
                hazard_probability,
                reason,
                latency_ms: None,
            });
        }
        let last = (2 * MOST_TIMES - 1) as f64;
        let times = &journal.times()[0];
        assert_eq!((times.values.len(), times.values.back()), (MOST_TIMES, Some(&[last, last])));
        assert_eq!(times.spread().map(|s| s.max), Some(last));
        assert_eq!(journal.decisions().len(), MOST_DECISIONS);
        assert_eq!(journal.decisions().next_back().map(|d| d.rests_on.clone()), Some(last.to_string()));
    }
}
