//! Figures that reports print: percentiles, intervals, picture quality.
//!
//! ```
//! let [low, high] = carff_metrics::wilson_interval(97, 100);
//! assert!(low > 0.91 && high < 0.99);
//! ```

/// Peak signal-to-noise ratio in dB of values in 0..=1, capped at 100; `None` for no or unequally many values.
pub fn psnr_db(picture: &[f32], truth: &[f32]) -> Option<f64> {
    psnr_where(picture, truth, |_| true)
}

/// [`psnr_db`] over the values whose index `counts`; `None` when there is none.
pub fn psnr_where(picture: &[f32], truth: &[f32], counts: impl Fn(usize) -> bool) -> Option<f64> {
    if picture.len() != truth.len() {
        return None;
    }
    let (mut sum, mut n) = (0.0_f64, 0_usize);
    for (i, (&a, &b)) in picture.iter().zip(truth).enumerate() {
        if counts(i) {
            sum += f64::from(a - b).powi(2);
            n += 1;
        }
    }
    (n > 0).then(|| psnr_of_mse(sum / n as f64))
}

/// PSNR in dB for a mean squared error of values in 0..=1, capped at 100.
pub fn psnr_of_mse(mean_squared_error: f64) -> f64 {
    (-10.0 * mean_squared_error.max(1e-10).log10()).min(100.0)
}

/// The 95 % Wilson score interval of a proportion, `[low, high]` in 0..=1; `[0, 1]` for no trials.
pub fn wilson_interval(successes: usize, trials: usize) -> [f64; 2] {
    if trials == 0 {
        return [0.0, 1.0];
    }
    let z = 1.959_963_985_f64;
    let n = trials as f64;
    let p = successes as f64 / n;
    let scale = 1.0 + z * z / n;
    let centre = (p + z * z / (2.0 * n)) / scale;
    let half = z / scale * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

/// The value below which a share `q` (0..=1) of `values` lies (nearest rank); `None` for no values.
pub fn percentile(values: &[f64], q: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    percentile_of_sorted(&sorted, q)
}

/// [`percentile`] of values that are sorted already.
pub fn percentile_of_sorted(sorted: &[f64], q: f64) -> Option<f64> {
    let rank = (q.clamp(0.0, 1.0) * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied()
}

/// p50, p99 and the maximum of a set of values.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Largest value.
    pub max: f64,
}

impl Spread {
    /// The spread of `values`; `None` for none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        Some(Self {
            p50: percentile_of_sorted(&sorted, 0.5)?,
            p99: percentile_of_sorted(&sorted, 0.99)?,
            max: *sorted.last()?,
        })
    }
}

/// Mean of `values`; `None` for none.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Half the side of a window of [`ssim`], pixels, and the deviation of its Gaussian weights.
const SSIM_REACH: usize = 5;
const SSIM_SIGMA: f64 = 1.5;

/// Structural similarity (Wang et al. 2004) of pictures in 0..=1, RGB side by side, rows of `width_px` pixels: mean over
/// all 11x11 windows that lie in the picture, and over the channels; -1..=1. `None` for sizes that differ or are smaller
/// than a window.
pub fn ssim(picture: &[f32], truth: &[f32], width_px: usize) -> Option<f64> {
    let side = 2 * SSIM_REACH + 1;
    let rows = picture.len() / (3 * width_px.max(1));
    if picture.len() != truth.len() || rows * width_px * 3 != picture.len() || rows < side || width_px < side {
        return None;
    }
    let weights: Vec<f64> =
        (0..side).map(|i| (-(i as f64 - SSIM_REACH as f64).powi(2) / (2.0 * SSIM_SIGMA.powi(2))).exp()).collect();
    let total: f64 = weights.iter().sum();
    let blurred = |value: &dyn Fn(usize) -> f64| -> Vec<f64> {
        let across: Vec<f64> = (0..rows)
            .flat_map(|y| (0..=width_px - side).map(move |x| y * width_px + x))
            .map(|first| weights.iter().enumerate().map(|(i, w)| w * value(first + i)).sum::<f64>() / total)
            .collect();
        let width = width_px - side + 1;
        (0..(rows - side + 1) * width)
            .map(|at| weights.iter().enumerate().map(|(i, w)| w * across[at + i * width]).sum::<f64>() / total)
            .collect()
    };
    let [c1, c2] = [0.01_f64.powi(2), 0.03_f64.powi(2)];
    let (mut sum, mut count) = (0.0, 0_usize);
    for channel in 0..3 {
        let a = |pixel: usize| f64::from(picture[pixel * 3 + channel]);
        let b = |pixel: usize| f64::from(truth[pixel * 3 + channel]);
        let (mean_a, mean_b) = (blurred(&a), blurred(&b));
        let (aa, bb) = (blurred(&|i| a(i) * a(i)), blurred(&|i| b(i) * b(i)));
        let ab = blurred(&|i| a(i) * b(i));
        for i in 0..ab.len() {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (va, vb, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
            sum += (2.0 * ma * mb + c1) * (2.0 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
        }
        count += ab.len();
    }
    Some(sum / count as f64)
}

/// Forecasts of one bin of a reliability diagram.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ReliabilityBin {
    /// Forecasts in it.
    pub trials: usize,
    /// Their mean, 0..=1.
    pub forecast: f64,
    /// Share of them in which it happened, 0..=1.
    pub happened: f64,
    /// 95 % Wilson interval of that share.
    pub interval: [f64; 2],
}

/// How far forecast probabilities are from what happened.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Reliability {
    /// Mean distance between forecast and share over the bins, weighted by their trials, 0..=1; 0 for no trials.
    pub expected_calibration_error: f64,
    /// Forecasts.
    pub trials: usize,
    /// Equally wide bins from 0 to 1 that hold any forecast.
    pub bins: Vec<ReliabilityBin>,
}

