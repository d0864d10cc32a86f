//! Training phase of the latent-conditioned field (paper section 3.3).
//!
//! The latent of a ray represents the state of its image. At first it is the mean of the posterior of a random view of
//! that state. More and more often it is a draw from that posterior, so that the field learns all latents of the state.

use crate::{
    TrainingError, alignment,
    config::TrainingConfig,
    records::{FieldRecord, names},
    run::{Context, Phase, PhaseReport, drive, part, prefixed},
    unambiguous::{no_view, unambiguous_by_state},
};
use carff_base::random::Key;
use carff_dataset::PIXEL_TOLERANCE;
use carff_evaluation::PosedImages;
use carff_field::{
    Correction, Field, FieldConfig, FieldTrainer, HypothesisBuffer, NamedTensor, RayBatch, RaySampler, RenderOptions,
    StepReport, TrainerConfig, TrainingView, changed_pixels,
};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_networks::weights::Tensors;
use rand::Rng;
use rand_distr::StandardNormal;
use tch::{Kind, Tensor};

/// Posteriors of each state.
pub struct Clouds {
    by_state: Vec<Vec<Gaussian>>,
}

impl Clouds {
    /// Posteriors of the views that show their state.
    pub fn new(posed: &PosedImages, posteriors: &[Gaussian]) -> Result<Self, TrainingError> {
        let by_state: Vec<Vec<Gaussian>> = unambiguous_by_state(posed, posteriors)
            .into_iter()
            .map(|views| views.into_iter().map(|i| posteriors[i]).collect())
            .collect();
        match by_state.iter().position(Vec::is_empty) {
            Some(state) => Err(no_view(state)),
            None => Ok(Self { by_state }),
        }
    }

    /// One Gaussian of each state: the mean of the means, and the mean variance.
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

    /// Structure of the field for these latents and this scenario.
    fn structure(&self, config: &TrainingConfig, posed: &PosedImages) -> FieldConfig {
        let means: Vec<[f32; LATENT_DIM]> = self.by_state.iter().flatten().map(|g| g.mean).collect();
        let n = means.len() as f32;
        let mean: [f32; LATENT_DIM] = std::array::from_fn(|d| means.iter().map(|m| m[d]).sum::<f32>() / n);
        let scale = std::array::from_fn(|d| {
            let variance = means.iter().map(|m| (m[d] - mean[d]).powi(2)).sum::<f32>() / n;
            1.0 / variance.sqrt().max(0.05)
        });
        FieldConfig { latent_mean: mean, latent_scale: scale, ..structure(config, posed) }
    }
}

/// Structure of the field for this scenario, with latents of unit scale.
pub fn structure(config: &TrainingConfig, posed: &PosedImages) -> FieldConfig {
    let bounds_m = posed.scenario.bounds.map(|corner| corner.map(|v| v as f32));
    let point_width_m = if config.nerf.wide_pixels { middle_width_m(posed) } else { config.field.point_width_m };
    FieldConfig { bounds_m, point_width_m, ..config.field.clone() }
}

/// Median over the dataset's images of the width of a pixel in the middle of the bounds, metres.
fn middle_width_m(posed: &PosedImages) -> f32 {
    let [low, high] = posed.scenario.bounds;
    let mut widths: Vec<f64> = posed
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

/// Steps between two lines of progress, and between two records.
const LINE_EVERY: usize = 20;
const RECORD_EVERY: usize = 100;

/// Name of the corrections of the views' images in a saved state.
const CORRECTIONS: &str = "corrections";

/// Share of a new value in the running means.
const NEW_SHARE: f64 = 0.02;

/// Running means of the reports of a field's steps.
#[derive(Default)]
pub struct RunningMeans {
    /// Loss.
    pub loss: f64,
    /// PSNR of the rays' colours, dB.
    pub psnr_db: f64,
}

impl RunningMeans {
    /// Adds the report of a step.
    pub fn add(&mut self, report: &StepReport) {
        self.loss += NEW_SHARE * (report.loss - self.loss);
        self.psnr_db += NEW_SHARE * (report.psnr - self.psnr_db);
    }

    /// Record after `done` steps.
    pub fn record(&self, done: usize) -> FieldRecord {
        FieldRecord { step: done as u64, loss: self.loss, ray_psnr_db: self.psnr_db }
    }
}

/// Training phase of a field.
pub struct FieldPhase<'a> {
    context: Context<'a>,
    clouds: &'a Clouds,
    name: &'static str,
    settings: TrainerConfig,
    trainer: FieldTrainer,
    sampler: RaySampler,
    /// State of each of the sampler's views.
    state_of: Vec<usize>,
    batch: RayBatch,
    last: StepReport,
    means: RunningMeans,
}

