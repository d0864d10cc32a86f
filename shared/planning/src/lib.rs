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

/// Log odds are held within those of this probability and of its opposite: what is surer is as sure.
const SUREST: f64 = 1e-4;
/// Keeps the slope finite where trials can be told apart without an error; the threshold then stands in the middle.
const RIDGE: f64 = 1e-4;
/// Newton steps; a dozen do.
const MOST_STEPS: usize = 200;

/// The threshold where there are no trials to choose one by: half of the hazard probability of a belief that is even over the
/// branches, which is what hazard trials have, while clear ones have next to none.
pub fn unchosen_threshold(hazard_branches: usize, branches: usize) -> f64 {
    0.5 * hazard_branches as f64 / branches.max(1) as f64
}

/// The threshold at which hazard and clear trials, each kind weighing the same, are equally likely: logistic regression
/// of the right answer on the log odds of the hazard probability. Unlike the threshold with the fewest errors it does not
/// lean on the few trials that happen to lie next to it. 0, which always halts, where higher probabilities do not speak
/// for a hazard. `None` when one kind of trial is missing.
pub fn choose_threshold(trials: &[CalibrationTrial]) -> Option<f64> {
    let hazards = trials.iter().filter(|t| t.halt_is_right).count();
    let clears = trials.len() - hazards;
    if hazards == 0 || clears == 0 {
        return None;
    }
    let log_odds = |p: f64| {
        let p = if p.is_nan() { 0.5 } else { p.clamp(SUREST, 1.0 - SUREST) };
        (p / (1.0 - p)).ln()
    };
    let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
    // Newton's method on the weighted log loss, in slope and offset.
    let (mut slope, mut offset) = (0.0, 0.0);
    for _ in 0..MOST_STEPS {
        let (mut d_slope, mut d_offset) = (RIDGE * slope, 0.0);
        let (mut h_slope, mut h_both, mut h_offset) = (RIDGE, 0.0, 1e-12);
        for trial in trials {
            let (x, wanted) = (log_odds(trial.hazard_probability), f64::from(u8::from(trial.halt_is_right)));
            let weight = 1.0 / if trial.halt_is_right { hazards } else { clears } as f64;
            let p = sigmoid(slope * x + offset);
            let (error, curvature) = (weight * (p - wanted), weight * p * (1.0 - p));
            (d_slope, d_offset) = (d_slope + error * x, d_offset + error);
            h_slope += curvature * x * x;
            h_both += curvature * x;
            h_offset += curvature;
        }
        let determinant = h_slope * h_offset - h_both * h_both;
        let by_slope = (h_offset * d_slope - h_both * d_offset) / determinant;
        let by_offset = (h_slope * d_offset - h_both * d_slope) / determinant;
        let length = by_slope.hypot(by_offset);
        if !length.is_finite() || length < 1e-9 {
            break;
        }
        // No farther at a time than the second-order picture holds.
        let share = (5.0 / length).min(1.0);
        (slope, offset) = (slope - share * by_slope, offset - share * by_offset);
    }
    Some(if slope > 0.0 { sigmoid(-offset / slope) } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn evidence<'a>(states: &'a [Option<usize>], shows: &'a [bool], p: f64) -> Evidence<'a> {
        Evidence { states, shows_hazard: shows, hazard_probability: p }
    }

    /// With no trials, the threshold is half of what an even belief over the branches has.
    #[test]
    fn without_trials_half_an_even_belief() {
        assert_eq!(unchosen_threshold(1, 2), 0.25);
        assert!((unchosen_threshold(2, 3) - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(unchosen_threshold(0, 0), 0.0);
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

    /// Separable trials: the threshold separates them, in the middle; overlapping ones: it stands between the two kinds,
    /// and one odd trial does not carry it to the edge of the others; probabilities that mean nothing: it always halts;
    /// one kind alone: none.
    #[test]
    fn threshold_separates() {
        let trial = |p, h| CalibrationTrial { hazard_probability: p, halt_is_right: h };
        let t = choose_threshold(&[trial(0.05, false), trial(0.1, false), trial(0.5, true), trial(0.9, true)]).unwrap();
        assert!((t - 0.25).abs() < 0.01, "{t}");
        let overlapping = [trial(0.1, false), trial(0.3, false), trial(0.2, true), trial(0.6, true), trial(0.7, true)];
        let t = choose_threshold(&overlapping).unwrap();
        assert!(t > 0.2 && t < 0.6, "{t}");
        let mut trials: Vec<_> = (0..40).map(|i| trial(0.3 + 0.01 * f64::from(i), true)).collect();
        trials.extend((0..20).map(|_| trial(0.001, false)));
        let before = choose_threshold(&trials).unwrap();
        trials.push(trial(0.5, false));
        let after = choose_threshold(&trials).unwrap();
        assert!(before < after && after < 0.3, "{before} {after}");
        assert_eq!(choose_threshold(&[trial(0.2, true), trial(0.8, false)]), Some(0.0));
        for odd in [f64::NAN, -1.0, 7.0] {
            let t = choose_threshold(&[trial(odd, true), trial(0.1, false)]).unwrap();
            assert!((0.0..=1.0).contains(&t), "{odd}: {t}");
        }
        assert_eq!(choose_threshold(&[trial(0.1, false)]), None);
    }
}
