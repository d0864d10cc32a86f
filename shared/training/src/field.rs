//! The training loop of the latent-conditioned field (paper section 3.3).
//!
//! Each ray's latent stands for the state of its picture: at first the mean of the posterior of a random view of that
//! state, and more and more often a draw from that posterior, so that the field learns the whole cloud of latents.

use crate::{
    TrainingError,
    config::TrainingConfig,
    mixture::telling,
    pictures::Pictures,
    run::{Progress, Run, SaveClock, damaged, part, prefixed},
};
use carff_dataset::PoseRole;
use carff_field::{Field, FieldConfig, FieldTrainer, NamedTensor, RayBatch, RaySampler, TrainingView, changed_pixels};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_models::weights::Tensors;
use carff_random::Key;
use rand::Rng;
use rand_distr::StandardNormal;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;
use tch::{Kind, Tensor};

/// Training of the field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FieldTraining {
    /// Rays a step.
    pub rays: usize,
    /// Share of the rays through pixels that change among the states, 0..=1.
    pub changed_share: f32,
    /// Share of rays whose latent is a draw instead of a mean, at the end of the ramp, 0..=1.
    pub resampled_share: f64,
    /// Share of the training in which it rises from 0.
    pub resampled_ramp: f64,
    /// Whether a pixel sees what is as wide as itself (see `point_width_m` of the field, which is then the median of what the
    /// pictures' pixels are in the middle of the bounds), or a mere point.
    pub wide_pixels: bool,
    /// The optimiser; `steps` is the length of the training.
    pub trainer: carff_field::TrainerConfig,
}

impl Default for FieldTraining {
    fn default() -> Self {
        Self {
            rays: 4096,
            changed_share: 0.34,
            resampled_share: 0.7,
            resampled_ramp: 0.3,
            wide_pixels: false,
            trainer: carff_field::TrainerConfig::default(),
        }
    }
}

/// Per state, the posteriors that stand for it.
pub struct Clouds {
    by_state: Vec<Vec<Gaussian>>,
}

impl Clouds {
    /// The posteriors of the views that tell each state.
    pub fn new(pictures: &Pictures, posteriors: &[Gaussian]) -> Result<Self, TrainingError> {
        let by_state: Vec<Vec<Gaussian>> =
            telling(pictures).into_iter().map(|views| views.into_iter().map(|i| posteriors[i]).collect()).collect();
        match by_state.iter().position(Vec::is_empty) {
            Some(state) => Err(TrainingError::Unfit(format!("no trained view of state {state} shows enough"))),
            None => Ok(Self { by_state }),
        }
    }

    /// Per state one Gaussian: the mean of the means, and the mean variance.
    pub fn states(&self) -> Vec<Gaussian> {
        self.by_state
            .iter()
            .map(|cloud| {
                let n = cloud.len() as f32;
                Gaussian {
                    mean: std::array::from_fn(|d| cloud.iter().map(|g| g.mean[d]).sum::<f32>() / n),
                    log_variance: std::array::from_fn(|d| {
                        (cloud.iter().map(|g| g.log_variance[d].exp()).sum::<f32>() / n).ln()
                    }),
                }
            })
            .collect()
    }

    /// A latent of a state: the mean of a random posterior, or with probability `resampled` a draw from it.
    pub fn draw(&self, state: usize, resampled: f64, rng: &mut impl Rng) -> [f32; LATENT_DIM] {
        let cloud = &self.by_state[state];
        let posterior = &cloud[rng.random_range(0..cloud.len())];
        if rng.random::<f64>() < resampled {
            posterior.at(&std::array::from_fn(|_| rng.sample(StandardNormal)))
        } else {
            posterior.mean
        }
    }

    /// The field's structure for these latents and this scenario.
    fn structure(&self, config: &TrainingConfig, pictures: &Pictures) -> FieldConfig {
        let means: Vec<[f32; LATENT_DIM]> = self.by_state.iter().flatten().map(|g| g.mean).collect();
        let n = means.len() as f32;
        let mean: [f32; LATENT_DIM] = std::array::from_fn(|d| means.iter().map(|m| m[d]).sum::<f32>() / n);
        let scale = std::array::from_fn(|d| {
            let variance = means.iter().map(|m| (m[d] - mean[d]).powi(2)).sum::<f32>() / n;
            1.0 / variance.sqrt().max(0.05)
        });
        let bounds_m = pictures.scenario.bounds.map(|corner| corner.map(|v| v as f32));
        let point_width_m = if config.nerf.wide_pixels { middle_width_m(pictures) } else { config.field.point_width_m };
        FieldConfig { bounds_m, latent_mean: mean, latent_scale: scale, point_width_m, ..config.field.clone() }
    }
}

