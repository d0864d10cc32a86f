//! Reliability of forecast probabilities.

use carff_base::statistics::wilson_interval;
use serde::{Deserialize, Serialize};

/// Forecasts of one bin of a reliability diagram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReliabilityBin {
    /// Forecasts in the bin.
    pub trials: usize,
    /// Mean of the forecasts, 0..=1.
    pub forecast: f64,
    /// Share of the forecasts in which the event happened, 0..=1.
    pub happened: f64,
    /// 95 % Wilson interval of the share.
    pub interval: [f64; 2],
}

/// Agreement of forecast probabilities with events.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reliability {
    /// Mean distance between forecast and share over the bins, weighted by their trials, 0..=1; 0 for no trials.
    pub expected_calibration_error: f64,
    /// Forecasts.
    pub trials: usize,
    /// Non-empty bins of equal width from 0 to 1.
    pub bins: Vec<ReliabilityBin>,
}

/// Sums over forecasts, from which their reliability follows.
///
/// ```
/// let mut sums = carff_trials::ReliabilitySums::new(10);
/// for trial in 0..100 {
///     sums.add(0.25, trial % 4 == 0);
/// }
/// assert!(sums.reliability().expected_calibration_error < 1e-12);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct ReliabilitySums {
    /// For each bin: forecasts, their sum, and events.
    bins: Vec<(usize, f64, usize)>,
}

impl ReliabilitySums {
    /// Returns sums of no forecasts, with bins of equal width from 0 to 1.
    pub fn new(bins: usize) -> Self {
        Self { bins: vec![(0, 0.0, 0); bins.max(1)] }
    }

    /// Adds a forecast of 0..=1, and whether the event happened.
    pub fn add(&mut self, probability: f64, happened: bool) {
        let count = self.bins.len();
        let bin = &mut self.bins[((probability.clamp(0.0, 1.0) * count as f64) as usize).min(count - 1)];
        bin.0 += 1;
        bin.1 += probability;
        bin.2 += usize::from(happened);
    }

    /// Returns the reliability of the added forecasts.
    pub fn reliability(&self) -> Reliability {
        let of_bin = |&(trials, sum, happened): &(usize, f64, usize)| ReliabilityBin {
            trials,
            forecast: sum / trials as f64,
            happened: happened as f64 / trials as f64,
            interval: wilson_interval(happened, trials),
        };
        let bins: Vec<ReliabilityBin> = self.bins.iter().filter(|(trials, ..)| *trials > 0).map(of_bin).collect();
        let trials = bins.iter().map(|bin| bin.trials).sum::<usize>();
        let distance = |b: &ReliabilityBin| b.trials as f64 * (b.forecast - b.happened).abs();
        let expected_calibration_error = bins.iter().map(distance).sum::<f64>() / trials.max(1) as f64;
        Reliability { expected_calibration_error, trials, bins }
    }
}

/// Number of bins of a reliability diagram and of its calibration error.
pub const RELIABILITY_BINS: usize = 10;

/// Returns the reliability of forecasts: pairs of a probability in 0..=1 and whether the event happened.
///
/// ```
/// let forecasts: Vec<(f64, bool)> = (0..100).map(|i| (0.25, i % 4 == 0)).collect();
/// assert!(carff_trials::reliability(&forecasts, 10).expected_calibration_error < 1e-12);
/// ```
pub fn reliability(forecasts: &[(f64, bool)], bins: usize) -> Reliability {
    let mut sums = ReliabilitySums::new(bins);
    for &(probability, happened) in forecasts {
        sums.add(probability, happened);
    }
    sums.reliability()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Calibrated forecasts have no error; a forecast of 0.9 for an even event has an error of 0.4; the ends 0 and 1
    /// have their bins; no forecasts have no error.
    #[test]
    fn calibration_error_of_known_forecasts() {
        let calibrated: Vec<(f64, bool)> =
            (0..100).map(|i| (0.25, i % 4 == 0)).chain((0..10).map(|_| (1.0, true))).collect();
        let found = reliability(&calibrated, 10);
        assert!(found.expected_calibration_error < 1e-12 && found.bins.len() == 2 && found.trials == 110);
        let sure: Vec<(f64, bool)> = (0..100).map(|i| (0.9, i % 2 == 0)).collect();
        let found = reliability(&sure, 10);
        assert!((found.expected_calibration_error - 0.4).abs() < 1e-12, "{found:?}");
        assert!((found.bins[0].happened - 0.5).abs() < 1e-12 && found.bins[0].interval[1] < 0.61);
        assert_eq!(reliability(&[], 10).expected_calibration_error, 0.0);
    }
}
