//! Statistics of drawn and probed samples: accuracy and recall against their number (paper figure of section 4.2), and
//! frequencies of outcomes that the image leaves open.

use carff_base::statistics::{percentile, wilson_interval};
use serde::{Deserialize, Serialize};

/// Known states that one sample shows, as bits: none, one, or several indistinguishable states.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shown(u64);

impl Shown {
    /// No known state.
    pub const NOTHING: Self = Self(0);

    /// States of a reading: its state, and states with the same probability.
    pub fn of(reading: &carff_decision::Reading) -> Self {
        let Some(named) = reading.state else { return Self::NOTHING };
        let most = reading.state_probabilities.get(named).copied().unwrap_or(1.0);
        let ties = reading.state_probabilities.iter().enumerate().filter(|(_, p)| **p >= 0.999 * most);
        Self::from_states(ties.map(|(state, _)| state))
    }

    /// The given states; states from 64 on are ignored.
    pub fn from_states(states: impl IntoIterator<Item = usize>) -> Self {
        Self(states.into_iter().filter(|s| *s < 64).fold(0, |bits, s| bits | 1 << s))
    }

    /// The states.
    pub fn states(self) -> impl Iterator<Item = usize> {
        (0..64).filter(move |s| self.0 >> s & 1 == 1)
    }

    /// Returns true if any of the states satisfies a condition.
    pub fn any(self, satisfies: impl FnMut(usize) -> bool) -> bool {
        self.states().any(satisfies)
    }
}

/// Values of one trial for n = 1, 2, ... samples.
#[derive(Clone, Debug, PartialEq)]
pub struct TrialCurve {
    /// Number of the image: trials of one image are not independent.
    pub image: usize,
    /// Value for n samples at index n - 1, 0..=1.
    pub values: Vec<f64>,
}

/// A curve over n = 1, 2, ...
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Mean over the trials, at index n - 1; 0..=1.
    pub mean: Vec<f64>,
    /// Band about the mean, `[low, high]`: 10 to 90 % of the images for an accuracy, the 95 % Wilson interval for a
    /// recall.
    pub band: Vec<[f64; 2]>,
    /// Trials.
    pub trials: usize,
    /// Images of the trials.
    pub images: usize,
}

impl Curve {
    /// Value for `n` samples; `None` where it was not measured.
    pub fn at(&self, n: usize) -> Option<f64> {
        self.mean.get(n.checked_sub(1)?).copied()
    }
}

/// Mean accuracy, with the band that holds 80 % of the images.
pub fn accuracy_curve(trials: &[TrialCurve]) -> Curve {
    let mut curve = means(trials);
    let mut by_image = std::collections::BTreeMap::<usize, Vec<&TrialCurve>>::new();
    for trial in trials {
        by_image.entry(trial.image).or_default().push(trial);
    }
    curve.band = (0..curve.mean.len())
        .map(|i| {
            let of = |t: &Vec<&TrialCurve>| t.iter().map(|t| t.values[i]).sum::<f64>() / t.len() as f64;
            let means: Vec<f64> = by_image.values().map(of).collect();
            [0.1, 0.9].map(|q| percentile(&means, q).unwrap_or(0.0))
        })
        .collect();
    curve
}

/// Share of trials with the value 1, with its 95 % interval. Values are 0 or 1.
pub fn recall_curve(trials: &[TrialCurve]) -> Curve {
    let mut curve = means(trials);
    let n = trials.len();
    curve.band = curve.mean.iter().map(|m| wilson_interval((m * n as f64).round() as usize, n)).collect();
    curve
}

fn means(trials: &[TrialCurve]) -> Curve {
    let counts = trials.iter().map(|t| t.values.len()).min().unwrap_or(0);
    let mean = |i: usize| trials.iter().map(|t| t.values[i]).sum::<f64>() / trials.len() as f64;
    let mut images: Vec<usize> = trials.iter().map(|t| t.image).collect();
    images.sort_unstable();
    images.dedup();
    Curve { mean: (0..counts).map(mean).collect(), band: Vec::new(), trials: trials.len(), images: images.len() }
}

/// Share of correct samples among the first n, for each n.
pub fn right_shares(right: impl IntoIterator<Item = bool>) -> Vec<f64> {
    let (mut n, mut hits) = (0.0, 0.0);
    right
        .into_iter()
        .map(|r| {
            n += 1.0;
            hits += f64::from(r);
            hits / n
        })
        .collect()
}

/// Returns 1 from the first sample with which all `wanted` bits were met, and 0 before. `met[i]` has the bits of sample
/// i.
pub fn met_all(met: impl IntoIterator<Item = u64>, wanted: u64) -> Vec<f64> {
    let mut seen = 0;
    met.into_iter()
        .map(|bits| {
            seen |= bits;
            f64::from(seen & wanted == wanted)
        })
        .collect()
}

