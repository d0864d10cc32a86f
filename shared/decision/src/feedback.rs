//! The input of each further step of the look-ahead (paper section 3.2), and the forecast from several samples.

use crate::{Draw, Mixture, Sampling};
use carff_base::random::{Key, uniform};
use carff_messages::{Gaussian, LATENT_DIM, MAX_COMPONENTS};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Bit in a sample's number: the stream that orders the samples. It collides with no other stream of a sample.
const ORDER: u32 = 0x4000_0000;

/// Input of each further step of the look-ahead.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Feedback {
    /// The stored posterior of the most probable known state. Later steps hold if that state is true.
    #[default]
    State,
    /// Each probed sample, as the latent that it is. Later steps hold the whole distribution.
    Latent,
}

/// Origin of a forecast's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ForecastInput {
    /// The posterior of the image, or what a memory made of it.
    Image,
    /// The stored posterior of this known state.
    State(usize),
    /// A sample of the step before.
    Sample,
}

/// Returns the forecast from `forecasts`, which are those of the fed-back samples: their common mixture, and `count`
/// samples. Sample i follows the fed-back sample `i * forecasts.len() / count`, so that with an unchanged number each
/// sample goes its own way.
///
/// Equal forecasts give their components the same shares of the samples as [`Mixture::draw`]. The mixture has at most
/// [`MAX_COMPONENTS`] components; closer ones are merged, which keeps mean and variance.
///
/// ```
/// use carff_decision::{Mixture, Sampling, continue_samples};
/// use carff_messages::Gaussian;
/// let at = |x: f32| Gaussian { mean: [x; 8], log_variance: [-9.0; 8] };
/// let forecasts = [-1.0, 1.0].map(|x| Mixture { weights: vec![1.0], components: vec![at(x)] });
/// let (mixture, draws) = continue_samples(&forecasts, 2, Sampling::Stratified, 7, 0, 2);
/// assert_eq!(mixture.weights, [0.5, 0.5]);
/// assert!(draws[0].latent[0] < 0.0 && draws[1].latent[0] > 0.0);
/// ```
pub fn continue_samples(
    forecasts: &[Mixture],
    count: usize,
    sampling: Sampling,
    seed: u64,
    frame: u64,
    step: u32,
) -> (Mixture, Vec<Draw>) {
    let (mixture, merged) = merge(forecasts);
    let key = |sample: u32| Key { seed, frame, step, sample };
    let offset = uniform(key(u32::MAX));
    let orders: Vec<f64> = (0..count).map(|i| uniform(key(i as u32 | ORDER))).collect();
    let draw = |i: usize| {
        let from = i * forecasts.len() / count;
        let position = match sampling {
            // Neighbours follow the same sample before: their places among the strata are shuffled.
            Sampling::Stratified => {
                let rank = orders.iter().filter(|order| **order < orders[i]).count();
                (rank as f64 + offset) / count as f64
            }
            Sampling::Independent => Mixture::independent_position(key(i as u32)),
        };
        let Draw { latent, component } = forecasts[from].draw_at(position, key(i as u32));
        Draw { latent, component: merged[from][component] }
    };
    let draws = (0..count).map(draw).collect();
    (mixture, draws)
}

/// Returns the mixture of equally probable mixtures with at most [`MAX_COMPONENTS`] components, and for each component of
/// each mixture the component that it is merged into.
fn merge(mixtures: &[Mixture]) -> (Mixture, Vec<Vec<usize>>) {
    let share = 1.0 / mixtures.len().max(1) as f64;
    let of = |m: &Mixture| -> Vec<(f64, Gaussian)> {
        m.weights.iter().zip(&m.components).map(|(w, c)| (share * f64::from(*w), *c)).collect()
    };
    let all: Vec<(f64, Gaussian)> = mixtures.iter().flat_map(of).collect();
    let middles = middles(&all);
    let into: Vec<usize> = all.iter().map(|(_, component)| nearest(component, &middles).0).collect();
    let mut weights = vec![0.0_f64; middles.len()];
    let mut sums = vec![[[0.0_f64; LATENT_DIM]; 2]; middles.len()];
    for ((weight, component), &to) in all.iter().zip(&into) {
        weights[to] += weight;
        let [first, second] = &mut sums[to];
        let moments = first.iter_mut().zip(second).zip(component.mean.iter().zip(component.log_variance));
        for ((first, second), (&mean, log_variance)) in moments {
            let mean = f64::from(mean);
            *first += weight * mean;
            *second += weight * (f64::from(log_variance).exp() + mean * mean);
        }
    }
    let component = |(weight, [first, second]): (&f64, &[[f64; LATENT_DIM]; 2])| {
        let mean = first.map(|sum| sum / weight);
        let variance: [f64; LATENT_DIM] = std::array::from_fn(|i| second[i] / weight - mean[i] * mean[i]);
        let smallest = f64::from(f32::MIN_POSITIVE);
        Gaussian { mean: mean.map(|m| m as f32), log_variance: variance.map(|v| v.max(smallest).ln() as f32) }
    };
    let components = weights.iter().zip(&sums).map(component).collect();
    let mut rest = into.into_iter();
    let merged = mixtures.iter().map(|m| rest.by_ref().take(m.components.len()).collect()).collect();
    (Mixture { weights: weights.iter().map(|w| *w as f32).collect(), components }, merged)
}