impl<'a> FieldPhase<'a> {
    /// The phase `name` before the first of its `steps`.
    pub fn new(
        context: Context<'a>,
        clouds: &'a Clouds,
        name: &'static str,
        steps: u64,
    ) -> Result<Self, TrainingError> {
        let Context { config, posed, .. } = context;
        let threads = config.threads.max(1) as usize;
        let settings = TrainerConfig { seed: config.seed, threads, steps, ..config.nerf.trainer.clone() };
        let field = Field::new(clouds.structure(config, posed), config.seed)?;
        let mut trainer = FieldTrainer::new(field, settings.clone())?;
        trainer.set_state_latents(&state_latents(clouds, config.seed));
        let chosen = posed.trained();
        Ok(Self {
            context,
            clouds,
            name,
            settings,
            trainer,
            sampler: RaySampler::new(views(posed, &chosen), config.nerf.changed_share, config.seed),
            state_of: chosen.iter().map(|&i| posed.labels[i].state).collect(),
            batch: RayBatch::default(),
            last: StepReport::default(),
            means: RunningMeans::default(),
        })
    }

    /// Aligns every image with the field.
    fn align(&mut self) {
        let states = self.clouds.states();
        let options = RenderOptions { threads: self.settings.threads, ..RenderOptions::default() };
        let mut buffer = HypothesisBuffer::default();
        let posed = self.context.posed;
        let of = posed.trained();
        let aligned = of.iter().zip(self.sampler.views()).map(|(&image, view)| {
            let latent = states[posed.labels[image].state].mean;
            alignment::against(self.trainer.field(), view, &posed.images[image], latent, &options, &mut buffer)
        });
        let mut corrections: Vec<Correction> = aligned.collect();
        alignment::balance(&mut corrections);
        self.correct(&corrections);
    }

    fn correct(&mut self, corrections: &[Correction]) {
        corrections.iter().enumerate().for_each(|(view, correction)| self.sampler.correct(view, *correction));
    }

    /// Trains to the end, or resumes, and returns the field.
    pub fn trained(mut self) -> Result<Field, TrainingError> {
        let run = self.context.run;
        drive(&mut self, run)?;
        Ok(self.trainer.into_field())
    }
}