/// Median over the data set's pictures of a pixel's width in the middle of the bounds, metres.
fn middle_width_m(pictures: &Pictures) -> f32 {
    let [low, high] = pictures.scenario.bounds;
    let mut widths: Vec<f64> = pictures
        .dataset
        .frames()
        .iter()
        .map(|frame| {
            let from = frame.camera.position_m();
            let distance = (0..3).map(|a| (0.5 * (low[a] + high[a]) - from[a]).powi(2)).sum::<f64>().sqrt();
            distance / frame.camera.fl_x_px
        })
        .collect();
    widths.sort_by(f64::total_cmp);
    widths.get(widths.len() / 2).map_or(0.0, |width| *width as f32)
}

/// Trains the field that ships, or goes on where an earlier run stopped.
pub fn train(config: &TrainingConfig, pictures: &Pictures, clouds: &Clouds, run: &Run) -> Result<Field, TrainingError> {
    train_stage(config, pictures, clouds, "nerf", config.nerf.trainer.steps, run)
}

/// Trains a field in `steps` steps, or goes on where an earlier run of the stage stopped.
pub(crate) fn train_stage(
    config: &TrainingConfig,
    pictures: &Pictures,
    clouds: &Clouds,
    stage: &'static str,
    steps: u64,
    run: &Run,
) -> Result<Field, TrainingError> {
    let settings = &config.nerf;
    let trainer_config = carff_field::TrainerConfig {
        seed: config.seed,
        threads: config.threads.max(1) as usize,
        steps,
        ..settings.trainer.clone()
    };
    let mut trainer = if let Some((done, state)) = run.load(stage)? {
        resume(config, trainer_config.clone(), done, &state).ok_or_else(|| damaged(&run.state_path(stage)))?
    } else {
        FieldTrainer::new(Field::new(clouds.structure(config, pictures), config.seed)?, trainer_config.clone())?
    };
    let states = pictures.scenario.state_count();
    trainer.set_state_latents(&state_latents(clouds, states, config.seed));
    let chosen = pictures.with_roles(&[PoseRole::Rest, PoseRole::Calibration]);
    let mut sampler = RaySampler::new(views(pictures, &chosen), settings.changed_share, config.seed);
    sampler.set_drawn(trainer.step_count());
    let state_of: Vec<usize> = chosen.iter().map(|&i| pictures.labels[i].state).collect();
    let mut batch = RayBatch::default();
    let mut clock = SaveClock::default();
    let total = trainer_config.steps;
    let [mut loss, mut psnr] = [0.0_f64; 2];
    while trainer.step_count() < total {
        let step = trainer.step_count();
        let at = step as f64 / total as f64;
        let resampled = settings.resampled_share * (at / settings.resampled_ramp.max(1e-9)).min(1.0);
        sampler.next_batch(settings.rays, &mut batch, |view, draw| {
            let mut rng = carff_random::stream(Key { seed: config.seed, frame: draw, step: 0x6e65_7266, sample: 0 });
            clouds.draw(state_of[view], resampled, &mut rng)
        });
        let report = trainer.step(&batch);
        loss += 0.02 * (report.loss - loss);
        psnr += 0.02 * (report.psnr - psnr);
        let done = trainer.step_count();
        if done.is_multiple_of(20) || done == total {
            let line = format!(
                "loss {loss:.5}  psnr of rays {psnr:.2} dB  {:.1} samples a ray  occupied {:.1} %",
                report.samples as f64 / report.rays.max(1) as f64,
                100.0 * trainer.field().occupancy().occupied_share(),
            );
            (run.on_progress)(&Progress { stage, done: done as usize, total: total as usize, line });
        }
        if done.is_multiple_of(100) || done == total {
            run.metric(&json!({"stage": stage, "step": done, "loss": loss, "ray_psnr_db": psnr}))?;
        }
        let stopping = run.stopped();
        if stopping || clock.is_due() || done == total {
            save(run, stage, &trainer)?;
        }
        if stopping {
            return Err(TrainingError::Stopped);
        }
    }
    Ok(trainer.into_field())
}

