//! The mixture density network: from one posterior to the belief over the next scene latent (paper section 3.4).

use crate::{LATENT_DIM, LatentGaussian, ModelError, encoder::gaussians};
use carff_random::Key;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::{Kind, Tensor, nn, nn::Module};

/// Shape of the network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MixtureConfig {
    /// Number of mixture components K, 1 to 4 (paper: 2).
    pub components: i64,
    /// Width of the two hidden layers (paper: 512).
    pub hidden: i64,
    /// Width of the weight head's hidden layers.
    pub weight_hidden: i64,
}

impl Default for MixtureConfig {
    fn default() -> Self {
        Self { components: 2, hidden: 512, weight_hidden: 128 }
    }
}

/// Component log-variances are kept inside this range.
pub const LOG_VARIANCE_RANGE: (f64, f64) = (-7.0, 4.0);

/// The network.
#[derive(Debug)]
pub struct MixtureNet {
    first: nn::Linear,
    second: nn::Linear,
    means: nn::Linear,
    log_variances: nn::Linear,
    weights: [nn::Linear; 3],
    components: i64,
}

/// A mixture of Gaussians over the scene latent.
#[derive(Clone, Debug, PartialEq)]
pub struct Mixture {
    /// Component weights; they sum to 1.
    pub weights: Vec<f32>,
    /// One Gaussian a component.
    pub components: Vec<LatentGaussian>,
}

/// One latent drawn from a mixture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    /// The latent.
    pub latent: [f32; LATENT_DIM],
    /// The component it came from.
    pub component: usize,
}

/// How draws are spread over the components.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// As in systematic resampling: each component gets its share of the draws, to within one.
    Stratified,
    /// Each draw picks its component by itself.
    Independent,
}

impl MixtureNet {
    /// Builds the network in `path`.
    pub fn new(path: &nn::Path, config: &MixtureConfig) -> Result<Self, ModelError> {
        if !(1..=4).contains(&config.components) {
            return Err(ModelError::Setting {
                key: "mixture.components",
                value: config.components.to_string(),
                allowed: "1 to 4",
            });
        }
        let linear = nn::LinearConfig::default();
        let (d, k, h, w) = (LATENT_DIM as i64, config.components, config.hidden, config.weight_hidden);
        Ok(Self {
            first: nn::linear(path / "first", 2 * d, h, linear),
            second: nn::linear(path / "second", h, h, linear),
            means: nn::linear(path / "means", h, k * d, linear),
            log_variances: nn::linear(path / "log_variances", h, k * d, linear),
            weights: [
                nn::linear(path / "weight0", h, w, linear),
                nn::linear(path / "weight1", w, w, linear),
                nn::linear(path / "weight2", w, k, linear),
            ],
            components: k,
        })
    }

    /// Where it computes.
    pub fn device(&self) -> tch::Device {
        self.first.ws.device()
    }

    /// Posterior means and log-variances, each `[N, 8]`, to log weights `[N, K]`, means `[N, K, 8]` and
    /// log-variances `[N, K, 8]`.
    pub fn forward(&self, mean: &Tensor, log_variance: &Tensor) -> (Tensor, Tensor, Tensor) {
        let input = Tensor::cat(&[mean.shallow_clone(), log_variance * 0.25], 1);
        let hidden = self.second.forward(&self.first.forward(&input).relu()).relu();
        let shape = [-1, self.components, LATENT_DIM as i64];
        let logits = self.weights[2].forward(&self.weights[1].forward(&self.weights[0].forward(&hidden).relu()).relu());
        (
            logits.log_softmax(-1, Kind::Float),
            self.means.forward(&hidden).view(shape),
            self.log_variances.forward(&hidden).view(shape).clamp(LOG_VARIANCE_RANGE.0, LOG_VARIANCE_RANGE.1),
        )
    }

    /// Mean negative log-likelihood of `targets` `[N, 8]` under the forecasts of the inputs (paper equation 6).
    pub fn negative_log_likelihood(&self, mean: &Tensor, log_variance: &Tensor, targets: &Tensor) -> Tensor {
        let (log_weights, means, log_variances) = self.forward(mean, log_variance);
        let distance = (targets.unsqueeze(1) - means).square() / log_variances.exp();
        let log_density = (distance + &log_variances + (2.0 * std::f64::consts::PI).ln()).sum_dim_intlist(
            [-1_i64].as_slice(),
            false,
            Kind::Float,
        ) * -0.5;
        -(log_weights + log_density).logsumexp([-1_i64].as_slice(), false).mean(Kind::Float)
    }