/// Expected recall of n independent draws, and the band that holds 95 % of measurements. The true outcome of each trial
/// has its share `probabilities` of the belief (two equally open outcomes: 1 - 0.5^n). 0 for no trials.
///
/// ```
/// assert_eq!(carff_evaluation::expected_recall(2, &[0.5; 100]).0, 0.75);
/// ```
pub fn expected_recall(n: usize, probabilities: &[f64]) -> (f64, [f64; 2]) {
    let trials = probabilities.len().max(1) as f64;
    let met = || probabilities.iter().map(|p| 1.0 - (1.0 - p).powi(n as i32));
    let mean = met().sum::<f64>() / trials;
    let variance = met().map(|m| m * (1.0 - m)).sum::<f64>() / trials.powi(2);
    // Half a trial more on both sides, since a share of trials is discrete.
    let half = 1.96 * variance.sqrt() + 0.5 / trials;
    (mean, [(mean - half).max(0.0), (mean + half).min(1.0)])
}

/// An input whose image leaves several outcomes open.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenInput {
    /// Probability of each outcome, given the image; 0 for an outcome that is not open.
    pub expected: Vec<f64>,
    /// Samples that showed each outcome; a sample of several outcomes counts in parts.
    pub drawn: Vec<f64>,
    /// All samples, including those that show no known state.
    pub samples: usize,
}

/// Frequency of one outcome.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frequency {
    /// The outcome.
    pub outcome: String,
    /// Probability of the outcome, given the images, 0..=1.
    pub expected: f64,
    /// Share of the samples, 0..=1.
    pub drawn: f64,
    /// 95 % interval of the share, from its spread among the images; 0..=1 for a single image.
    pub interval: [f64; 2],
}

/// Frequencies over the images that leave the same outcomes open with the same probabilities.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frequencies {
    /// Open outcomes, in the order of their numbers.
    pub outcomes: Vec<Frequency>,
    /// Share of samples that show no known state, 0..=1.
    pub unknown: f64,
    /// Share of samples that show an outcome that was not open, 0..=1.
    pub ruled_out: f64,
    /// Images.
    pub images: usize,
    /// Samples of all images.
    pub samples: usize,
}

/// Frequencies of inputs, grouped by their open outcomes. Groups with one open outcome are left out.
pub fn frequencies(inputs: &[OpenInput], names: &[String]) -> Vec<Frequencies> {
    let mut groups: Vec<(&[f64], Vec<&OpenInput>)> = Vec::new();
    for input in inputs {
        if input.expected.iter().filter(|e| **e > 0.0).count() < 2 || input.samples == 0 {
            continue;
        }
        let alike = |g: &&[f64]| g.iter().zip(&input.expected).all(|(a, b)| (a - b).abs() < 1e-9);
        match groups.iter_mut().find(|(g, _)| alike(g)) {
            Some((_, members)) => members.push(input),
            None => groups.push((&input.expected, vec![input])),
        }
    }
    groups.sort_by_key(|(_, members)| std::cmp::Reverse(members.len()));
    groups.into_iter().map(|(expected, members)| frequencies_of(expected, &members, names)).collect()
}

fn frequencies_of(expected: &[f64], members: &[&OpenInput], names: &[String]) -> Frequencies {
    let samples: usize = members.iter().map(|m| m.samples).sum();
    let total = |outcome: usize| members.iter().map(|m| m.drawn[outcome]).sum::<f64>() / samples as f64;
    let outcomes = (0..expected.len())
        .filter(|&o| expected[o] > 0.0)
        .map(|o| {
            let shares: Vec<f64> = members.iter().map(|m| m.drawn[o] / m.samples as f64).collect();
            Frequency {
                outcome: names.get(o).cloned().unwrap_or_else(|| o.to_string()),
                expected: expected[o],
                drawn: total(o),
                interval: interval_of_mean(&shares),
            }
        })
        .collect();
    let known: f64 = (0..expected.len()).map(total).sum();
    let ruled_out: f64 = (0..expected.len()).filter(|&o| expected[o] <= 0.0).map(total).sum();
    Frequencies { outcomes, unknown: (1.0 - known).max(0.0), ruled_out, images: members.len(), samples }
}