/// Several latents of each state, for the occupancy grid that keeps what exists in any of them.
fn state_latents(clouds: &Clouds, states: usize, seed: u64) -> Vec<Vec<[f32; LATENT_DIM]>> {
    let means = clouds.states();
    (0..states)
        .map(|s| {
            let mut rng = carff_random::stream(Key { seed, frame: s as u64, step: 0x6f63_6375, sample: 0 });
            std::iter::once(means[s].mean).chain((0..15).map(|_| clouds.draw(s, 0.7, &mut rng))).collect()
        })
        .collect()
}

/// The chosen pictures with their cameras and the pixels that change among the states.
fn views(pictures: &Pictures, chosen: &[usize]) -> Vec<TrainingView> {
    chosen
        .iter()
        .map(|&i| {
            let label = pictures.labels[i];
            let same_view: Vec<&[u8]> = (0..pictures.scenario.state_count())
                .filter_map(|s| pictures.at(s, label.view))
                .map(|j| &pictures.images[j].rgb[..])
                .collect();
            TrainingView {
                camera: pictures.dataset.frames()[i].camera,
                rgb: pictures.images[i].rgb.clone(),
                changed: changed_pixels(&same_view, 12),
            }
        })
        .collect()
}

fn to_tensors<'a>(named: impl IntoIterator<Item = NamedTensor<'a>>) -> Tensors {
    named
        .into_iter()
        .map(|t| {
            let shape: Vec<i64> = t.shape.iter().map(|&s| s as i64).collect();
            (t.name.into_owned(), Tensor::from_slice(&t.data).view(shape.as_slice()))
        })
        .collect()
}

fn to_rows(tensors: Tensors) -> Vec<(String, Vec<usize>, Vec<f32>)> {
    tensors
        .into_iter()
        .map(|(name, t)| {
            let shape = t.size().iter().map(|&s| s as usize).collect();
            let mut values = vec![0.0_f32; t.numel()];
            let count = values.len();
            t.to_kind(Kind::Float).contiguous().copy_data(&mut values, count);
            (name, shape, values)
        })
        .collect()
}

fn save(run: &Run, stage: &str, trainer: &FieldTrainer) -> Result<(), TrainingError> {
    let state = trainer.state();
    let mut all: Tensors = prefixed("trainer.", to_tensors(state.tensors)).collect();
    all.extend(prefixed("field.", to_tensors(trainer.field().tensors())));
    let structure = serde_json::to_string(trainer.field().config()).unwrap_or_default();
    all.insert("structure".into(), Tensor::from_slice(structure.as_bytes()));
    run.save(stage, state.step as usize, all)
}

fn resume(
    config: &TrainingConfig,
    trainer_config: carff_field::TrainerConfig,
    done: usize,
    state: &Tensors,
) -> Option<FieldTrainer> {
    let field = saved_field(config, state)?;
    FieldTrainer::from_state(field, trainer_config, done as u64, to_rows(part(state, "trainer."))).ok()
}

/// The field of a saved training state; `None` when it does not belong to this configuration.
pub fn saved_field(config: &TrainingConfig, state: &Tensors) -> Option<Field> {
    let bytes = state.get("structure")?;
    let mut text = vec![0_u8; bytes.numel()];
    let count = text.len();
    bytes.to_kind(Kind::Uint8).copy_data(&mut text, count);
    let structure: FieldConfig = serde_json::from_slice(&text).ok()?;
    let wanted = &config.field;
    let same = (structure.levels, structure.log2_table_size, structure.hidden_width, structure.max_resolution)
        == (wanted.levels, wanted.log2_table_size, wanted.hidden_width, wanted.max_resolution)
        && (structure.point_width_m > 0.0) == (config.nerf.wide_pixels || wanted.point_width_m > 0.0);
    if !same {
        return None;
    }
    Field::from_tensors(structure, to_rows(part(state, "field."))).ok()
}
