//! Training of encoder and field in one stage, for comparison with the paper's two stages: the encoder learns only
//! through the error of the field's rays, as in NeRF-VAE (Kosiorek et al. 2021).
//!
//! Each ray is of another pose of the state that the encoder's image shows.

use crate::{
    TrainingError,
    field::{RunningMeans, resumed, state_of, structure, views},
    records::{FieldRecord, names},
    run::{Context, Phase, PhaseReport, cosine},
    vae::{
        Inputs, Vae,
        losses::{kl_divergence, reparameterised},
    },
};
use carff_base::random::Key;
use carff_field::{Field, FieldTrainer, RAYS_PER_GROUP, RayBatch, RaySampler, TrainerConfig};
use carff_messages::LATENT_DIM;
use carff_networks::{adam::Adam, weights::Tensors};
use rand::Rng;
use std::{collections::VecDeque, iter};
use tch::{Kind, Tensor};

/// Purpose of the random stream of the images.
const STREAM: &str = "1stg";
/// Latents of each state that the occupancy grid covers: the newest ones.
const LATENTS_OF_STATE: usize = 16;
/// Steps between two records.
const RECORD_EVERY: usize = 500;

/// Training phase of encoder and field together. One step has `vae.batch` images, each with 32 rays.
pub struct OneStagePhase<'a> {
    context: Context<'a>,
    vae: &'a Vae,
    inputs: &'a Inputs<'a>,
    adam: Adam,
    trainer: FieldTrainer,
    sampler: RaySampler,
    /// State and pose of each of the sampler's images.
    seen: Vec<(usize, usize)>,
    /// Images of each state from trained poses, each `vae.own_passes` times, and from free poses.
    of_state: Vec<Vec<usize>>,
    latest: Vec<VecDeque<[f32; LATENT_DIM]>>,
    means: RunningMeans,
}

impl<'a> OneStagePhase<'a> {
    /// The phase before its first step.
    pub fn new(context: Context<'a>, vae: &'a Vae, inputs: &'a Inputs<'a>) -> Result<Self, TrainingError> {
        let Context { config, posed, .. } = context;
        let field = Field::new(structure(config, posed), config.seed)?;
        let chosen = posed.trained();
        let mut of_state = vec![Vec::new(); posed.scenario.state_count()];
        let further = iter::repeat_n(&chosen, config.vae.own_passes - 1).flatten().copied();
        for i in posed.trained_and_random().into_iter().chain(further) {
            of_state[posed.labels[i].state].push(i);
        }
        Ok(Self {
            context,
            vae,
            inputs,
            adam: Adam::new(&vae.stores(), config.vae.weight_decay),
            trainer: FieldTrainer::new(field, settings(context))?,
            sampler: RaySampler::new(views(posed, &chosen), config.nerf.changed_share, config.seed),
            seen: chosen.iter().map(|&i| (posed.labels[i].state, posed.labels[i].view)).collect(),
            latest: vec![VecDeque::new(); of_state.len()],
            of_state,
            means: RunningMeans::default(),
        })
    }

    /// An image of the state of the sampler's image `at` from another pose, in one of its copies.
    fn input(&self, at: usize, rng: &mut impl Rng) -> (usize, usize) {
        let (state, view) = self.seen[at];
        let images = &self.of_state[state];
        let start = rng.random_range(0..images.len());
        let turn = (0..images.len()).map(|k| images[(start + k) % images.len()]);
        let mut others = turn.filter(|&i| self.context.posed.labels[i].view != view);
        let image = others.next().unwrap_or(images[start]);
        (image, rng.random_range(0..self.inputs.copies_of(image)))
    }

    /// Keeps the newest latents of each state, and gives them to the occupancy grid.
    fn keep(&mut self, states: impl Iterator<Item = usize>, latents: &[[f32; LATENT_DIM]]) {
        for (state, latent) in states.zip(latents) {
            let latest = &mut self.latest[state];
            if latest.len() == LATENTS_OF_STATE {
                latest.pop_front();
            }
            latest.push_back(*latent);
        }
        self.trainer.set_state_latents(&self.latest.iter().map(|l| l.iter().copied().collect()).collect::<Vec<_>>());
    }
}

