//! The training loop of the mixture density network (paper section 3.4).
//!
//! An input is the posterior of a view; its target is a real Gaussian draw from the posterior of a random neighbouring
//! view of the next time step that tells its state. Where several states look the same in the input's view, the step that follows any of
//! them is the target equally often. After the last step the scene stays as it is.

use crate::{
    TrainingError,
    config::TrainingConfig,
    pictures::Pictures,
    run::{Progress, Run, SaveClock, cosine, damaged, part, prefixed},
};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_models::{
    ModelError,
    adam::Adam,
    mixture::MixtureNet,
    weights::{self, Tensors},
};
use carff_random::Key;
use rand::Rng;
use rand_distr::StandardNormal;
use serde_json::json;
use tch::{Device, Kind, Tensor, nn::VarStore};

/// The network with its variables.
pub struct Mdn {
    /// The network.
    pub net: MixtureNet,
    store: VarStore,
}

impl Mdn {
    /// Fresh weights on `device` from the global generator (seed it first).
    pub fn new(config: &TrainingConfig, device: Device) -> Result<Self, ModelError> {
        let store = VarStore::new(device);
        Ok(Self { net: MixtureNet::new(&(store.root() / "mixture"), &config.mixture)?, store })
    }

    /// Weights that a checkpoint keeps.
    pub fn weights(&self) -> Tensors {
        weights::of_store(&self.store)
    }

    /// Puts the weights of a saved training back; `false` when they do not fit.
    #[must_use]
    pub fn restore_weights(&self, state: &Tensors) -> bool {
        weights::fill_store(&self.store, &part(state, "weights.")).is_ok()
    }
}

/// Trains the network on `posteriors[copy][picture]`, or goes on where an earlier run stopped.
pub fn train(
    config: &TrainingConfig,
    pictures: &Pictures,
    posteriors: &[Vec<Gaussian>],
    mdn: &Mdn,
    run: &Run,
) -> Result<(), TrainingError> {
    let settings = &config.mdn;
    let mut adam = Adam::new(&[&mdn.store], 0.0);
    let mut first = 0;
    if let Some((done, state)) = run.load("mdn")? {
        if !(mdn.restore_weights(&state) && adam.restore(&part(&state, "adam."))) {
            return Err(damaged(&run.state_path("mdn")));
        }
        first = done;
    }
    let trained = pictures.trained_and_free();
    let targets_of = telling(pictures);
    if let Some(state) = targets_of.iter().position(Vec::is_empty) {
        return Err(TrainingError::Unfit(format!(
            "no trained view of state {state} shows enough of the actor's place"
        )));
    }
    let alike: Vec<Vec<usize>> = pictures.labels.iter().map(|l| pictures.alike(l.view, l.state)).collect();
    let mut clock = SaveClock::default();
    let mut sum = 0.0;
    for step in first..settings.steps {
        let mut rng = carff_random::stream(Key { seed: config.seed, frame: step as u64, step: 0x6d64_6e00, sample: 0 });
        let [mut means, mut log_variances, mut targets] = [(); 3].map(|()| Vec::<f32>::new());
        for _ in 0..settings.batch {
            let i = trained[rng.random_range(0..trained.len())];
            let input = &posteriors[rng.random_range(0..posteriors.len())][i];
            let noise: [f32; LATENT_DIM] =
                std::array::from_fn(|_| rng.sample::<f32, _>(StandardNormal) * settings.input_noise as f32);
            means.extend(input.at(&noise));
            log_variances.extend(input.log_variance);
            // States that look the same in this view are equally likely: the input must not be learnt by heart.
            let alike = &alike[i];
            let state = alike[rng.random_range(0..alike.len())];
            let views = &targets_of[pictures.next_state(state)];
            let next = &posteriors[rng.random_range(0..posteriors.len())][views[rng.random_range(0..views.len())]];
            let unit: [f32; LATENT_DIM] = std::array::from_fn(|_| rng.sample(StandardNormal));
            targets.extend(next.at(&unit));
        }
        let rows =
            |values: &[f32]| Tensor::from_slice(values).view([-1, LATENT_DIM as i64]).to_device(mdn.net.device());
        let loss = mdn.net.negative_log_likelihood(&rows(&means), &rows(&log_variances), &rows(&targets));
        adam.step(&loss, settings.learning_rate * cosine(step, settings.steps), 5.0);
        sum += loss.double_value(&[]);
        let done = step + 1;
        if done % 100 == 0 || done == settings.steps {
            let mean = sum / if done % 100 == 0 { 100.0 } else { (done % 100) as f64 };
            sum = 0.0;
            run.metric(&json!({"stage": "mdn", "step": done, "negative_log_likelihood": mean}))?;
            (run.on_progress)(&Progress {
                stage: "mdn",
                done,
                total: settings.steps,
                line: format!("negative log-likelihood {mean:.3}"),
            });
        }
        let stopping = run.stopped();
        if stopping || clock.is_due() || done == settings.steps {
            let mut state: Tensors = prefixed("adam.", adam.state()).collect();
            state.extend(prefixed("weights.", mdn.weights()));
            run.save("mdn", done, state)?;
        }
        if stopping {
            return Err(TrainingError::Stopped);
        }
    }
    Ok(())
}

/// Per state the pictures of trained and free poses that tell it: those that look like no other state from their pose.
/// The posterior of any other picture rightly stands between states. Where no picture tells a state, those count that
/// show at least half of the actor's place.
pub fn telling(pictures: &Pictures) -> Vec<Vec<usize>> {
    let mut by_state = vec![Vec::new(); pictures.scenario.state_count()];
    let mut fallback = by_state.clone();
    for i in pictures.trained_and_free() {
        let label = pictures.labels[i];
        if pictures.alike(label.view, label.state).len() == 1 {
            by_state[label.state].push(i);
        } else if label.visible_fraction >= 0.5 {
            fallback[label.state].push(i);
        }
    }
    by_state.into_iter().zip(fallback).map(|(telling, rest)| if telling.is_empty() { rest } else { telling }).collect()
}

/// Mean negative log-likelihood over given pairs, for tests and reports.
pub fn likelihood(net: &MixtureNet, inputs: &[Gaussian], targets: &[[f32; LATENT_DIM]]) -> f64 {
    let rows = |values: Vec<f32>| Tensor::from_slice(&values).view([-1, LATENT_DIM as i64]).to_device(net.device());
    tch::no_grad(|| {
        net.negative_log_likelihood(
            &rows(inputs.iter().flat_map(|g| g.mean).collect()),
            &rows(inputs.iter().flat_map(|g| g.log_variance).collect()),
            &rows(targets.iter().flatten().copied().collect()),
        )
        .to_kind(Kind::Double)
        .double_value(&[])
    })
}
