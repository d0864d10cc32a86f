//! The value of a look: how much less uncertain the hazard is expected to be after an image from another pose.

/// Returns the expected drop of the uncertainty about the hazard by one more image, bits, 0..=1.
///
/// `probabilities` are those of the known states; they need not add up to 1. `alike` reports for each pair of states whether
/// they look the same in the image, which then cannot separate them.
///
/// ```
/// use carff_decision::look_gain_bits;
/// let (even, hazards) = ([0.5, 0.5], [true, false]);
/// // An image that separates the two states gains the whole bit; one that shows neither gains nothing.
/// assert_eq!(look_gain_bits(&even, &hazards, |a, b| a == b), 1.0);
/// assert_eq!(look_gain_bits(&even, &hazards, |_, _| true), 0.0);
/// ```
pub fn look_gain_bits(probabilities: &[f32], hazards: &[bool], alike: impl Fn(usize, usize) -> bool) -> f64 {
    let count = probabilities.len().min(hazards.len());
    // Uncertainty about the hazard among the states that count.
    let bits = |counts: &dyn Fn(usize) -> bool| {
        let sum = |hazard: bool| {
            let states = (0..count).filter(|&s| counts(s) && hazards[s] == hazard);
            states.map(|s| f64::from(probabilities[s].max(0.0))).sum::<f64>()
        };
        entropy_bits(sum(true), sum(false))
    };
    let total: f64 = probabilities[..count].iter().map(|p| f64::from(p.max(0.0))).sum();
    if total <= 0.0 {
        return 0.0;
    }
    let after = |state: usize| f64::from(probabilities[state].max(0.0)) * bits(&|other| alike(state, other));
    (bits(&|_| true) - (0..count).map(after).sum::<f64>() / total).clamp(0.0, 1.0)
}

/// Entropy of two outcomes with these weights, bits.
fn entropy_bits(a: f64, b: f64) -> f64 {
    let of = |p: f64| if p > 0.0 { -p * p.log2() } else { 0.0 };
    if a + b > 0.0 { of(a / (a + b)) + of(b / (a + b)) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nothing can be gained where the hazard is certain, and by an image that separates only harmless states.
    #[test]
    fn certainty_gains_nothing() {
        let hazards = [true, true, false, false];
        assert_eq!(look_gain_bits(&[0.7, 0.3, 0.0, 0.0], &hazards, |a, b| a == b), 0.0);
        assert_eq!(look_gain_bits(&[0.0; 4], &hazards, |a, b| a == b), 0.0);
        assert_eq!(look_gain_bits(&[0.25; 4], &hazards, |a, b| a == b || a % 2 == b % 2), 0.0);
    }

    /// An image that shows one of two hazards gains the part of the bit that it decides.
    #[test]
    fn a_part_can_be_gained() {
        let hazards = [true, true, false];
        let gain = look_gain_bits(&[0.25, 0.25, 0.5], &hazards, |a, b| a == b || (a > 0 && b > 0));
        let left = 0.75 * entropy_bits(0.25, 0.5);
        assert!((gain - (1.0 - left)).abs() < 1e-9 && gain > 0.2, "{gain}");
    }
}