    /// The belief over the next latent, for one posterior.
    pub fn forecast(&self, posterior: &LatentGaussian) -> Mixture {
        self.forecast_all(std::slice::from_ref(posterior)).remove(0)
    }

    /// The beliefs over the next latent, for many posteriors at once.
    pub fn forecast_all(&self, posteriors: &[LatentGaussian]) -> Vec<Mixture> {
        tch::no_grad(|| {
            let flat = |part: fn(&LatentGaussian) -> &[f32; LATENT_DIM]| {
                let values: Vec<f32> = posteriors.iter().flat_map(|p| part(p).iter().copied()).collect();
                Tensor::from_slice(&values).view([-1, LATENT_DIM as i64]).to_device(self.device())
            };
            let (log_weights, means, log_variances) = self.forward(&flat(|p| &p.mean), &flat(|p| &p.log_variance));
            let k = self.components as usize;
            let mut weights = vec![0.0_f32; posteriors.len() * k];
            let count = weights.len();
            log_weights.exp().to_device(tch::Device::Cpu).contiguous().copy_data(&mut weights, count);
            let components = gaussians(&means, &log_variances);
            weights
                .chunks_exact(k)
                .zip(components.chunks_exact(k))
                .map(|(w, c)| Mixture { weights: w.to_vec(), components: c.to_vec() })
                .collect()
        })
    }
}

impl Mixture {
    /// Draws `count` latents. Draw i of a (seed, frame, step) is the same whatever else is drawn; which component it
    /// comes from depends on `count` too when sampling is stratified.
    pub fn draw(&self, count: usize, sampling: Sampling, seed: u64, frame: u64, step: u32) -> Vec<Draw> {
        // Index u32::MAX: a stream that no sample uses.
        let offset = carff_random::uniform(Key { seed, frame, step, sample: u32::MAX });
        (0..count)
            .map(|i| {
                let position = match sampling {
                    Sampling::Stratified => (i as f64 + offset) / count as f64,
                    Sampling::Independent => {
                        carff_random::uniform(Key { seed, frame, step, sample: i as u32 | 0x8000_0000 })
                    }
                };
                let component = self.component_at(position);
                let unit = carff_random::gaussians(Key { seed, frame, step, sample: i as u32 });
                Draw { latent: self.components[component].at(&unit), component }
            })
            .collect()
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
    use tch::{Device, nn::VarStore};

    fn mixture(weights: [f32; 2]) -> Mixture {
        let at = |x: f32| LatentGaussian { mean: [x; 8], log_variance: [-2.0; 8] };
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

    /// The loss is the closed form: -ln of the weighted sum of normal densities, computed by hand in f64.
    #[test]
    fn likelihood_is_the_closed_form() {
        tch::manual_seed(3);
        let store = VarStore::new(Device::Cpu);
        let net = MixtureNet::new(&store.root(), &MixtureConfig::default()).unwrap();
        let posterior = LatentGaussian { mean: [0.3; 8], log_variance: [-1.0; 8] };
        let target = [0.1_f32, -0.2, 0.3, 0.0, 0.5, -0.5, 0.2, 0.9];
        let m = net.forecast(&posterior);
        let density: f64 = m
            .weights
            .iter()
            .zip(&m.components)
            .map(|(&w, c)| {
                let log: f64 = (0..8)
                    .map(|i| {
                        let (d, v) = (f64::from(target[i] - c.mean[i]), f64::from(c.log_variance[i]));
                        -0.5 * (d * d / v.exp() + v + (2.0 * std::f64::consts::PI).ln())
                    })
                    .sum();
                f64::from(w) * log.exp()
            })
            .sum();
        let row = |v: &[f32; 8]| Tensor::from_slice(v).view([1, 8]);
        let loss = net
            .negative_log_likelihood(&row(&posterior.mean), &row(&posterior.log_variance), &row(&target))
            .double_value(&[]);
        assert!((loss + density.ln()).abs() < 1e-4, "{loss} against {}", -density.ln());
    }
}
