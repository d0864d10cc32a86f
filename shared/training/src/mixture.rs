//! Training phase of the mixture density network (paper section 3.4).
//!
//! An input is the posterior of a view. Its target is a Gaussian draw from the posterior of a random view that shows the
//! state of the next time step. Views that look the same have the same posterior: the targets follow the states of the
//! input's nearest posteriors, so that the network cannot memorise which of them the input was. After the last step the
//! scene does not change.

use crate::{
    TrainingError,
    config::TrainingConfig,
    records::{MixtureRecord, names},
    run::{Context, Phase, PhaseReport, cosine, part, prefixed},
    unambiguous::{no_view, possible_states, unambiguous_by_state},
};
use carff_base::random::Key;
use carff_messages::{Gaussian, LATENT_DIM};
use carff_networks::{
    ModelError,
    adam::Adam,
    mixture::MixtureNet,
    weights::{self, Tensors},
};
use rand::Rng;
use rand_distr::StandardNormal;
use tch::{Device, Tensor, nn::VarStore};

/// The network with its variables.
pub struct Mdn {
    /// The network.
    pub net: MixtureNet,
    store: VarStore,
}

impl Mdn {
    /// A network on `device` with random weights from libtorch's global generator.
    pub fn new(config: &TrainingConfig, device: Device) -> Result<Self, ModelError> {
        let store = VarStore::new(device);
        Ok(Self { net: MixtureNet::new(&(store.root() / "mixture"), &config.mixture)?, store })
    }

    /// Weights of a checkpoint.
    pub fn weights(&self) -> Tensors {
        weights::of_store(&self.store)
    }

    /// Restores the weights of a saved state; `false` when they do not fit.
    #[must_use]
    pub fn restore_weights(&self, state: &Tensors) -> bool {
        weights::fill_store(&self.store, &part(state, "weights.")).is_ok()
    }
}

/// Steps between two records.
const RECORD_EVERY: usize = 100;

/// Training phase of the mixture density network.
pub struct MixturePhase<'a> {
    context: Context<'a>,
    /// `[copy][image]`.
    posteriors: &'a [Vec<Gaussian>],
    mdn: &'a Mdn,
    adam: Adam,
    inputs: Vec<usize>,
    /// States that the view of each input may show.
    possible: Vec<Vec<usize>>,
    /// Images of each state whose posteriors are targets.
    targets: Vec<Vec<usize>>,
    /// Sum of the losses since the last record.
    sum: f64,
}

impl<'a> MixturePhase<'a> {
    /// The phase before its first step. `posteriors` are `[copy][image]`.
    pub fn new(context: Context<'a>, posteriors: &'a [Vec<Gaussian>], mdn: &'a Mdn) -> Result<Self, TrainingError> {
        let posed = context.posed;
        let targets = unambiguous_by_state(posed, &posteriors[0]);
        if let Some(state) = targets.iter().position(Vec::is_empty) {
            return Err(no_view(state));
        }
        Ok(Self {
            context,
            posteriors,
            mdn,
            adam: Adam::new(&[&mdn.store], 0.0),
            inputs: posed.trained_and_random(),
            possible: possible_states(posed, &posteriors[0]),
            targets,
            sum: 0.0,
        })
    }
}

impl Phase for MixturePhase<'_> {
    type Record = MixtureRecord;

    fn name(&self) -> &'static str {
        names::MIXTURE
    }

    fn total(&self) -> usize {
        self.context.config.mdn.steps
    }

    fn restore(&mut self, _done: usize, state: &Tensors) -> bool {
        self.mdn.restore_weights(state) && self.adam.restore(&part(state, "adam."))
    }

    fn step(&mut self, step: usize) {
        let Context { config, posed, .. } = self.context;
        let settings = &config.mdn;
        let mut rng = carff_base::random::stream(Key::named(names::MIXTURE, config.seed, step as u64));
        let [mut means, mut log_variances, mut targets] = [(); 3].map(|()| Vec::<f32>::new());
        for _ in 0..settings.batch {
            let k = rng.random_range(0..self.inputs.len());
            let i = self.inputs[k];
            let input = &self.posteriors[rng.random_range(0..self.posteriors.len())][i];
            let noise: [f32; LATENT_DIM] =
                std::array::from_fn(|_| rng.sample::<f32, _>(StandardNormal) * settings.input_noise as f32);
            means.extend(input.at(&noise));
            log_variances.extend(input.log_variance.map(|v| match settings.variance_noise {
                0.0 => v,
                noise => v + rng.sample::<f32, _>(StandardNormal) * noise as f32,
            }));
            let possible = &self.possible[k];
            let state = possible[rng.random_range(0..possible.len())];
            let views = &self.targets[posed.scenario.next_state(state)];
            let copy = &self.posteriors[rng.random_range(0..self.posteriors.len())];
            let next = &copy[views[rng.random_range(0..views.len())]];
            for _ in 0..settings.target_draws {
                let unit: [f32; LATENT_DIM] = std::array::from_fn(|_| rng.sample(StandardNormal));
                targets.extend(next.at(&unit));
            }
        }
        let net = &self.mdn.net;
        let rows = |values: &[f32]| Tensor::from_slice(values).view([-1, LATENT_DIM as i64]).to_device(net.device());
        let loss = net.negative_log_likelihood(&rows(&means), &rows(&log_variances), &rows(&targets));
        self.adam.step(&loss, settings.learning_rate * cosine(step, settings.steps), 5.0);
        self.sum += loss.double_value(&[]);
    }

    fn report(&mut self, done: usize) -> Result<PhaseReport<MixtureRecord>, TrainingError> {
        let steps = if done.is_multiple_of(RECORD_EVERY) { RECORD_EVERY } else { done % RECORD_EVERY };
        if steps < RECORD_EVERY && done < self.total() {
            return Ok(PhaseReport { line: None, record: None });
        }
        let mean = std::mem::take(&mut self.sum) / steps as f64;
        let record = MixtureRecord { step: done as u64, negative_log_likelihood: mean };
        Ok(PhaseReport { line: Some(format!("negative log-likelihood {mean:.3}")), record: Some(record) })
    }

    fn state(&self) -> Tensors {
        let mut state: Tensors = prefixed("adam.", self.adam.state()).collect();
        state.extend(prefixed("weights.", self.mdn.weights()));
        state
    }
}