/// 95 % interval of the mean of shares, clamped to 0..=1.
fn interval_of_mean(shares: &[f64]) -> [f64; 2] {
    let n = shares.len() as f64;
    if n < 2.0 {
        return [0.0, 1.0];
    }
    let mean = shares.iter().sum::<f64>() / n;
    let variance = shares.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / (n - 1.0);
    let half = 1.96 * (variance / n).sqrt();
    [(mean - half).max(0.0), (mean + half).min(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Correct, wrong, correct, correct: shares 1, 1/2, 2/3, 3/4. Two wanted bits, met by the first and the third
    /// sample, are met from the third sample on; other bits do not count.
    #[test]
    fn counted_samples() {
        assert_eq!(right_shares([true, false, true, true]), [1.0, 0.5, 2.0 / 3.0, 0.75]);
        assert_eq!(met_all([0b001, 0b001, 0b110, 0b000], 0b011), [0.0, 0.0, 1.0, 1.0]);
        assert_eq!(met_all([0b100; 3], 0b001), [0.0; 3]);
    }

    /// Curves are means over trials. The band of an accuracy is over images, that of a recall is Wilson's interval.
    /// Without trials there is no curve.
    #[test]
    fn curves_of_counted_trials() {
        let trial = |image, values: [f64; 2]| TrialCurve { image, values: values.to_vec() };
        let trials = [trial(1, [1.0, 0.0]), trial(1, [0.0, 0.0]), trial(2, [1.0, 1.0]), trial(3, [1.0, 1.0])];
        let accuracy = accuracy_curve(&trials);
        assert_eq!((accuracy.mean.as_slice(), accuracy.trials, accuracy.images), ([0.75, 0.5].as_slice(), 4, 3));
        assert_eq!(accuracy.band, [[0.5, 1.0], [0.0, 1.0]]);
        let recall = recall_curve(&trials);
        assert_eq!(recall.band[1], wilson_interval(2, 4));
        assert_eq!((recall.at(2), recall.at(0), recall.at(3)), (Some(0.5), None, None));
        assert_eq!(recall_curve(&[]), Curve::default());
    }

    /// Draws from an even mixture follow the expected curve, within the band for most n (errors of a curve are
    /// correlated); draws from an uneven mixture do not.
    #[test]
    fn even_draws_lie_on_the_even_curve() {
        let recall = |probability: f64| {
            let trials: Vec<TrialCurve> = (0..2000_u64)
                .map(|frame| {
                    let met = (0..8).map(|sample| {
                        let key = carff_base::random::Key { seed: 1, frame, step: 0, sample };
                        u64::from(carff_base::random::uniform(key) < probability)
                    });
                    TrialCurve { image: frame as usize, values: met_all(met, 1) }
                })
                .collect();
            recall_curve(&trials)
        };
        let within = |curve: &Curve| {
            (1..=8)
                .filter(|&n| {
                    let (_, [low, high]) = expected_recall(n, &vec![0.5; curve.trials]);
                    (low..=high).contains(&curve.mean[n - 1])
                })
                .count()
        };
        assert!(within(&recall(0.5)) >= 5, "{:?}", recall(0.5).mean);
        assert!(within(&recall(0.4)) <= 2, "{:?}", recall(0.4).mean);
        assert_eq!(expected_recall(2, &[0.5; 100]).0, 0.75);
        assert_eq!(expected_recall(1, &[0.25, 0.75]).0, 0.5);
        assert_eq!(expected_recall(3, &[]).0, 0.0);
    }

    /// Inputs are grouped by open outcomes. Shares, unknown and ruled-out samples add up to one. A certain input is
    /// left out.
    #[test]
    fn frequencies_of_counted_draws() {
        let input = |expected: [f64; 3], drawn: [f64; 3]| OpenInput {
            expected: expected.to_vec(),
            drawn: drawn.to_vec(),
            samples: 10,
        };
        let names = ["left", "right", "absent"].map(str::to_owned);
        let inputs = [
            input([0.5, 0.5, 0.0], [4.0, 5.0, 1.0]),
            input([0.5, 0.5, 0.0], [6.0, 3.0, 0.0]),
            input([0.25, 0.25, 0.5], [2.0, 3.0, 5.0]),
            input([1.0, 0.0, 0.0], [10.0, 0.0, 0.0]),
        ];
        let found = frequencies(&inputs, &names);
        assert_eq!(found.len(), 2);
        let first = &found[0];
        assert_eq!((first.images, first.samples, first.outcomes.len()), (2, 20, 2));
        assert!((first.outcomes[0].drawn - 0.5).abs() < 1e-12 && (first.outcomes[1].drawn - 0.4).abs() < 1e-12);
        assert!((first.ruled_out - 0.05).abs() < 1e-12 && (first.unknown - 0.05).abs() < 1e-12);
        let [low, high] = first.outcomes[0].interval;
        assert!(((high - low) / 2.0 - 1.96 * 0.1).abs() < 1e-9, "{low} {high}");
        assert_eq!(found[1].outcomes[2].outcome, "absent");
        assert_eq!(found[1].outcomes[2].interval, [0.0, 1.0]);
    }

    /// A sample shows its state and states with the same probability; a reading without a state shows nothing.
    #[test]
    fn ties_are_shown_together() {
        let reading = |state, p: [f32; 3]| carff_decision::Reading {
            state,
            confidence: 0.5,
            hazard_likelihood: 0.0,
            state_probabilities: p.to_vec(),
        };
        assert_eq!(Shown::of(&reading(Some(0), [0.45, 0.1, 0.45])).states().collect::<Vec<_>>(), [0, 2]);
        assert_eq!(Shown::of(&reading(Some(1), [0.2, 0.6, 0.2])).states().collect::<Vec<_>>(), [1]);
        assert_eq!(Shown::of(&reading(None, [0.4, 0.3, 0.3])), Shown::NOTHING);
    }
}
