//! Fits the growth of a cost as a straight line or a power, by least squares.

use crate::report::number;

/// Shape of a growth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Law {
    /// y = base + rate x.
    Linear,
    /// y = base + rate x²: a straight line over the pixels of a square of side x.
    Area,
    /// y = base x^rate.
    Power,
}

/// A fitted growth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Fit {
    pub(crate) law: Law,
    /// y at x = 0; for a power, at x = 1.
    pub(crate) base: f64,
    /// Slope; for a power, the exponent.
    pub(crate) rate: f64,
    /// Explained share of the variance (for a power, of the logarithms), 0..=1. NaN without variance, and for fewer
    /// than three points, which any line fits.
    pub(crate) r_squared: f64,
}

impl Fit {
    /// Fits points `(x, y)`. Points that are not finite, or for a power not positive, are left out. Returns `None` if
    /// fewer than two different x remain.
    pub(crate) fn new(law: Law, points: &[(f64, f64)]) -> Option<Self> {
        let straight = |(x, y): (f64, f64)| match law {
            Law::Linear => (x, y),
            Law::Area => (x * x, y),
            Law::Power => (x.ln(), y.ln()),
        };
        let points: Vec<(f64, f64)> =
            points.iter().copied().map(straight).filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
        let n = points.len() as f64;
        let mean = |value: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(value).sum::<f64>() / n;
        let (mean_x, mean_y) = (mean(&|p| p.0), mean(&|p| p.1));
        let (xx, yy) = (mean(&|p| (p.0 - mean_x).powi(2)), mean(&|p| (p.1 - mean_y).powi(2)));
        let xy = mean(&|p| (p.0 - mean_x) * (p.1 - mean_y));
        // NaN without points.
        if xx.is_nan() || xx <= 1e-12 * mean_x.powi(2).max(1e-12) {
            return None;
        }
        let rate = xy / xx;
        let base = mean_y - rate * mean_x;
        let base = if law == Law::Power { base.exp() } else { base };
        let r_squared = if points.len() > 2 { xy * xy / (xx * yy) } else { f64::NAN };
        Some(Self { law, base, rate, r_squared })
    }

    /// Returns the fitted y.
    pub(crate) fn at(&self, x: f64) -> f64 {
        match self.law {
            Law::Linear => self.base + self.rate * x,
            Law::Area => self.base + self.rate * x * x,
            Law::Power => self.base * x.powf(self.rate),
        }
    }

    /// Returns the formula as text: `unit` is that of y, `each` that of x, for example "sample".
    pub(crate) fn sentence(&self, unit: &str, each: &str) -> String {
        let r_squared = number(self.r_squared);
        match self.law {
            Law::Linear | Law::Area => {
                let sign = if self.rate < 0.0 { '-' } else { '+' };
                let rate = precise(self.rate.abs());
                let square = if self.law == Law::Area { "²" } else { "" };
                format!("{} {sign} {rate} {unit} a {each}{square} (R² {r_squared})", number(self.base))
            }
            Law::Power => format!("{} {unit} × {each}^{:.2} (R² {r_squared})", precise(self.base), self.rate),
        }
    }
}

/// Formats a number with two significant digits: a slope may be far below one.
fn precise(value: f64) -> String {
    if (0.1..100.0).contains(&value) || value == 0.0 { number(value) } else { format!("{value:.1e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-9 * b.abs().max(1.0)
    }

    /// Points on a line or a power are fitted exactly, and points that cannot be fitted are ignored.
    #[test]
    fn exact_points_are_fitted_exactly() {
        let line: Vec<(f64, f64)> = [1.0, 2.0, 5.0, 50.0].map(|x| (x, 20.0 + 0.3 * x)).to_vec();
        let fit = Fit::new(Law::Linear, &[&line[..], &[(7.0, f64::NAN)]].concat()).unwrap();
        assert!(near(fit.base, 20.0) && near(fit.rate, 0.3) && near(fit.r_squared, 1.0), "{fit:?}");
        assert!(near(fit.at(10.0), 23.0));
        let power: Vec<(f64, f64)> = [32.0_f64, 64.0, 256.0].map(|x| (x, 0.002 * x.powf(1.9))).to_vec();
        let fit = Fit::new(Law::Power, &[&power[..], &[(0.0, 1.0), (5.0, 0.0), (-1.0, 2.0)]].concat()).unwrap();
        assert!(near(fit.base, 0.002) && near(fit.rate, 1.9) && near(fit.r_squared, 1.0), "{fit:?}");
        assert!(near(fit.at(100.0), 0.002 * 100.0_f64.powf(1.9)));
        let area: Vec<(f64, f64)> = [64.0, 128.0, 512.0].map(|x| (x, 20.0 + 7e-5 * x * x)).to_vec();
        let fit = Fit::new(Law::Area, &area).unwrap();
        assert!(near(fit.base, 20.0) && near(fit.rate, 7e-5) && near(fit.r_squared, 1.0), "{fit:?}");
        assert!(near(fit.at(100.0), 20.7));
    }

    /// The line through scattered points is that of least squares, with its share of the variance.
    #[test]
    fn scattered_points_are_fitted_by_least_squares() {
        let fit = Fit::new(Law::Linear, &[(0.0, 1.0), (1.0, 3.0), (2.0, 2.0)]).unwrap();
        assert!(near(fit.base, 1.5) && near(fit.rate, 0.5) && near(fit.r_squared, 0.25), "{fit:?}");
    }

    /// A single x, or no point, has no growth. Equal values have a slope of zero.
    #[test]
    fn no_growth() {
        for law in [Law::Linear, Law::Area, Law::Power] {
            assert_eq!(Fit::new(law, &[]), None);
            assert_eq!(Fit::new(law, &[(3.0, 1.0), (3.0, 2.0)]), None);
            assert_eq!(Fit::new(law, &[(3.0, f64::NAN), (4.0, 2.0)]), None);
            let flat = Fit::new(law, &[(1.0, 2.0), (4.0, 2.0)]).unwrap();
            assert_eq!(flat.rate, 0.0);
            assert!(flat.r_squared.is_nan());
            assert!(Fit::new(law, &[(1.0, 2.0), (4.0, 3.0)]).unwrap().r_squared.is_nan(), "any line fits two points");
        }
    }

    /// Formulas have their signs and enough digits.
    #[test]
    fn formulas_are_readable() {
        let fit = |law, base, rate| Fit { law, base, rate, r_squared: 0.991 };
        assert_eq!(fit(Law::Linear, 20.0, 0.31).sentence("ms", "sample"), "20.0 + 0.310 ms a sample (R² 0.991)");
        assert_eq!(fit(Law::Linear, 20.0, -0.002).sentence("ms", "probe"), "20.0 - 2.0e-3 ms a probe (R² 0.991)");
        assert_eq!(fit(Law::Power, 0.0021, 1.9).sentence("ms", "px"), "2.1e-3 ms × px^1.90 (R² 0.991)");
        assert_eq!(fit(Law::Area, 20.0, 7e-5).sentence("ms", "px"), "20.0 + 7.0e-5 ms a px² (R² 0.991)");
    }
}