impl Phase for FieldPhase<'_> {
    type Record = FieldRecord;

    fn name(&self) -> &'static str {
        self.name
    }

    fn total(&self) -> usize {
        self.settings.steps as usize
    }

    fn restore(&mut self, done: usize, state: &Tensors) -> bool {
        let config = self.context.config;
        let Some(mut trainer) = resumed(config, self.settings.clone(), done, state) else { return false };
        trainer.set_state_latents(&state_latents(self.clouds, config.seed));
        self.sampler.set_drawn(trainer.step_count());
        self.trainer = trainer;
        if let Some(saved) = state.get(CORRECTIONS) {
            let mut values = vec![0.0_f32; saved.numel()];
            let count = values.len();
            saved.to_kind(Kind::Float).copy_data(&mut values, count);
            let corrections: Vec<Correction> = values.as_chunks().0.iter().map(|&numbers| numbers.into()).collect();
            self.correct(&corrections);
        }
        true
    }

    fn step(&mut self, step: usize) {
        let Context { config, posed, .. } = self.context;
        let settings = &config.nerf;
        let at = step as f64 / self.total() as f64;
        let resampled = settings.resampled_share * (at / settings.resampled_ramp.max(1e-9)).min(1.0);
        let (clouds, state_of) = (self.clouds, &self.state_of);
        self.sampler.next_batch(settings.rays, &mut self.batch, |view, draw| {
            let mut rng = carff_base::random::stream(Key::named(names::FIELD, config.seed, draw));
            clouds.draw(state_of[view], resampled, &mut rng)
        });
        self.last = self.trainer.step(&self.batch);
        self.means.add(&self.last);
        if posed.is_of_camera() && alignment::is_due(step + 1, self.total()) {
            self.align();
        }
    }

    fn report(&mut self, done: usize) -> Result<PhaseReport<FieldRecord>, TrainingError> {
        let RunningMeans { loss, psnr_db } = self.means;
        let due = |every: usize| done == self.total() || done.is_multiple_of(every);
        let line = due(LINE_EVERY).then(|| {
            format!(
                "loss {loss:.5}  psnr of rays {psnr_db:.2} dB  {:.1} samples a ray  occupied {:.1} %",
                self.last.samples as f64 / self.last.rays.max(1) as f64,
                100.0 * self.trainer.field().occupancy().occupied_share(),
            )
        });
        let record = due(RECORD_EVERY).then(|| self.means.record(done));
        Ok(PhaseReport { line, record })
    }

    fn state(&self) -> Tensors {
        let mut state = state_of(&self.trainer);
        let all: Vec<f32> = self.sampler.views().iter().flat_map(|view| view.correction.to_array()).collect();
        state.insert(CORRECTIONS.into(), Tensor::from_slice(&all));
        state
    }
}

/// State of a trainer and its field.
pub fn state_of(trainer: &FieldTrainer) -> Tensors {
    let mut all: Tensors = prefixed("trainer.", to_tensors(trainer.state().tensors)).collect();
    all.extend(prefixed("field.", to_tensors(trainer.field().tensors())));
    let structure = serde_json::to_string(trainer.field().config()).unwrap_or_default();
    all.insert("structure".into(), Tensor::from_slice(structure.as_bytes()));
    all
}

/// Several latents of each state, for the occupancy grid, which covers all states.
fn state_latents(clouds: &Clouds, seed: u64) -> Vec<Vec<[f32; LATENT_DIM]>> {
    let means = clouds.states();
    (0..means.len())
        .map(|s| {
            let mut rng = carff_base::random::stream(Key::named("occu", seed, s as u64));
            std::iter::once(means[s].mean).chain((0..15).map(|_| clouds.draw(s, 0.7, &mut rng))).collect()
        })
        .collect()
}

/// The chosen images with their cameras and the pixels that change among the states.
pub fn views(posed: &PosedImages, chosen: &[usize]) -> Vec<TrainingView> {
    chosen
        .iter()
        .map(|&i| {
            let label = posed.labels[i];
            let own = &posed.images[i];
            let same_view: Vec<&[u8]> = posed
                .of_view(label.view)
                .into_iter()
                .map(|j| &posed.images[j])
                .filter(|image| (image.width_px, image.height_px) == (own.width_px, own.height_px))
                .map(|image| &image.rgb[..])
                .collect();
            let mut changed = changed_pixels(&same_view, PIXEL_TOLERANCE);
            let mut valid = Vec::new();
            if let Some(mask) = posed.dataset.valid_pixels(i) {
                changed.retain(|&pixel| mask[pixel as usize]);
                valid = (0..mask.len() as u32).filter(|&pixel| mask[pixel as usize]).collect();
            }
            TrainingView {
                camera: posed.dataset.frames()[i].camera,
                rgb: own.rgb.clone(),
                changed,
                valid,
                correction: Correction::default(),
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

/// A trainer of a saved state; `None` when the state does not fit this configuration.
pub fn resumed(config: &TrainingConfig, settings: TrainerConfig, done: usize, state: &Tensors) -> Option<FieldTrainer> {
    let field = saved_field(config, state)?;
    FieldTrainer::from_state(field, settings, done as u64, to_rows(part(state, "trainer."))).ok()
}

/// The field of a saved state; `None` when the state does not fit this configuration.
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
