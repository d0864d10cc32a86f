//! Mixtures of Gaussians over the scene latent, and latents drawn from them.

use carff_base::random::Key;
use carff_messages::{Gaussian, LATENT_DIM};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A mixture of Gaussians over the scene latent (paper section 3.2).
///
/// ```
/// use carff_decision::{Mixture, Sampling};
/// use carff_messages::Gaussian;
/// let mixture = Mixture { weights: vec![0.25, 0.75], components: vec![Gaussian::standard(); 2] };
/// let draws = mixture.draw(8, Sampling::Stratified, 7, 0, 1);
/// assert_eq!(draws.iter().filter(|draw| draw.component == 0).count(), 2);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Mixture {
    /// Component weights; they sum to 1.
    pub weights: Vec<f32>,
    /// One Gaussian a component.
    pub components: Vec<Gaussian>,
}

/// One latent drawn from a mixture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// The latent.
    pub latent: [f32; LATENT_DIM],
    /// The component it came from.
    pub component: usize,
}

/// The way in which draws are spread over the components.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// Systematic resampling: each component gets its weight's share of the draws, to within one.
    #[default]
    Stratified,
    /// Each draw picks its component at random.
    Independent,
}

impl Mixture {
    /// Draws `count` latents. Draw i of a (seed, frame, step) is the same for any other draws; with stratified
    /// sampling, its component depends on `count`.
    pub fn draw(&self, count: usize, sampling: Sampling, seed: u64, frame: u64, step: u32) -> Vec<Draw> {
        // Index u32::MAX: a stream that no sample uses.
        let offset = carff_base::random::uniform(Key { seed, frame, step, sample: u32::MAX });
        (0..count)
            .map(|i| {
                let key = Key { seed, frame, step, sample: i as u32 };
                let position = match sampling {
                    Sampling::Stratified => (i as f64 + offset) / count as f64,
                    Sampling::Independent => Self::independent_position(key),
                };
                self.draw_at(position, key)
            })
            .collect()
    }

    /// Returns the random position of a sample among the components' shares, 0..1, where samples are independent.
    pub(crate) fn independent_position(key: Key) -> f64 {
        carff_base::random::uniform(Key { sample: key.sample | 0x8000_0000, ..key })
    }

    /// Draws one latent from the component whose share of the weights holds `position` in 0..1.
    pub(crate) fn draw_at(&self, position: f64, key: Key) -> Draw {
        let component = self.component_at(position);
        Draw { latent: self.components[component].at(&carff_base::random::gaussians(key)), component }
    }

    /// The component whose share of the weights holds `position` in 0..1.
    fn component_at(&self, position: f64) -> usize {
        let total: f64 = self.weights.iter().map(|&w| f64::from(w)).sum();
        let mut sum = 0.0;
        for (i, &w) in self.weights.iter().enumerate() {
            sum += f64::from(w) / total;
            if position < sum {
                return i;
            }
        }
        self.weights.len() - 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mixture(weights: [f32; 2]) -> Mixture {
        let at = |x: f32| Gaussian { mean: [x; 8], log_variance: [-2.0; 8] };
        Mixture { weights: weights.to_vec(), components: vec![at(-1.0), at(1.0)] }
    }

    /// Stratified draws give each component its share to within one draw, for every n.
    #[test]
    fn stratified_draws_follow_the_weights() {
        let m = mixture([0.3, 0.7]);
        for n in 1..=50 {
            for frame in 0..20 {
                let first = m.draw(n, Sampling::Stratified, 5, frame, 1).iter().filter(|d| d.component == 0).count();
                assert!((first as f64 - 0.3 * n as f64).abs() <= 1.0, "n {n}: {first}");
            }
        }
    }

    /// Independent draws follow the weights within five standard errors.
    #[test]
    fn independent_draws_follow_the_weights() {
        let m = mixture([0.3, 0.7]);
        let first: usize = (0..500)
            .map(|frame| m.draw(10, Sampling::Independent, 5, frame, 1).iter().filter(|d| d.component == 0).count())
            .sum();
        let share = first as f64 / 5000.0;
        assert!((share - 0.3).abs() < 5.0 * (0.21_f64 / 5000.0).sqrt(), "{share}");
    }

    /// Draws have their component's mean and spread (five standard errors), and repeat for the same key.
    #[test]
    fn draws_are_from_their_component() {
        let m = mixture([0.5, 0.5]);
        let draws = m.draw(4000, Sampling::Stratified, 1, 2, 3);
        assert_eq!(draws, m.draw(4000, Sampling::Stratified, 1, 2, 3));
        let second: Vec<f32> = draws.iter().filter(|d| d.component == 1).map(|d| d.latent[4]).collect();
        let n = second.len() as f32;
        let mean = second.iter().sum::<f32>() / n;
        let variance = second.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n;
        let expected = (-2.0_f32).exp();
        assert!((mean - 1.0).abs() < 5.0 * (expected / n).sqrt());
        assert!((variance / expected - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
    }
}
