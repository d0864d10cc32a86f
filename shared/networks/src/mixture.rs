//! The mixture density network: from one posterior to the belief over the next scene latent (paper section 3.4).

use crate::{ModelError, encoder::gaussians};
use carff_checkpoint::{Forecasts, shapes::MixtureConfig};
use carff_decision::Mixture;
use carff_messages::{Gaussian, LATENT_DIM};
use tch::{Kind, Tensor, nn, nn::Module};

/// The mixture density network.
#[derive(Debug)]
pub struct MixtureNet {
    first: nn::Linear,
    second: nn::Linear,
    means: Head,
    log_variances: Head,
    weights: [nn::Linear; 3],
    components: i64,
}

/// Head of all components' means or log-variances, with a hidden layer where the checkpoint has one.
#[derive(Debug)]
struct Head {
    hidden: Option<nn::Linear>,
    last: nn::Linear,
}

impl Head {
    fn new(path: &nn::Path, name: &str, config: &MixtureConfig) -> Self {
        let linear = nn::LinearConfig::default();
        let (hidden, width) = (config.hidden, config.head_hidden);
        let first = (width > 0).then(|| nn::linear(path / format!("{name}_hidden"), hidden, width, linear));
        let inputs = if width > 0 { width } else { hidden };
        Self { hidden: first, last: nn::linear(path / name, inputs, config.components * LATENT_DIM as i64, linear) }
    }

    fn forward(&self, x: &Tensor) -> Tensor {
        self.hidden.as_ref().map_or_else(|| self.last.forward(x), |hidden| self.last.forward(&hidden.forward(x).relu()))
    }
}

impl MixtureNet {
    /// Builds the network in `path`.
    pub fn new(path: &nn::Path, config: &MixtureConfig) -> Result<Self, ModelError> {
        config.check().map_err(|(key, value, allowed)| ModelError::Setting {
            key,
            value: value.to_string(),
            allowed,
        })?;
        let linear = nn::LinearConfig::default();
        let (d, k, h, w) = (LATENT_DIM as i64, config.components, config.hidden, config.weight_hidden);
        Ok(Self {
            first: nn::linear(path / "first", 2 * d, h, linear),
            second: nn::linear(path / "second", h, h, linear),
            means: Head::new(path, "means", config),
            log_variances: Head::new(path, "log_variances", config),
            weights: [
                nn::linear(path / "weight0", h, w, linear),
                nn::linear(path / "weight1", w, w, linear),
                nn::linear(path / "weight2", w, k, linear),
            ],
            components: k,
        })
    }

    /// Returns the device of the weights.
    pub fn device(&self) -> tch::Device {
        self.first.ws.device()
    }

    /// Maps posterior means and log-variances, each `[N, 8]`, to log weights `[N, K]`, means `[N, K, 8]` and
    /// log-variances `[N, K, 8]`.
    pub fn forward(&self, mean: &Tensor, log_variance: &Tensor) -> (Tensor, Tensor, Tensor) {
        let input = Tensor::cat(&[mean.shallow_clone(), log_variance * 0.25], 1);
        let hidden = self.second.forward(&self.first.forward(&input).relu()).relu();
        let shape = [-1, self.components, LATENT_DIM as i64];
        let (low, high) = MixtureConfig::LOG_VARIANCES;
        let logits = self.weights[2].forward(&self.weights[1].forward(&self.weights[0].forward(&hidden).relu()).relu());
        (
            logits.log_softmax(-1, Kind::Float),
            self.means.forward(&hidden).view(shape),
            self.log_variances.forward(&hidden).view(shape).clamp(f64::from(low), f64::from(high)),
        )
    }

    /// Returns the mean negative log-likelihood of `targets` `[N * M, 8]`, M for each input, under the forecasts of the N
    /// inputs (paper equation 6).
    pub fn negative_log_likelihood(&self, mean: &Tensor, log_variance: &Tensor, targets: &Tensor) -> Tensor {
        let (log_weights, means, log_variances) = self.forward(mean, log_variance);
        // [N, M, 8] against [N, K, 8], as [N, M, K, 8].
        let targets = targets.view([mean.size()[0], -1, 1, LATENT_DIM as i64]);
        let log_variances = log_variances.unsqueeze(1);
        let distance = (targets - means.unsqueeze(1)).square() / log_variances.exp();
        let log_density = (distance + &log_variances + (2.0 * std::f64::consts::PI).ln()).sum_dim_intlist(
            [-1_i64].as_slice(),
            false,
            Kind::Float,
        ) * -0.5;
        -(log_weights.unsqueeze(1) + log_density).logsumexp([-1_i64].as_slice(), false).mean(Kind::Float)
    }

    /// Returns the forecast over the next latent for one posterior.
    pub fn forecast(&self, posterior: &Gaussian) -> Mixture {
        self.forecast_all(std::slice::from_ref(posterior)).remove(0)
    }

    /// Returns the forecasts over the next latent for many posteriors at once.
    pub fn forecast_all(&self, posteriors: &[Gaussian]) -> Vec<Mixture> {
        tch::no_grad(|| {
            let flat = |part: fn(&Gaussian) -> &[f32; LATENT_DIM]| {
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

impl Forecasts for MixtureNet {
    fn forecast(&self, posterior: &Gaussian) -> Mixture {
        self.forecast(posterior)
    }

    fn forecast_all(&self, posteriors: &[Gaussian]) -> Vec<Mixture> {
        self.forecast_all(posteriors)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, nn::VarStore};

    /// The loss equals the closed form: -ln of the weighted sum of normal densities, computed separately in f64.
    #[test]
    fn likelihood_is_the_closed_form() {
        tch::manual_seed(3);
        let store = VarStore::new(Device::Cpu);
        let net = MixtureNet::new(&store.root(), &MixtureConfig::default()).unwrap();
        let posterior = Gaussian { mean: [0.3; 8], log_variance: [-1.0; 8] };
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

        // Several targets of an input count with their mean.
        let other = target.map(|v| 0.5 - v);
        let of = |targets: &[[f32; 8]]| {
            let targets = Tensor::from_slice(targets.as_flattened()).view([-1, 8]);
            net.negative_log_likelihood(&row(&posterior.mean), &row(&posterior.log_variance), &targets)
                .double_value(&[])
        };
        assert!((of(&[target, other]) - 0.5 * (loss + of(&[other]))).abs() < 1e-4);
    }
}
