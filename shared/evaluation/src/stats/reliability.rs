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

/// Reliability of forecasts: pairs of a probability in 0..=1 and whether the event happened.
///
/// ```
/// let forecasts: Vec<(f64, bool)> = (0..100).map(|i| (0.25, i % 4 == 0)).collect();
/// assert!(carff_evaluation::reliability(&forecasts, 10).expected_calibration_error < 1e-12);
/// ```
pub fn reliability(forecasts: &[(f64, bool)], bins: usize) -> Reliability {
    let mut sums = vec![(0_usize, 0.0_f64, 0_usize); bins.max(1)];
    for &(probability, happened) in forecasts {
        let last = sums.len() - 1;
        let bin = &mut sums[((probability.clamp(0.0, 1.0) * bins as f64) as usize).min(last)];
        bin.0 += 1;
        bin.1 += probability;
        bin.2 += usize::from(happened);
    }
    let bins: Vec<ReliabilityBin> = sums
        .into_iter()
        .filter(|(trials, _, _)| *trials > 0)
        .map(|(trials, sum, happened)| ReliabilityBin {
            trials,
            forecast: sum / trials as f64,
            happened: happened as f64 / trials as f64,
            interval: wilson_interval(happened, trials),
        })
        .collect();
    let distance = |b: &ReliabilityBin| b.trials as f64 * (b.forecast - b.happened).abs();
    let expected_calibration_error = bins.iter().map(distance).sum::<f64>() / forecasts.len().max(1) as f64;
    Reliability { expected_calibration_error, trials: forecasts.len(), bins }
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
