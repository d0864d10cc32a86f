//! Quantiles, ratios of medians, and alternating measurements.

use carff_base::statistics::percentile_of_sorted;
use std::time::Instant;

/// Sorted times of one variant.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Times {
    sorted: Vec<f64>,
}

impl Times {
    /// Takes times in any order; those that are not finite are left out.
    pub fn new(mut times: Vec<f64>) -> Self {
        times.retain(|t| t.is_finite());
        times.sort_by(f64::total_cmp);
        Self { sorted: times }
    }

    /// Returns the smallest time that a share (0..=1) of all times does not exceed; NaN without times.
    pub fn quantile(&self, share: f64) -> f64 {
        percentile_of_sorted(&self.sorted, share).unwrap_or(f64::NAN)
    }

    /// Returns the median; NaN without times.
    pub fn median(&self) -> f64 {
        self.quantile(0.5)
    }

    /// Returns the number of times.
    pub fn count(&self) -> usize {
        self.sorted.len()
    }
}

/// Ratio of two alternately measured times: that of the medians, and the quartiles of the ratios of turns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ratio {
    /// Ratio of the medians.
    pub of_medians: f64,
    /// Lower quartile of the ratios of turns.
    pub low: f64,
    /// Upper quartile of the ratios of turns.
    pub high: f64,
}

impl Ratio {
    /// Compares `slow` with `fast`, both in the order of their turns.
    pub fn new(slow: &[f64], fast: &[f64]) -> Self {
        let turns = Times::new(slow.iter().zip(fast).map(|(s, f)| s / f).collect());
        Self {
            of_medians: Times::new(slow.to_vec()).median() / Times::new(fast.to_vec()).median(),
            low: turns.quantile(0.25),
            high: turns.quantile(0.75),
        }
    }
}

impl std::fmt::Display for Ratio {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.2}x ({:.2} to {:.2})", self.of_medians, self.low, self.high)
    }
}

/// A variant to measure: it returns its time, seconds.
pub type Contender<'a> = Box<dyn FnMut() -> f64 + 'a>;

/// Returns a variant that times an action.
pub fn timed<'a>(mut action: impl FnMut() + 'a) -> Contender<'a> {
    Box::new(move || {
        let start = Instant::now();
        action();
        start.elapsed().as_secs_f64()
    })
}

/// Total time after which a variant gets no more turns, seconds: a slow one needs only a few.
const PATIENCE_S: f64 = 12.0;

/// Measures all variants alternately for `rounds` rounds, after a warm-up round. Every second round runs backwards, so
/// that no variant always follows the same one. A slow variant takes part in the first rounds only, at least in one.
/// Returns the seconds of each variant, in the order of its turns.
pub fn alternate(rounds: usize, contenders: &mut [Contender<'_>]) -> Vec<Vec<f64>> {
    let mut seconds = vec![Vec::with_capacity(rounds); contenders.len()];
    let own_rounds: Vec<usize> =
        contenders.iter_mut().map(|c| ((PATIENCE_S / c()) as usize).clamp(1, rounds.max(1))).collect();
    for round in 0..rounds.max(1) {
        for i in 0..contenders.len() {
            let i = if round % 2 == 0 { i } else { contenders.len() - 1 - i };
            if round < own_rounds[i] {
                seconds[i].push(contenders[i]());
            }
        }
    }
    seconds
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Quantiles are measured times: of a thousand, p99 is the 990th, p99.9 the 999th, the last the maximum.
    #[test]
    fn quantiles_are_exact() {
        let times = Times::new((1..=1000).rev().map(f64::from).collect());
        assert_eq!([0.5, 0.99, 0.999, 1.0].map(|q| times.quantile(q)), [500.0, 990.0, 999.0, 1000.0]);
        assert_eq!((times.median(), times.count()), (500.0, 1000));
        assert_eq!(Times::new(vec![7.0]).quantile(0.999), 7.0);
        assert!(Times::default().median().is_nan());
        assert_eq!(Times::new(vec![f64::NAN, 1.0]).count(), 1);
    }

    /// The ratio is that of the medians in any order; the spread is that of the turns.
    #[test]
    fn ratios_are_of_medians() {
        let ratio = Ratio::new(&[8.0, 4.0, 100.0, 8.0, 8.0], &[2.0, 2.0, 2.0, 1.0, 4.0]);
        assert_eq!((ratio.of_medians, ratio.low, ratio.high), (4.0, 2.0, 8.0));
        assert_eq!(ratio.to_string(), "4.00x (2.00 to 8.00)");
    }

    /// Each variant runs once per round and once in the warm-up, in alternating order; a slow one runs less often.
    #[test]
    fn turns_alternate() {
        let calls = std::cell::RefCell::new(String::new());
        let contender = |name: char| -> Contender<'_> {
            let calls = &calls;
            Box::new(move || {
                calls.borrow_mut().push(name);
                calls.borrow().len() as f64
            })
        };
        let seconds = alternate(2, &mut [contender('a'), contender('b')]);
        assert_eq!(*calls.borrow(), "ababba");
        assert_eq!(seconds, [[3.0, 6.0], [4.0, 5.0]]);
        let slow: Contender<'_> = Box::new(|| PATIENCE_S);
        let quick: Contender<'_> = Box::new(|| 1e-3);
        assert_eq!(alternate(3, &mut [slow, quick]), [vec![PATIENCE_S], vec![1e-3; 3]]);
    }
}
