//! The evidence of one frame's steps, gathered the same way from messages and from the library's own steps.

use crate::{Probed, Step};
use carff_messages::{Belief, MAX_SAMPLES, ProbeResult};

/// A sample shows the hazard from this likelihood on.
const SHOWS_HAZARD: f32 = 0.5;

/// The evidence on which a rule decides: all steps of one frame's belief.
///
/// A sample shows the hazard when it does so at any step. It is unknown when it shows no known state at the first
/// step, the one that rests on the camera image.
///
/// ```
/// use carff_decision::{Evidence, Policy, SampleEvidence};
/// use carff_messages::Rule;
/// let sample = |hazard_likelihood| SampleEvidence { is_known: true, hazard_likelihood };
/// let mut evidence = Evidence::NONE;
/// evidence.add_step(1, 0.5, 1.0, [sample(0.99), sample(0.01)]);
/// assert!(Policy::new(Rule::Paper, 0.5).decide(&evidence).halt);
/// assert!(!Policy::new(Rule::Overconfident, 0.5).decide(&evidence).halt);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evidence {
    sample_count: usize,
    is_unknown: [bool; MAX_SAMPLES],
    shows_hazard: [bool; MAX_SAMPLES],
    hazard_probability: f64,
    unknown_probability: f64,
}

/// The part of one probed sample that rules look at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleEvidence {
    /// True if the sample shows a known state.
    pub is_known: bool,
    /// Probability that the sample's scene holds the hazard, 0..=1.
    pub hazard_likelihood: f32,
}

impl SampleEvidence {
    /// Reports whether the sample shows a hazard rather than none.
    fn shows_hazard(self) -> bool {
        self.hazard_likelihood >= SHOWS_HAZARD
    }
}

impl From<&ProbeResult> for SampleEvidence {
    fn from(result: &ProbeResult) -> Self {
        Self { is_known: result.state().is_some(), hazard_likelihood: result.hazard_likelihood }
    }
}

impl Probed {
    /// Reports whether the sample shows a hazard rather than none, as the paper's rule counts it.
    pub fn shows_hazard(&self) -> bool {
        SampleEvidence::from(self).shows_hazard()
    }
}

impl From<&Probed> for SampleEvidence {
    fn from(probed: &Probed) -> Self {
        let reading = &probed.reading;
        Self { is_known: reading.state.is_some(), hazard_likelihood: reading.hazard_likelihood }
    }
}

impl Evidence {
    /// Evidence of no step: every rule halts on it.
    pub const NONE: Self = Self {
        sample_count: 0,
        is_unknown: [false; MAX_SAMPLES],
        shows_hazard: [false; MAX_SAMPLES],
        hazard_probability: 0.0,
        unknown_probability: 0.0,
    };

    /// Returns the evidence of a frame's steps as the library computes them, the first step first.
    pub fn of_steps(steps: &[Step]) -> Self {
        let mut evidence = Self::NONE;
        for (index, step) in steps.iter().enumerate() {
            let samples = step.samples.iter().map(SampleEvidence::from);
            evidence.add_step(index as u32 + 1, step.resolved.hazard_probability, step.path_probability, samples);
            evidence.add_unknown(step.resolved.unknown_probability);
        }
        evidence
    }

    /// Adds the probability of something that no known state explains; the largest one counts. A value that is not a
    /// number makes every rule halt.
    pub fn add_unknown(&mut self, probability: f32) {
        let probability = f64::from(probability);
        if probability.is_nan() || probability > self.unknown_probability {
            self.unknown_probability = probability;
        }
    }

    /// Adds the step of a valid message.
    pub fn add_belief(&mut self, belief: &Belief) {
        let samples = belief.samples().iter().map(SampleEvidence::from);
        self.add_step(belief.header.step, belief.hazard_probability, belief.path_probability, samples);
        self.add_unknown(belief.unknown_probability);
    }

