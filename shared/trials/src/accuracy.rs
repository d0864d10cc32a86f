//! State accuracy: counts of correct answers, by how much a view shows.

use carff_dataset::Observability;
use serde::{Deserialize, Serialize};

/// Correct answers among the trials of one kind of view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Share {
    /// Correct up to visual equivalence.
    pub right: usize,
    /// Correct with the exact state.
    pub right_by_name: usize,
    /// Expected number of exact answers of an observer that knows all that the images show, and guesses among
    /// equivalent states.
    pub best_by_name: f64,
    /// Views counted.
    pub trials: usize,
}

impl Share {
    /// Accuracy up to visual equivalence, 0..=1; 0 for no trials.
    pub fn accuracy(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.right as f64 / self.trials as f64 }
    }

    /// Exact-state accuracy, 0..=1; 0 for no trials.
    pub fn raw(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.right_by_name as f64 / self.trials as f64 }
    }

    /// Upper bound of [`Self::raw`], 0..=1; 0 for no trials.
    pub fn ceiling(&self) -> f64 {
        if self.trials == 0 { 0.0 } else { self.best_by_name / self.trials as f64 }
    }

    /// Counts one answer; `equivalent` is the number of states that look the same, including the true one.
    pub fn count(&mut self, right: bool, by_name: bool, equivalent: usize) {
        self.trials += 1;
        self.best_by_name += 1.0 / equivalent.max(1) as f64;
        self.right += usize::from(right);
        self.right_by_name += usize::from(by_name);
    }
}

/// Ratios of a [`Share`], as manifests and run metrics hold them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accuracy {
    /// Accuracy up to visual equivalence, 0..=1.
    pub accuracy: f64,
    /// Exact-state accuracy, 0..=1.
    pub raw: f64,
    /// Upper bound of `raw`, 0..=1.
    pub raw_ceiling: f64,
    /// Views counted.
    pub trials: usize,
}

impl From<Share> for Accuracy {
    fn from(share: Share) -> Self {
        Self { accuracy: share.accuracy(), raw: share.raw(), raw_ceiling: share.ceiling(), trials: share.trials }
    }
}

/// One value for each visibility of the actor's place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ByObservability<T = Share> {
    /// Fully visible.
    pub full: T,
    /// Partly visible.
    pub partial: T,
    /// Hidden.
    pub none: T,
}

impl<T> ByObservability<T> {
    /// Value of one visibility.
    pub fn of(&mut self, observability: Observability) -> &mut T {
        match observability {
            Observability::Full => &mut self.full,
            Observability::Partial => &mut self.partial,
            Observability::None => &mut self.none,
        }
    }

    /// Converts each value.
    pub fn map<U>(self, convert: impl Fn(T) -> U) -> ByObservability<U> {
        ByObservability { full: convert(self.full), partial: convert(self.partial), none: convert(self.none) }
    }
}
