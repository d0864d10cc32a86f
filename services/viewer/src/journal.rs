//! What happened, for the window's lists and plots: decisions, and how long things took.

use carff_metrics::Spread;
use std::collections::VecDeque;

/// Decisions that are kept.
const MOST_DECISIONS: usize = 500;
/// Times that are kept of each kind.
const MOST_TIMES: usize = 600;

/// One decision.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// What it rests on: an image or a frame, and how many steps.
    pub rests_on: String,
    /// Halt, or advance.
    pub halt: bool,
    /// How sure the rule is, 0..=1.
    pub confidence: f32,
    /// Probability that the hazard is met at any step looked at, 0..=1.
    pub hazard_probability: f32,
    /// The rule, or why the safe action was taken.
    pub reason: String,
    /// From the camera to the action, where a graph took it.
    pub latency_ms: Option<f64>,
}

/// Times of one kind, by the number of what they were taken at.
#[derive(Clone, Debug, PartialEq)]
pub struct Times {
    /// What took so long.
    pub name: &'static str,
    /// `[number, milliseconds]`, oldest first.
    pub values: VecDeque<[f64; 2]>,
}

impl Times {
    /// p50, p99 and the longest, milliseconds.
    pub fn spread(&self) -> Option<Spread> {
        Spread::of(&self.values.iter().map(|v| v[1]).collect::<Vec<_>>())
    }
}

/// Decisions and times, the newest of each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Journal {
    decisions: VecDeque<Decision>,
    times: Vec<Times>,
}

impl Journal {
    /// Writes a decision down.
    pub fn decided(&mut self, decision: Decision) {
        if self.decisions.len() >= MOST_DECISIONS {
            self.decisions.pop_front();
        }
        self.decisions.push_back(decision);
    }

    /// Writes a time down. `at` is the frame's number, or how many came before.
    pub fn took(&mut self, name: &'static str, at: f64, milliseconds: f64) {
        let index = self.times.iter().position(|t| t.name == name).unwrap_or_else(|| {
            self.times.push(Times { name, values: VecDeque::new() });
            self.times.len() - 1
        });
        let values = &mut self.times[index].values;
        if values.len() >= MOST_TIMES {
            values.pop_front();
        }
        values.push_back([at, milliseconds]);
    }

    /// As [`Journal::took`], numbered by what was written down before.
    pub fn took_next(&mut self, name: &'static str, milliseconds: f64) {
        let last = self.times.iter().find(|t| t.name == name).and_then(|t| t.values.back());
        self.took(name, last.map_or(0.0, |v| v[0] + 1.0), milliseconds);
    }

    /// The decisions, oldest first.
    pub fn decisions(&self) -> impl DoubleEndedIterator<Item = &Decision> + ExactSizeIterator {
        self.decisions.iter()
    }

    /// The times, by kind.
    pub fn times(&self) -> &[Times] {
        &self.times
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The newest are kept, in order, and numbers go on.
    #[test]
    fn is_bounded() {
        let mut journal = Journal::default();
        for i in 0..2 * MOST_TIMES {
            journal.took_next("encoder", i as f64);
            let rests_on = i.to_string();
            let (reason, hazard_probability) = (String::new(), 0.5);
            journal.decided(Decision {
                rests_on,
                halt: true,
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