    /// Adds one step, counted from 1; steps may come in any order, and a step that comes twice counts once.
    ///
    /// The step's hazard probability counts times the probability of the path to it. The largest of these products is a
    /// lower bound on the probability that the hazard is met at any step. A product that is not a number makes every
    /// rule halt.
    pub fn add_step(
        &mut self,
        step: u32,
        hazard_probability: f32,
        path_probability: f32,
        samples: impl IntoIterator<Item = SampleEvidence>,
    ) {
        let met_probability = f64::from(path_probability) * f64::from(hazard_probability);
        if met_probability.is_nan() || met_probability > self.hazard_probability {
            self.hazard_probability = met_probability;
        }
        let flags = self.is_unknown.iter_mut().zip(&mut self.shows_hazard);
        let mut count = 0;
        for (sample, (is_unknown, shows_hazard)) in samples.into_iter().zip(flags) {
            *shows_hazard |= sample.shows_hazard();
            *is_unknown |= step == 1 && !sample.is_known;
            count += 1;
        }
        if step == 1 {
            self.sample_count = count;
        }
    }

    /// Samples of the first step.
    pub fn sample_count(&self) -> usize {
        self.sample_count
    }

    /// Lower bound on the probability that the hazard is met at any step, 0..=1; not a number for invalid steps.
    pub fn hazard_probability(&self) -> f64 {
        self.hazard_probability
    }

    /// Probability that something is there which no known state explains, 0..=1; not a number for invalid steps.
    pub fn unknown_probability(&self) -> f64 {
        self.unknown_probability
    }

    /// Probability of a hazard, or of something that no known state explains, 0..=1: what the calibrated rule compares
    /// with its threshold. Not a number for invalid steps.
    pub fn hazard_or_unknown_probability(&self) -> f64 {
        let sum = self.hazard_probability + self.unknown_probability;
        if sum.is_nan() { sum } else { sum.min(1.0) }
    }

    /// Share of the samples that show the hazard at any step, 0..=1; not a number without samples.
    pub fn hazard_share(&self) -> f64 {
        let samples = &self.shows_hazard[..self.sample_count];
        samples.iter().filter(|&&shows| shows).count() as f64 / samples.len() as f64
    }

    /// Reports whether any sample shows no known state.
    pub fn has_unknown(&self) -> bool {
        self.is_unknown[..self.sample_count].contains(&true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(likelihoods: &[f32]) -> Vec<SampleEvidence> {
        likelihoods.iter().map(|&hazard_likelihood| SampleEvidence { is_known: true, hazard_likelihood }).collect()
    }

    /// A sample that shows the hazard at a later step counts, and the largest product of path and hazard is kept.
    #[test]
    fn all_steps_count() {
        let mut evidence = Evidence::NONE;
        evidence.add_step(1, 0.1, 1.0, samples(&[0.0, 0.2]));
        evidence.add_step(2, 0.9, 0.5, samples(&[0.5, 0.2]));
        assert_eq!((evidence.sample_count(), evidence.hazard_share()), (2, 0.5));
        assert_eq!(evidence.hazard_probability(), 0.5 * f64::from(0.9_f32));
    }

    /// The order of the steps, and a step that comes twice, change nothing.
    #[test]
    fn order_and_repetition_change_nothing() {
        let steps = [(1, 0.3, 1.0, samples(&[0.0, 0.6])), (2, 0.9, 0.5, samples(&[0.7, 0.0, 0.9]))];
        let of = |order: &[usize]| {
            let mut evidence = Evidence::NONE;
            for &i in order {
                let (step, hazard, path, samples) = steps[i].clone();
                evidence.add_step(step, hazard, path, samples);
            }
            evidence
        };
        assert_eq!(of(&[0, 1]), of(&[1, 0]));
        assert_eq!(of(&[0, 1]), of(&[0, 1, 1, 0]));
        assert_eq!(of(&[0, 1]).sample_count(), 2, "samples of a later step that the first has not do not count");
    }

    /// Only the first step, which rests on the image, makes a sample unknown.
    #[test]
    fn unknown_at_the_first_step() {
        let unknown = SampleEvidence { is_known: false, hazard_likelihood: 0.0 };
        let mut evidence = Evidence::NONE;
        evidence.add_step(1, 0.0, 1.0, samples(&[0.0]));
        evidence.add_step(2, 0.0, 1.0, [unknown]);
        assert!(!evidence.has_unknown());
        evidence.add_step(1, 0.0, 1.0, [unknown]);
        assert!(evidence.has_unknown());
    }

    /// A probability that is not a number is kept, for any values of the other steps.
    #[test]
    fn invalid_probabilities_are_kept() {
        let mut evidence = Evidence::NONE;
        evidence.add_step(1, f32::NAN, 1.0, samples(&[0.0]));
        evidence.add_step(2, 0.9, 1.0, samples(&[0.0]));
        assert!(evidence.hazard_probability().is_nan());
    }
}