/// Returns up to [`MAX_COMPONENTS`] of weighted components that are far from each other: the heaviest, then each time the
/// one whose weight times its distance to those is largest.
fn middles(all: &[(f64, Gaussian)]) -> Vec<Gaussian> {
    let mut middles: Vec<Gaussian> = Vec::new();
    while middles.len() < MAX_COMPONENTS.min(all.len()) {
        let gain = |(weight, component): &(f64, Gaussian)| {
            weight * if middles.is_empty() { 1.0 } else { nearest(component, &middles).1 }
        };
        let best = all.iter().map(|one| (gain(one), one.1)).reduce(|a, b| if b.0 > a.0 { b } else { a });
        match best.filter(|(gain, _)| *gain > 0.0) {
            Some((_, component)) => middles.push(component),
            None => break,
        }
    }
    middles
}

/// Returns the index of the nearest component, and the squared distance to it in deviations.
fn nearest(of: &Gaussian, middles: &[Gaussian]) -> (usize, f64) {
    let distance = |other: &Gaussian| -> f64 {
        let along = |i: usize| {
            let variance = |g: &Gaussian| f64::from(g.log_variance[i]).exp();
            f64::from(of.mean[i] - other.mean[i]).powi(2) / (variance(of) + variance(other))
        };
        (0..LATENT_DIM).map(along).sum()
    };
    let distances = middles.iter().map(distance).enumerate();
    distances.reduce(|a, b| if b.1 < a.1 { b } else { a }).unwrap_or((0, 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f32) -> Gaussian {
        Gaussian { mean: [x; LATENT_DIM], log_variance: [-6.0; LATENT_DIM] }
    }

    fn mixture(parts: &[(f32, f32)]) -> Mixture {
        Mixture { weights: parts.iter().map(|p| p.0).collect(), components: parts.iter().map(|p| at(p.1)).collect() }
    }

    /// With an unchanged number of samples, each continues its own: for both kinds of sampling.
    #[test]
    fn each_sample_goes_its_own_way() {
        let forecasts: Vec<Mixture> = (0..10).map(|i| mixture(&[(0.5, i as f32), (0.5, i as f32 + 100.0)])).collect();
        for sampling in [Sampling::Stratified, Sampling::Independent] {
            for frame in 0..50 {
                let (_, draws) = continue_samples(&forecasts, 10, sampling, 3, frame, 2);
                for (i, draw) in draws.iter().enumerate() {
                    let own = draw.latent[0].round().rem_euclid(100.0);
                    assert_eq!(own, i as f32, "{sampling:?}, frame {frame}");
                }
            }
        }
    }

    /// Equal forecasts: components get their shares to within one sample, and which samples get which differs.
    #[test]
    fn equal_forecasts_are_stratified() {
        let forecasts = vec![mixture(&[(0.3, -1.0), (0.7, 1.0)]); 10];
        let mut firsts = 0;
        for frame in 0..200 {
            let (mixture, draws) = continue_samples(&forecasts, 10, Sampling::Stratified, 3, frame, 2);
            assert_eq!(mixture.components.len(), 2);
            let low = draws.iter().filter(|d| d.latent[0] < 0.0).count();
            assert!((low as f64 - 3.0).abs() <= 1.0, "frame {frame}: {low}");
            firsts += usize::from(draws[0].latent[0] < 0.0);
        }
        // Five standard errors around 60 of 200.
        assert!((firsts as f64 - 60.0).abs() < 5.0 * (200.0_f64 * 0.3 * 0.7).sqrt(), "{firsts}");
    }

    /// Merged mixtures keep weight, mean and variance, and distant components stay apart.
    #[test]
    fn merging_keeps_moments() {
        let forecasts: Vec<Mixture> =
            (0..20).map(|i| mixture(&[(0.25, -3.0 + 0.01 * i as f32), (0.75, 3.0 - 0.01 * i as f32)])).collect();
        let (merged, into) = merge(&forecasts);
        assert!(merged.components.len() <= MAX_COMPONENTS && into.len() == 20);
        let moments = |parts: &[(f32, Gaussian)]| {
            let sum = |of: &dyn Fn(&Gaussian) -> f64| -> f64 { parts.iter().map(|(w, g)| f64::from(*w) * of(g)).sum() };
            let second = |g: &Gaussian| f64::from(g.log_variance[0]).exp() + f64::from(g.mean[0]).powi(2);
            [sum(&|_| 1.0), sum(&|g| f64::from(g.mean[0])), sum(&second)]
        };
        let parts = |m: &Mixture, share: f32| -> Vec<(f32, Gaussian)> {
            m.weights.iter().map(|w| share * w).zip(m.components.iter().copied()).collect()
        };
        let before = moments(&forecasts.iter().flat_map(|m| parts(m, 0.05)).collect::<Vec<_>>());
        let after = moments(&parts(&merged, 1.0));
        assert!(before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-4), "{before:?} {after:?}");
        assert!(merged.components.iter().all(|c| c.mean[0].abs() > 2.7), "{merged:?}");
    }

    /// Fewer and more samples than were fed back: each follows one of them, and all of those are followed evenly.
    #[test]
    fn another_number_of_samples() {
        let forecasts: Vec<Mixture> = (0..4).map(|i| mixture(&[(1.0, 10.0 * i as f32)])).collect();
        let followed = |count| {
            let (_, draws) = continue_samples(&forecasts, count, Sampling::Stratified, 3, 1, 2);
            draws.iter().map(|d| (d.latent[0] / 10.0).round() as usize).collect::<Vec<_>>()
        };
        assert_eq!(followed(2), [0, 2]);
        assert_eq!(followed(8), [0, 0, 1, 1, 2, 2, 3, 3]);
    }
}