impl Phase for OneStagePhase<'_> {
    type Record = FieldRecord;

    fn name(&self) -> &'static str {
        names::ONE_STAGE
    }

    fn total(&self) -> usize {
        self.context.config.vae.one_stage_steps
    }

    fn restore(&mut self, done: usize, state: &Tensors) -> bool {
        let Some(trainer) = resumed(self.context.config, settings(self.context), done, state) else { return false };
        self.trainer = trainer;
        self.sampler.set_drawn(done as u64);
        for (number, latest) in self.latest.iter_mut().enumerate() {
            let Some(saved) = state.get(&latents_key(number)) else { return false };
            *latest = rows(saved).into();
        }
        self.vae.restore(Some(&mut self.adam), state)
    }

    fn step(&mut self, step: usize) {
        let Context { config, .. } = self.context;
        let settings = &config.vae;
        let (mut batch, mut drawn) = (RayBatch::default(), Vec::new());
        self.sampler.next_batch(settings.batch * RAYS_PER_GROUP, &mut batch, |at, _| {
            drawn.push(at);
            [0.0; LATENT_DIM]
        });
        let mut rng = carff_base::random::stream(Key::named(STREAM, config.seed, step as u64));
        let chosen: Vec<(usize, usize)> = drawn.iter().map(|&at| self.input(at, &mut rng)).collect();
        tch::manual_seed(config.seed as i64 ^ ((step as i64) << 20));
        let features = self.inputs.features(self.vae, &chosen);
        let (mean, log_variance) = self.vae.encoder.posterior(&features, settings.dropout);
        let latent = reparameterised(&mean, &log_variance, &Tensor::randn_like(&mean));
        batch.latents = rows(&latent);
        let states: Vec<usize> = drawn.iter().map(|&at| self.seen[at].0).collect();
        self.keep(states.into_iter(), &batch.latents);

        let report = self.trainer.step(&batch);
        // The encoder gets the field's gradient by each latent.
        let gradient =
            Tensor::from_slice(report.latent_gradient.as_flattened()).view_as(&latent).to_device(latent.device());
        let at = step as f64 / self.total() as f64;
        let kl_weight = settings.kl_weight * ((at - settings.kl_delay) / settings.kl_ramp.max(1e-9)).clamp(0.0, 1.0);
        let loss = (&latent * gradient).sum(Kind::Float) * settings.reconstruction_weight
            + kl_divergence(&mean, &log_variance) * kl_weight;
        self.adam.step(&loss, settings.learning_rate * cosine(step, self.total()), 5.0);
        self.means.add(&report);
    }

    fn report(&mut self, done: usize) -> Result<PhaseReport<FieldRecord>, TrainingError> {
        if done != self.total() && !done.is_multiple_of(RECORD_EVERY) {
            return Ok(PhaseReport { line: None, record: None });
        }
        let figures = self.vae.figures(self.context, &self.inputs.posteriors(self.vae, 0), false)?;
        let line = format!(
            "loss {:.5}  psnr of rays {:.2} dB  state accuracy trained {:.1} % held-out {:.1} %",
            self.means.loss,
            self.means.psnr_db,
            100.0 * figures.trained.full.accuracy,
            100.0 * figures.unseen.full.accuracy,
        );
        Ok(PhaseReport { line: Some(line), record: Some(self.means.record(done)) })
    }

    fn state(&self) -> Tensors {
        let mut all = self.vae.state(&self.adam);
        all.extend(state_of(&self.trainer));
        all.extend(self.latest.iter().enumerate().map(|(number, latest)| {
            let values: Vec<f32> = latest.iter().flatten().copied().collect();
            (latents_key(number), Tensor::from_slice(&values).view([latest.len() as i64, LATENT_DIM as i64]))
        }));
        all
    }
}

/// Name of a state's newest latents in the saved state.
fn latents_key(state: usize) -> String {
    format!("latents.{state}")
}

/// Latents of a tensor `[N, 8]`.
fn rows(latents: &Tensor) -> Vec<[f32; LATENT_DIM]> {
    let mut values = vec![0.0_f32; latents.numel()];
    latents.detach().to_device(tch::Device::Cpu).contiguous().copy_data(&mut values, latents.numel());
    values.as_chunks().0.to_vec()
}

fn settings(context: Context) -> TrainerConfig {
    let config = context.config;
    TrainerConfig {
        seed: config.seed,
        threads: config.threads.max(1) as usize,
        steps: config.vae.one_stage_steps as u64,
        latent_gradient: true,
        ..config.nerf.trainer.clone()
    }
}
