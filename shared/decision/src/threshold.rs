//! The choice of the calibrated rule's threshold from calibration trials.

/// One calibration trial: the hazard probability that was computed, and whether the right action is to halt.
///
/// ```
/// use carff_decision::{CalibrationTrial, choose_threshold};
/// let trial = |hazard_probability, halt_is_right| CalibrationTrial { hazard_probability, halt_is_right };
/// let trials = [trial(0.05, false), trial(0.1, false), trial(0.5, true), trial(0.9, true)];
/// let threshold = choose_threshold(&trials).unwrap();
/// assert!(threshold > 0.1 && threshold < 0.5);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationTrial {
    /// Hazard probability, 0..=1.
    pub hazard_probability: f64,
    /// True if halting is right.
    pub halt_is_right: bool,
}

/// Log odds are clamped to those of this probability and of its complement.
const SUREST: f64 = 1e-4;
/// Keeps the slope finite where the trials are separable; the threshold is then the midpoint.
const RIDGE: f64 = 1e-4;
/// Most Newton steps; a dozen are usually enough.
const MOST_STEPS: usize = 200;

/// Returns the threshold to use without trials: half of the hazard probability of a belief that is even over the
/// branches. Hazard trials have that probability, and clear trials have next to none.
pub fn unchosen_threshold(hazard_branches: usize, branches: usize) -> f64 {
    0.5 * hazard_branches as f64 / branches.max(1) as f64
}

/// Returns the threshold at which hazard and clear trials are equally likely, both kinds having the same weight.
///
/// The threshold comes from a logistic regression of the right answer on the log odds of the hazard probability. Unlike
/// the threshold with the fewest errors, it does not depend on the few trials closest to it. The threshold is 0, which
/// always halts, where higher probabilities do not indicate a hazard. `None` when one kind of trial is missing.
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
        // The second-order approximation only holds for short steps.
        let share = (5.0 / length).min(1.0);
        (slope, offset) = (slope - share * by_slope, offset - share * by_offset);
    }
    Some(if slope > 0.0 { sigmoid(-offset / slope) } else { 0.0 })
}

/// Returns the largest threshold below which a share of at most `level` of all hazards is, with a probability of
/// `confidence` over the draw of the trials. `None` where there are too few trials for any threshold.
///
/// The trials are independent draws of hazards, each with its probability. The bound is the exact binomial one of a
/// risk-controlling prediction set (Bates et al., 2021, "Distribution-free, risk-controlling prediction sets").
///
/// ```
/// use carff_decision::bounded_threshold;
/// let hazards: Vec<f64> = (0..1000).map(|i| f64::from(i) / 1000.0).collect();
/// // 4 of the 1000 hazards are below it.
/// assert_eq!(bounded_threshold(&hazards, 0.01, 0.95), Some(0.004));
/// assert_eq!(bounded_threshold(&hazards[..298], 0.01, 0.95), None);
/// ```
pub fn bounded_threshold(hazards: &[f64], level: f64, confidence: f64) -> Option<f64> {
    let (n, odds) = (hazards.len() as f64, level / (1.0 - level));
    // Probability of `below` hazards below the threshold if the share were `level`, and of fewer.
    let (mut exactly, mut at_most) = ((n * (1.0 - level).ln()).exp(), 0.0);
    let mut below = None;
    for k in 0..hazards.len() {
        at_most += exactly;
        if at_most > 1.0 - confidence {
            break;
        }
        below = Some(k);
        exactly *= odds * (n - k as f64) / (k + 1) as f64;
    }
    let mut sorted = hazards.to_vec();
    sorted.sort_by(f64::total_cmp);
    Some(sorted.get(below?)?.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Over many draws of trials, the share of hazards below the threshold is above the level in at most a twentieth.
    #[test]
    fn the_bound_holds() {
        use rand::Rng;
        let mut rng = carff_base::random::stream(carff_base::random::Key { seed: 3, frame: 0, step: 0, sample: 0 });
        let draws = 2000;
        let broken = (0..draws).filter(|_| {
            let hazards: Vec<f64> = (0..500).map(|_| rng.random_range(0.0..1.0)).collect();
            // Of a uniform distribution, the share below the threshold is the threshold.
            bounded_threshold(&hazards, 0.02, 0.95).unwrap() > 0.02
        });
        let share = broken.count() as f64 / f64::from(draws);
        assert!((0.02..0.06).contains(&share), "{share}");
    }

    /// With no trials, the threshold is half of what an even belief over the branches has.
    #[test]
    fn without_trials_half_an_even_belief() {
        assert_eq!(unchosen_threshold(1, 2), 0.25);
        assert!((unchosen_threshold(2, 3) - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(unchosen_threshold(0, 0), 0.0);
    }

    /// The threshold separates separable trials, in the middle. With overlapping trials it is between the two kinds,
    /// and one outlier does not move it to the edge of the others. With uninformative probabilities it always halts.
    /// With only one kind there is none.
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
