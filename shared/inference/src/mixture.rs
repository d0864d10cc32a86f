//! The mixture density network in native code.

use crate::InferenceError;
use crate::weights::StoredWeights;
use carff_checkpoint::{CheckpointError, Forecasts, Manifest, files, shapes::MixtureConfig};
use carff_decision::Mixture;
use carff_messages::{Gaussian, LATENT_DIM};
use std::path::Path;

/// Sums that a dot product computes at once.
const LANES: usize = 16;

/// The mixture density network: from one posterior to the belief over the next scene latent (paper section 3.4).
///
/// Equal inputs give equal bits on every machine, except for the exponential function of the system.
#[derive(Clone, Debug)]
pub struct MixtureNet {
    hidden: [Linear; 2],
    means: Head,
    log_variances: Head,
    weights: [Linear; 3],
}

impl MixtureNet {
    /// Reads the network of a checkpoint.
    pub fn load(dir: &Path, manifest: &Manifest) -> Result<Self, CheckpointError> {
        let path = dir.join(files::MIXTURE);
        if !path.is_file() {
            return Err(CheckpointError::Missing { path: dir.into(), part: "mixture density network", phase: "mdn" });
        }
        let wrong = |e: InferenceError| CheckpointError::Weights { path: dir.into(), what: e.to_string() };
        let config = &manifest.mixture;
        let refused = |(key, value, allowed)| wrong(InferenceError::Setting { key, value, allowed });
        config.check().map_err(refused)?;
        let mut weights = StoredWeights::read(&path).map_err(wrong)?;
        let (d, k, h, w) = (LATENT_DIM as i64, config.components, config.hidden, config.weight_hidden);
        let mut layer = |name: &str, from, to| Linear::take(&mut weights, name, from, to).map_err(wrong);
        let net = Self {
            hidden: [layer("first", 2 * d, h)?, layer("second", h, h)?],
            means: Head::new(&mut layer, "means", config)?,
            log_variances: Head::new(&mut layer, "log_variances", config)?,
            weights: [layer("weight0", h, w)?, layer("weight1", w, w)?, layer("weight2", w, k)?],
        };
        weights.finish(|_| false).map_err(wrong)?;
        Ok(net)
    }

    /// Returns the forecast over the next latent for one posterior.
    pub fn forecast(&self, posterior: &Gaussian) -> Mixture {
        let mut x: Vec<f32> = posterior.mean.to_vec();
        x.extend(posterior.log_variance.map(|v| v * 0.25));
        for layer in &self.hidden {
            x = layer.relu(&x);
        }
        let [first, second, last] = &self.weights;
        let logits = last.forward(&second.relu(&first.relu(&x)));
        let (low, high) = MixtureConfig::LOG_VARIANCES;
        let (means, log_variances) = (self.means.forward(&x), self.log_variances.forward(&x));
        let components = means.as_chunks().0.iter().zip(log_variances.as_chunks().0).map(|(mean, log_variance)| {
            Gaussian { mean: *mean, log_variance: log_variance.map(|v: f32| v.clamp(low, high)) }
        });
        Mixture { weights: softmax(&logits), components: components.collect() }
    }
}

impl Forecasts for MixtureNet {
    fn forecast(&self, posterior: &Gaussian) -> Mixture {
        self.forecast(posterior)
    }
}

/// Head of all components' means or log-variances, with a hidden layer where the checkpoint has one.
#[derive(Clone, Debug)]
struct Head {
    hidden: Option<Linear>,
    last: Linear,
}

impl Head {
    fn new<E>(
        layer: &mut impl FnMut(&str, i64, i64) -> Result<Linear, E>,
        name: &str,
        config: &MixtureConfig,
    ) -> Result<Self, E> {
        let (hidden, width) = (config.hidden, config.head_hidden);
        let first = if width > 0 { Some(layer(&format!("{name}_hidden"), hidden, width)?) } else { None };
        let inputs = if width > 0 { width } else { hidden };
        Ok(Self { hidden: first, last: layer(name, inputs, config.components * LATENT_DIM as i64)? })
    }

    fn forward(&self, x: &[f32]) -> Vec<f32> {
        self.hidden.as_ref().map_or_else(|| self.last.forward(x), |hidden| self.last.forward(&hidden.relu(x)))
    }
}

/// A fully connected layer, with one row of weights for each output.
#[derive(Clone, Debug)]
struct Linear {
    weights: Vec<f32>,
    biases: Vec<f32>,
}

impl Linear {
    fn take(weights: &mut StoredWeights, name: &str, from: i64, to: i64) -> Result<Self, InferenceError> {
        let mut take = |part, shape: &[i64]| weights.take(&format!("mixture.{name}.{part}"), shape);
        Ok(Self {
            weights: take("weight", &[to, from])?.into_raw_vec_and_offset().0,
            biases: take("bias", &[to])?.into_raw_vec_and_offset().0,
        })
    }

    fn forward(&self, x: &[f32]) -> Vec<f32> {
        self.weights.chunks_exact(x.len()).zip(&self.biases).map(|(row, bias)| dot(row, x) + bias).collect()
    }

    fn relu(&self, x: &[f32]) -> Vec<f32> {
        self.forward(x).into_iter().map(|v| v.max(0.0)).collect()
    }
}

/// Returns the dot product of two slices, in an order of sums that depends on their length only.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [0.0_f32; LANES];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f32>() + rest
}

/// Returns the softmax of logits, computed from their distance to the largest one.
fn softmax(logits: &[f32]) -> Vec<f32> {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let powers: Vec<f32> = logits.iter().map(|v| (v - largest).exp()).collect();
    let sum: f32 = powers.iter().sum();
    powers.iter().map(|p| p / sum).collect()
}
