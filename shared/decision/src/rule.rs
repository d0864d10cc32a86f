//! The decision rules: from the evidence of one frame to an action.

use crate::Evidence;
use carff_messages::Rule;

/// Probability from which on something is likely: the paper's rule then halts for something unknown.
const LIKELY: f64 = 0.5;

/// Reports whether something of a probability is likely, as the paper's rule takes it.
///
/// ```
/// assert!(carff_decision::is_likely(0.5) && !carff_decision::is_likely(0.4));
/// ```
pub fn is_likely(probability: f64) -> bool {
    probability >= LIKELY
}

/// A rule with the threshold that it uses.
///
/// ```
/// use carff_decision::{Evidence, Policy};
/// use carff_messages::Rule;
/// // Without evidence, every rule halts.
/// assert!(Policy::new(Rule::Calibrated, 0.25).decide(&Evidence::NONE).halt);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Policy {
    /// The rule.
    pub rule: Rule,
    /// The hazard probability from which on [`Rule::Calibrated`] halts, 0..=1; the other rules ignore it.
    pub threshold: f64,
    /// True if the probability of something unknown is left out.
    pub ignores_unknown: bool,
}

/// The outcome of a rule.
///
/// ```
/// use carff_decision::{Evidence, Policy};
/// use carff_messages::Rule;
/// // Without samples, every rule halts.
/// let decision = Policy::new(Rule::Calibrated, 0.2).decide(&Evidence::NONE);
/// assert!(decision.halt && decision.confidence == 0.0);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// Halt (`true`) or advance.
    pub halt: bool,
    /// Confidence of the rule in this action, 0..=1.
    pub confidence: f64,
}

impl Policy {
    /// Returns a rule that counts something unknown as a hazard.
    pub const fn new(rule: Rule, threshold: f64) -> Self {
        Self { rule, threshold, ignores_unknown: false }
    }

    /// Returns every rule with one threshold, in the order of [`Rule::ALL`].
    pub fn all(threshold: f64) -> [Self; Rule::ALL.len()] {
        Rule::ALL.map(|rule| Self::new(rule, threshold))
    }

    /// Applies the rule (paper section 4.3). Something unknown counts as a hazard, unless it is ignored: the calibrated
    /// rule adds its probability, and under the paper's rule it disagrees with every sample once it is likely. Evidence without
    /// samples, or with a probability outside 0..=1, always halts with confidence 0.
    pub fn decide(self, evidence: &Evidence) -> Decision {
        let (hazard, unknown) = (evidence.hazard_probability(), evidence.unknown_probability());
        let valid = |p: f64| (0.0..=1.0).contains(&p);
        if !valid(hazard) || !valid(unknown) || evidence.sample_count() == 0 {
            return Decision { halt: true, confidence: 0.0 };
        }
        match self.rule {
            Rule::Underconfident => Decision { halt: true, confidence: 1.0 },
            Rule::Overconfident => Decision { halt: false, confidence: 1.0 },
            Rule::Paper => {
                // Samples disagree when some show the hazard and some do not. A sample that shows no known state
                // disagrees with every other.
                let share = evidence.hazard_share();
                let halt = share > 0.0 || evidence.has_unknown() || is_likely(unknown) && !self.ignores_unknown;
                Decision { halt, confidence: if halt { share.max(1.0 - share) } else { 1.0 - share } }
            }
            Rule::Calibrated => {
                let p = if self.ignores_unknown { hazard } else { evidence.hazard_or_unknown_probability() };
                let halt = p >= self.threshold;
                Decision { halt, confidence: if halt { p } else { 1.0 - p } }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SampleEvidence;

    /// Evidence of one step: a hazard likelihood a sample, `None` for a sample that shows no known state.
    fn evidence(samples: &[Option<f32>], hazard_probability: f32) -> Evidence {
        let mut evidence = Evidence::NONE;
        let of = |s: &Option<f32>| SampleEvidence { is_known: s.is_some(), hazard_likelihood: s.unwrap_or(0.0) };
        evidence.add_step(1, hazard_probability, 1.0, samples.iter().map(of));
        evidence
    }

    /// The paper's rule advances only when no sample shows the hazard and none is unknown.
    #[test]
    fn paper_rule_halts_on_any_hazard() {
        let paper = Policy::new(Rule::Paper, 0.5);
        assert!(!paper.decide(&evidence(&[Some(0.0), Some(0.49)], 0.0)).halt);
        assert!(paper.decide(&evidence(&[Some(0.0), Some(0.5)], 0.1)).halt);
        assert!(paper.decide(&evidence(&[Some(0.0), None], 0.0)).halt);
    }

    /// Something unknown counts as a hazard under both rules that look at the belief.
    #[test]
    fn the_unknown_is_a_hazard() {
        let with = |unknown: f32| {
            let mut evidence = evidence(&[Some(0.0)], 0.1);
            evidence.add_unknown(unknown);
            Policy::all(0.25).map(|policy| policy.decide(&evidence).halt)
        };
        // In the order of `Rule::ALL`: always halt, always advance, the paper's, calibrated.
        assert_eq!(with(0.1), [true, false, false, false]);
        assert_eq!(with(0.2), [true, false, false, true]);
        assert_eq!(with(0.6), [true, false, true, true]);
        assert_eq!(with(f32::NAN), [true; 4]);
    }

    /// The calibrated rule halts at its threshold and above.
    #[test]
    fn calibrated_rule_uses_the_threshold() {
        let calibrated = Policy::new(Rule::Calibrated, 0.25);
        assert!(calibrated.decide(&evidence(&[Some(1.0)], 0.25)).halt);
        assert!(!calibrated.decide(&evidence(&[Some(1.0)], 0.24)).halt);
    }

    /// Every rule halts without samples, and on a probability outside 0..=1.
    #[test]
    fn no_evidence_halts() {
        for policy in Policy::all(0.5) {
            assert!(policy.decide(&Evidence::NONE).halt);
            assert!(policy.decide(&evidence(&[Some(0.0)], f32::NAN)).halt);
            assert!(policy.decide(&evidence(&[Some(0.0)], 1.5)).halt);
        }
    }
}
