//! Statistics of reports: percentiles, intervals, PSNR.
//!
//! ```
//! let [low, high] = carff_base::statistics::wilson_interval(97, 100);
//! assert!(low > 0.91 && high < 0.99);
//! ```

/// Returns the peak signal-to-noise ratio in dB of values in 0..=1, capped at 100; `None` without values, or for
/// different lengths.
pub fn psnr_db(image: &[f32], truth: &[f32]) -> Option<f64> {
    psnr_where(image, truth, |_| true)
}

/// Returns [`psnr_db`] over the values whose index `counts`; `None` if no value counts.
pub fn psnr_where(image: &[f32], truth: &[f32], counts: impl Fn(usize) -> bool) -> Option<f64> {
    if image.len() != truth.len() {
        return None;
    }
    let (mut sum, mut n) = (0.0_f64, 0_usize);
    for (i, (&a, &b)) in image.iter().zip(truth).enumerate() {
        if counts(i) {
            sum += f64::from(a - b).powi(2);
            n += 1;
        }
    }
    (n > 0).then(|| psnr_of_mse(sum / n as f64))
}

/// Returns the PSNR in dB for a mean squared error of values in 0..=1, capped at 100.
pub fn psnr_of_mse(mean_squared_error: f64) -> f64 {
    (-10.0 * mean_squared_error.max(1e-10).log10()).min(100.0)
}

/// Returns the 95 % Wilson score interval of a proportion, `[low, high]` in 0..=1; `[0, 1]` without trials.
pub fn wilson_interval(successes: usize, trials: usize) -> [f64; 2] {
    wilson_interval_of_share(successes as f64 / trials.max(1) as f64, trials as f64)
}

/// Returns the 95 % Wilson score interval of a share, 0..=1, that was found in `n` independent trials or groups of
/// trials; `[0, 1]` where `n` is 0.
pub fn wilson_interval_of_share(share: f64, n: f64) -> [f64; 2] {
    if n <= 0.0 {
        return [0.0, 1.0];
    }
    let z = 1.959_963_985_f64;
    let scale = 1.0 + z * z / n;
    let centre = (share + z * z / (2.0 * n)) / scale;
    let half = z / scale * (share * (1.0 - share) / n + z * z / (4.0 * n * n)).sqrt();
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

/// Returns the percentile of `values` by nearest rank, for a share `q` in 0..=1; `None` without values.
///
/// ```
/// assert_eq!(carff_base::statistics::percentile(&[3.0, 1.0, 2.0], 0.5), Some(2.0));
/// ```
pub fn percentile(values: &[f64], q: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    percentile_of_sorted(&sorted, q)
}

/// Returns the [`percentile`] of sorted values.
pub fn percentile_of_sorted(sorted: &[f64], q: f64) -> Option<f64> {
    let rank = (q.clamp(0.0, 1.0) * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied()
}

/// p50, p99 and maximum of some values.
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
    /// Returns the spread of `values`; `None` without values.
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

/// Returns the mean of `values`; `None` without values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A constant error of 0.1 is 20 dB; equal images reach the cap; different lengths have no PSNR.
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
