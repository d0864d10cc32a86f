//! From a probed belief to an action: the decision rules.
//!
//! What lives here: which of halt and advance follows from what the probed samples show. Pure arithmetic: no tensors,
//! no messages, no clock.
//!
//! ```
//! use carff_planning::{decide, Evidence, Rule};
//! let evidence = Evidence { states: &[Some(0), Some(3)], shows_hazard: &[true, false], hazard_probability: 0.5 };
//! assert!(decide(Rule::Paper, &evidence).halt);
//! assert!(!decide(Rule::Overconfident, &evidence).halt);
//! ```

use serde::{Deserialize, Serialize};

/// How a belief becomes an action.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Rule {
    /// Always halt: what a planner does that trusts nothing it cannot see.
    Underconfident,
    /// Always advance: what a planner does that believes only what it sees.
    Overconfident,
    /// The paper's rule (section 4.3): halt when the samples disagree or show the actor.
    Paper,
    /// Halt when the hazard probability reaches a threshold, chosen on calibration poses only.
    Calibrated {
        /// Threshold on the hazard probability, 0..=1.
        threshold: f64,
    },
}

impl Rule {
    /// The name that reports use.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Underconfident => "underconfident",
            Self::Overconfident => "overconfident",
            Self::Paper => "paper",
            Self::Calibrated { .. } => "calibrated",
        }
    }
}

/// What the probed samples of one belief show.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// Per sample: the known state that it shows, if any.
    pub states: &'a [Option<usize>],
    /// Per sample: whether it shows a hazard.
    pub shows_hazard: &'a [bool],
    /// Probability that the hazard is met, from mixture weights and probe likelihoods, 0..=1.
    pub hazard_probability: f64,
}

/// What a rule says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// Halt (`true`) or advance.
    pub halt: bool,
    /// How sure the rule is of it, 0..=1.
    pub confidence: f64,
}

/// Applies a rule. Evidence that is no evidence (no samples, a probability that is none) always halts.
pub fn decide(rule: Rule, evidence: &Evidence<'_>) -> Decision {
    let p = evidence.hazard_probability;
    if !(0.0..=1.0).contains(&p) || evidence.shows_hazard.is_empty() {
        return Decision { halt: true, confidence: 0.0 };
    }
    let share = evidence.shows_hazard.iter().filter(|&&h| h).count() as f64 / evidence.shows_hazard.len() as f64;
    match rule {
        Rule::Underconfident => Decision { halt: true, confidence: 1.0 },
        Rule::Overconfident => Decision { halt: false, confidence: 1.0 },
        Rule::Paper => {
            // Samples disagree when some show the hazard and some do not; a sample that shows no known state
            // disagrees with every other.
            let unknown = evidence.states.iter().any(Option::is_none);
            let halt = share > 0.0 || unknown;
            Decision { halt, confidence: if halt { share.max(1.0 - share) } else { 1.0 - share } }
        }
        Rule::Calibrated { threshold } => {
            let halt = p >= threshold;
            Decision { halt, confidence: if halt { p } else { 1.0 - p } }
        }
    }
}

/// One calibration trial: the hazard probability that was found, and whether the right action is to halt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationTrial {
    /// Hazard probability, 0..=1.
    pub hazard_probability: f64,
    /// Whether halting is right.
    pub halt_is_right: bool,
}

/// The threshold that gets most trials right, hazard and clear trials weighted equally. Of an interval of equally good
/// thresholds the geometric middle of the odds is taken, so that it stands as far from both sides as it can.
/// `None` when one kind of trial is missing.
pub fn choose_threshold(trials: &[CalibrationTrial]) -> Option<f64> {
    let hazards = trials.iter().filter(|t| t.halt_is_right).count();
    let clears = trials.len() - hazards;
    if hazards == 0 || clears == 0 {
        return None;
    }
    let mut values: Vec<f64> = trials.iter().map(|t| t.hazard_probability.clamp(0.0, 1.0)).collect();
    values.push(1.0);
    values.push(0.0);
    values.sort_by(f64::total_cmp);
    values.dedup();
    let logit = |p: f64| (p.clamp(1e-4, 1.0 - 1e-4) / (1.0 - p.clamp(1e-4, 1.0 - 1e-4))).ln();
    // A threshold anywhere in (values[i], values[i + 1]] decides alike.
    let score = |threshold: f64| {
        let right = |wanted: bool| {
            trials.iter().filter(|t| t.halt_is_right == wanted && (t.hazard_probability >= threshold) == wanted).count()
        };
        right(true) as f64 / hazards as f64 + right(false) as f64 / clears as f64
    };
    let best = values
        .windows(2)
        .map(|w| (score(w[1]), logit(w[1]) - logit(w[0]), w))
        .max_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)))?;
    let middle = logit(best.2[0]).midpoint(logit(best.2[1]));
    Some(1.0 / (1.0 + (-middle).exp()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn evidence<'a>(states: &'a [Option<usize>], shows: &'a [bool], p: f64) -> Evidence<'a> {
        Evidence { states, shows_hazard: shows, hazard_probability: p }
    }

    /// The paper's rule advances only when no sample shows the actor and none is unknown.
    #[test]
    fn paper_rule_halts_on_any_hazard() {
        let clear = [Some(3), Some(4)];
        assert!(!decide(Rule::Paper, &evidence(&clear, &[false, false], 0.0)).halt);
        assert!(decide(Rule::Paper, &evidence(&clear, &[false, true], 0.1)).halt);
        assert!(decide(Rule::Paper, &evidence(&[Some(3), None], &[false, false], 0.0)).halt);
    }

    /// The calibrated rule halts at its threshold and above.
    #[test]
    fn calibrated_rule_uses_the_threshold() {
        let rule = Rule::Calibrated { threshold: 0.25 };
        assert!(decide(rule, &evidence(&[Some(0)], &[true], 0.25)).halt);
        assert!(!decide(rule, &evidence(&[Some(0)], &[true], 0.24)).halt);
    }

    /// No samples, or a probability that is none, halt under every rule.
    #[test]
    fn no_evidence_halts() {
        let rules = [Rule::Underconfident, Rule::Overconfident, Rule::Paper, Rule::Calibrated { threshold: 0.5 }];
        for rule in rules {
            assert!(decide(rule, &evidence(&[], &[], 0.0)).halt);
            assert!(decide(rule, &evidence(&[Some(0)], &[false], f64::NAN)).halt);
            assert!(decide(rule, &evidence(&[Some(0)], &[false], 1.5)).halt);
        }
    }

    /// Separable trials: the threshold separates them; overlapping ones: it errs least; one kind alone: none.
    #[test]
    fn threshold_separates() {
        let trial = |p, h| CalibrationTrial { hazard_probability: p, halt_is_right: h };
        let t = choose_threshold(&[trial(0.05, false), trial(0.1, false), trial(0.5, true), trial(0.9, true)]).unwrap();
        assert!(t > 0.1 && t < 0.5);
        let overlapping = [trial(0.1, false), trial(0.3, false), trial(0.2, true), trial(0.6, true), trial(0.7, true)];
        let t = choose_threshold(&overlapping).unwrap();
        assert!(t > 0.3 && t <= 0.6, "{t}");
        assert_eq!(choose_threshold(&[trial(0.1, false)]), None);
    }
}