/// Reliability of forecasts: each a probability in 0..=1, and whether it happened.
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

    /// A constant error of 0.1 is 20 dB; equal pictures reach the cap; unequal lengths have no PSNR.
    #[test]
    fn psnr_is_the_textbook_one() {
        assert!((psnr_db(&[0.1; 12], &[0.2; 12]).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr_db(&[0.3; 3], &[0.3; 3]), Some(100.0));
        assert_eq!(psnr_db(&[0.3; 3], &[0.3; 4]), None);
        let masked = psnr_where(&[0.0, 0.5], &[1.0, 0.6], |i| i == 1).unwrap();
        assert!((masked - 20.0).abs() < 1e-5);
    }

    /// Published values of the Wilson interval, and its limits.
    #[test]
    fn wilson_matches_known_values() {
        let [low, high] = wilson_interval(30, 30);
        assert!((low - 0.8865).abs() < 1e-3 && high > 0.999, "{low} {high}");
        let [low, high] = wilson_interval(5, 10);
        assert!((low - 0.2366).abs() < 1e-3 && (high - 0.7634).abs() < 1e-3);
        assert_eq!(wilson_interval(0, 0), [0.0, 1.0]);
    }

    /// Equal pictures have 1; of two even ones only their brightness counts, which is the closed form; noise has less
    /// than a small shift; a picture smaller than a window, or sizes that differ, have none.
    #[test]
    fn ssim_is_the_textbook_one() {
        let noise = |seed: usize| -> Vec<f32> {
            (0..20 * 16 * 3).map(|i| ((i * 7919 + seed * 104_729) % 1009) as f32 / 1009.0).collect()
        };
        assert!((ssim(&noise(1), &noise(1), 20).unwrap() - 1.0).abs() < 1e-9);
        let even = |v: f32| vec![v; 20 * 16 * 3];
        let (a, b) = (f64::from(0.2_f32), f64::from(0.6_f32));
        let closed = (2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4);
        assert!((ssim(&even(0.2), &even(0.6), 20).unwrap() - closed).abs() < 1e-6);
        let lighter: Vec<f32> = noise(1).iter().map(|v| v + 0.05).collect();
        assert!(ssim(&noise(1), &lighter, 20).unwrap() > ssim(&noise(1), &noise(2), 20).unwrap() + 0.3);
        assert_eq!(ssim(&even(0.2)[..20 * 10 * 3], &even(0.2)[..20 * 10 * 3], 20), None);
        assert_eq!(ssim(&even(0.2), &even(0.2)[..60], 20), None);
    }

    /// Forecasts that happen as often as they say have no error; one that always says 0.9 and is right half the time has
    /// 0.4; the ends 0 and 1 have their bins; no forecasts have none.
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

    /// Nearest-rank percentiles.
    #[test]
    fn percentiles_are_nearest_rank() {
        let values: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        let spread = Spread::of(&values).unwrap();
        assert_eq!((spread.p50, spread.p99, spread.max), (50.0, 99.0, 100.0));
        assert_eq!(percentile(&[], 0.5), None);
        assert_eq!(percentile(&[7.0], 0.99), Some(7.0));
    }
}
