//! From images to a checkpoint: VAE, mixture density network, field, calibration, figures.

use crate::{
    TrainingConfig, TrainingError,
    calibrate::{calibrated_probing, choose_and_save_threshold},
    config::CalibrationConfig,
    field::{Clouds, FieldPhase, saved_field},
    mixture::{Mdn, MixturePhase},
    one_stage::OneStagePhase,
    places,
    records::{DoneRecord, names},
    run::{Context, TrainingRun, drive},
    vae::{Inputs, Vae, VaePhase},
};
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::{FORMAT_VERSION, Manifest, ScenarioIdentity, SplitRecord, files, save_field};
use carff_dataset::{Observability, PoseRole, drives::eligible_inputs};
use carff_decision::{Policy, Sampling};
use carff_evaluation::{
    BirdsEye, CheckpointFigures, FieldRenderer, Models, Perception, Planner, PlanningFigures, PosedImages,
    ProbingFigures, Progress, SampleFigures, SampleInput, SampleTrials, TrainedAndUnseen, ViewFigures, birds_eye,
    to_unit,
};
use carff_field::{Field, to_bytes};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_networks::stored::save_weights;
use carff_scenes::Scenario;
use serde_json::Value;
use std::path::{Path, PathBuf};
use tch::Device;

/// Trials of each image in the planning tables.
const PLANNING_REPEATS: usize = 5;
/// Samples of each input in the sample accuracy.
const ACCURACY_SAMPLES: usize = 50;
/// Largest number of images in the strip of a dataset with one state.
const STRIP_IMAGES: usize = 8;

/// Phases to train.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phases {
    /// All three, in order.
    All,
    /// Only the pose-conditional VAE.
    Vae,
    /// Only the field.
    Field,
    /// Only the mixture density network.
    Mixture,
}

/// A training: its input and output.
#[derive(Clone, Copy)]
pub struct Training<'a> {
    /// The training file.
    pub config: &'a TrainingConfig,
    /// Folder of the dataset.
    pub dataset: &'a Path,
    /// Folders of the datasets of free poses.
    pub free_poses: &'a [PathBuf],
    /// Scenario of the dataset, from which calibration poses are rendered; `None` for any other dataset.
    pub scenario: Option<&'a Scenario>,
    /// Folder of the checkpoint.
    pub out: &'a Path,
    /// Device of the VAE and the mixture density network. The field is trained on the CPU.
    pub device: Device,
}

impl Training<'_> {
    /// Trains `phases` and writes the trained models to the checkpoint. Finished phases are read from their saved
    /// states. A single phase requires that the phases before it are finished.
    pub fn run(&self, phases: Phases, run: &TrainingRun) -> Result<CheckpointFigures, TrainingError> {
        let config = self.config;
        carff_networks::allocator::keep_large_blocks();
        tch::set_num_threads(config.threads);
        tch::manual_seed(config.seed as i64);
        let mut posed = PosedImages::open(self.dataset, config.split_seed)?;
        let total = self.free_poses.len();
        let compared = |done: usize, line: String| {
            (run.on_progress)(&Progress { phase: "images", done, total, line });
        };
        for (done, dir) in self.free_poses.iter().enumerate() {
            compared(done, format!("comparing {}", dir.display()));
            posed.add_free_poses(dir)?;
        }
        if total > 0 {
            compared(total, "images compared".to_owned());
        }
        if let Some(view) = posed.incomplete_view() {
            return Err(TrainingError::Unfit(format!(
                "pose {view} has no image of some states; set `count` and `field_steps` of `[free_poses]`, as \
                 `configs/training/posed-set.toml` does: a field then renders what is missing"
            )));
        }
        let context = Context { config, posed: &posed, run };
        let (manifest, figures) = if posed.scenario.state_count() == 1 {
            self.train_one_state(context, phases)?
        } else {
            self.train_states(context, phases)?
        };
        save(manifest.clone(), &figures, self.out)?;
        if self.out.join(files::ENCODER).is_file() {
            carff_inference::save_encoder_onnx(self.out, &manifest, &self.out.join(carff_inference::FILE))?;
        }
        run.record(names::DONE, &DoneRecord { metrics: &figures })?;
        Ok(figures)
    }

    fn train_states(&self, context: Context, phases: Phases) -> Result<(Manifest, CheckpointFigures), TrainingError> {
        let Context { config, posed, run } = context;
        let places = places(&posed.scenario)?;
        let (vae, posteriors) = self.trained_vae(context, phases)?;
        let mut figures = CheckpointFigures {
            vae: Some(vae.figures(context, &posteriors[0], true)?),
            ..CheckpointFigures::default()
        };
        let clouds = Clouds::new(posed, &posteriors[0])?;
        let mut manifest = Manifest { places, ..new_manifest(context, clouds.states())? };
        write_vae(config, &vae, self.out)?;

        // The mixture density network is trained before the field: it is quick, and needs only the posteriors.
        let mdn = Mdn::new(config, self.device)?;
        let mixture_ready = if matches!(phases, Phases::All | Phases::Mixture) {
            drive(&mut MixturePhase::new(context, &posteriors, &mdn)?, run)?;
            true
        } else {
            run.load_finished(names::MIXTURE, config.mdn.steps, |state| mdn.restore_weights(state)).is_ok()
        };
        if mixture_ready {
            save_weights(self.out, files::MIXTURE, &mdn.weights())?;
        }

        let field = if matches!(phases, Phases::All | Phases::Field) {
            Some(trained_field(context, &clouds)?)
        } else {
            run.load(names::FIELD)?.and_then(|(_, state)| saved_field(config, &state))
        };
        if let Some(mut field) = field {
            // The saved field is the one that is evaluated.
            field.round_to_f16();
            save_field(self.out, &field)?;
            manifest.field = Some(field.config().clone());
            let (prober, calibration) = calibrated_probing(&manifest, &field, &clouds, config.seed)?;
            figures.probing =
                Some(ProbingFigures { separations: calibration.separations(), places: prober.places().len() });
            let threads = config.threads.max(1) as usize;
            if let Some(view) = birds_eye(&field, &manifest.states, &posed.dataset, threads)? {
                write_strip(run, "birds_eye.png", &view)?;
                figures.birds_eye = Some(view);
            }
            manifest.probing = Some(calibration);
        }
        if manifest.probing.is_some() && mixture_ready {
            save(manifest.clone(), &figures, self.out)?;
            let mut models = Models::load(self.out)?;
            choose_and_save_threshold(context, &mut models, self.scenario, self.out)?;
            figures.planning = Some(self.planning_figures(context, &models)?);
            figures.samples = Some(TrainedAndUnseen {
                trained: sample_figures(context, &mut models, PoseRole::Rest),
                unseen: sample_figures(context, &mut models, PoseRole::Unseen),
            });
        }
        Ok((manifest, figures))
    }

    /// The VAE and the posteriors `[copy][image]`: from the run's folder where they are there, else trained.
    fn trained_vae(&self, context: Context, phases: Phases) -> Result<(Vae, Vec<Vec<Gaussian>>), TrainingError> {
        let Context { config, posed, run } = context;
        let (poses, states) = (posed.dataset.view_count(), posed.scenario.state_count());
        let mut vae = Vae::new(config, poses, states, config.pretrained_backbone.as_deref(), self.device)?;
        let finished = run.load_finished(names::VAE, config.vae.all_epochs(), |state| vae.restore_weights(state));
        if finished.is_ok() {
            let copies = config.augmentation.copies + 1;
            if let Some(posteriors) = run.load_posteriors(copies, posed.images.len())? {
                return Ok((vae, posteriors));
            }
        }
        let inputs = match finished {
            Err(error) if matches!(phases, Phases::Field | Phases::Mixture) => return Err(error),
            finished => {
                let inputs = Inputs::new(context, &mut vae)?;
                if finished.is_err() {
                    if config.vae.one_stage_steps > 0 {
                        drive(&mut OneStagePhase::new(context, &vae, &inputs)?, run)?;
                    }
                    drive(&mut VaePhase::new(context, &vae, &inputs), run)?;
                }
                inputs
            }
        };
        let posteriors = inputs.all_posteriors(&vae)?;
        Ok((vae, posteriors))
    }

    /// Trains a dataset with one state, as imported datasets have: only the field, on one latent. Its figures are those
    /// of trained and held-out poses.
    fn train_one_state(
        &self,
        context: Context,
        phases: Phases,
    ) -> Result<(Manifest, CheckpointFigures), TrainingError> {
        if matches!(phases, Phases::Vae | Phases::Mixture) {
            return Err(TrainingError::Unfit(
                "the dataset has one state: there is nothing to encode or to forecast; train the field, with \
                 `--phase nerf`"
                    .into(),
            ));
        }
        let only = Gaussian { mean: [0.0; LATENT_DIM], log_variance: [-10.0; LATENT_DIM] };
        let clouds = Clouds::new(context.posed, &vec![only; context.posed.images.len()])?;
        let mut field = trained_field(context, &clouds)?;
        field.round_to_f16();
        save_field(self.out, &field)?;
        let mut strip = BirdsEye::default();
        let views = TrainedAndUnseen {
            trained: view_figures(context, &field, PoseRole::Rest, None),
            unseen: view_figures(context, &field, PoseRole::Unseen, Some(&mut strip)),
        };
        write_strip(context.run, "views.png", &strip)?;
        let manifest = Manifest { field: Some(field.config().clone()), ..new_manifest(context, vec![only])? };
        Ok((manifest, CheckpointFigures { views: Some(views), ..CheckpointFigures::default() }))
    }

    /// Planning tables of a checkpoint. Its threshold was chosen before; these tables choose nothing.
    fn planning_figures(&self, context: Context, models: &Models) -> Result<PlanningFigures, TrainingError> {
        let Context { config, posed, .. } = context;
        let threshold = CheckpointPlanning::load(self.out)?.hazard_threshold;
        let Models { encoder, mixture, probe, .. } = models;
        let noise = config.calibration.sensor;
        let perception = Perception { encoder, noise, seed: config.seed + 1, known: None };
        let CalibrationConfig { horizon, feedback, .. } = config.calibration;
        let sampling = Sampling::Stratified;
        let planner = Planner { net: mixture, probe, sampling, feedback, horizon };
        let table = |role| {
            let inputs = eligible_inputs(&posed.dataset, &posed.split.views(role))
                .map_err(|e| TrainingError::Unfit(e.to_string()))?;
            let trials = perception.trials(&posed.dataset, &inputs, PLANNING_REPEATS)?;
            Ok::<_, TrainingError>(planner.table(&trials, &Policy::all(threshold)).0)
        };
        Ok(PlanningFigures {
            all_views: table(PoseRole::Rest)?,
            calibration_views: table(PoseRole::Calibration)?,
            unseen_views: table(PoseRole::Unseen)?,
        })
    }
}

fn trained_field(context: Context, clouds: &Clouds) -> Result<Field, TrainingError> {
    FieldPhase::new(context, clouds, names::FIELD, context.config.nerf.trainer.steps)?.trained()
}

/// Writes the manifest with its figures.
fn save(mut manifest: Manifest, figures: &CheckpointFigures, out: &Path) -> Result<(), TrainingError> {
    manifest.metrics = serde_json::to_value(figures)
        .map_err(|e| TrainingError::Format { path: out.join(files::MANIFEST), what: e.to_string() })?;
    Ok(manifest.save(out)?)
}

/// Manifest of a checkpoint without trained models, except the states' latents.
fn new_manifest(context: Context, states: Vec<Gaussian>) -> Result<Manifest, TrainingError> {
    let Context { config, posed, .. } = context;
    let training = serde_json::to_value(config).map_err(|e| TrainingError::Format {
        path: config.out.join(files::MANIFEST),
        what: format!("`training` cannot be written: {e}; correct the training file"),
    })?;
    Ok(Manifest {
        format_version: FORMAT_VERSION,
        scenario: ScenarioIdentity::of(&posed.scenario, posed.dataset.view_count()),
        step_s: posed.scenario.step_s,
        seed: config.seed,
        split: SplitRecord {
            seed: config.split_seed,
            unseen: posed.split.views(PoseRole::Unseen),
            calibration: posed.split.views(PoseRole::Calibration),
        },
        encoder: config.encoder.clone(),
        decoder: config.decoder.clone(),
        mixture: config.mixture.clone(),
        field: None,
        states,
        places: Vec::new(),
        probing: None,
        training,
        metrics: Value::Null,
    })
}

/// Accuracy of probed samples on the unoccluded views of one role.
fn sample_figures(context: Context, models: &mut Models, role: PoseRole) -> SampleFigures {
    let Context { config, posed, .. } = context;
    let seed = config.seed + 1;
    let full = |i: &usize| posed.labels[*i].observability == Observability::Full;
    let mut inputs = Vec::new();
    for i in posed.with_roles(&[role]).into_iter().filter(full) {
        let image = config.augmentation.inputs(posed, &[i], 0, seed);
        let label = posed.labels[i];
        inputs.extend(models.encoder.encode(&image).into_iter().map(|posterior| SampleInput {
            state: label.state,
            view: label.view,
            posterior,
            frame: i as u64,
        }));
    }
    let trials = SampleTrials {
        net: &models.mixture,
        scenario: &posed.scenario,
        equivalence: &posed.equivalence,
        samples: ACCURACY_SAMPLES,
        seed,
    };
    trials.accuracy(&mut models.probe, &inputs).into()
}

/// Quality of the field on the images of one role; some of the images are added to `strip`.
fn view_figures(context: Context, field: &Field, role: PoseRole, mut strip: Option<&mut BirdsEye>) -> ViewFigures {
    let posed = context.posed;
    let mut renderer = FieldRenderer::new(context.config.threads.max(1) as usize);
    let mut psnr_db = Vec::new();
    for i in posed.with_roles(&[role]) {
        let truth = &posed.images[i];
        let values = renderer.values(field, &posed.dataset.frames()[i].camera, &[0.0; LATENT_DIM]);
        let valid = posed.dataset.valid_in_all(&[i]);
        psnr_db.extend(carff_base::statistics::psnr_where(values, &to_unit(&truth.rgb), |v| valid(v / 3)));
        let Some(strip) = &mut strip else { continue };
        let size = |t: &carff_dataset::Image| (t.width_px, t.height_px);
        if strip.truths.len() < STRIP_IMAGES && strip.truths.first().is_none_or(|t| size(t) == size(truth)) {
            strip.images.push(carff_dataset::Image { rgb: to_bytes(values), ..*truth });
            strip.truths.push(truth.clone());
        }
    }
    ViewFigures { poses: psnr_db.len(), psnr_db: carff_base::statistics::mean(&psnr_db) }
}

fn write_vae(config: &TrainingConfig, vae: &Vae, out: &Path) -> Result<(), TrainingError> {
    let (mut encoder, decoder, backbone) = vae.weights();
    match (&config.pretrained_backbone, config.encoder.backbone.frozen) {
        (Some(file), true) => {
            let target = out.join(files::BACKBONE);
            std::fs::create_dir_all(out)
                .and_then(|()| copy(file, &target))
                .map_err(|source| TrainingError::File { path: target, source })?;
        }
        _ => encoder.extend(backbone),
    }
    save_weights(out, files::ENCODER, &encoder)?;
    Ok(save_weights(out, files::DECODER, &decoder)?)
}

/// Copies a file atomically. A file is not copied onto itself, which would empty it.
fn copy(from: &Path, to: &Path) -> std::io::Result<()> {
    if to.exists() && from.canonicalize()? == to.canonicalize()? {
        return Ok(());
    }
    let partial = to.with_extension("partial");
    std::fs::copy(from, &partial)?;
    std::fs::rename(&partial, to)
}

/// Draws rendered images above true ones, one column for each.
fn write_strip(run: &TrainingRun, name: &str, view: &carff_evaluation::BirdsEye) -> Result<(), TrainingError> {
    let (Some(first), columns) = (view.images.first(), view.images.len()) else { return Ok(()) };
    let (w, h) = (first.width_px as usize, first.height_px as usize);
    let mut sheet = carff_dataset::Image {
        width_px: (w * columns) as u32,
        height_px: (h * 2) as u32,
        rgb: vec![0; w * columns * h * 2 * 3],
    };
    for (row, images) in [&view.images, &view.truths].into_iter().enumerate() {
        for (column, image) in images.iter().enumerate() {
            for y in 0..h {
                let to = ((row * h + y) * w * columns + column * w) * 3;
                sheet.rgb[to..to + w * 3].copy_from_slice(&image.rgb[y * w * 3..(y + 1) * w * 3]);
            }
        }
    }
    Ok(sheet.save_png(&run.dir.join(name))?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A copy is whole and replaces the target; a copy onto itself, also through a link, changes nothing.
    #[test]
    fn a_file_survives_its_own_copy() {
        let folder = tempfile::tempdir().unwrap();
        let [from, link, to] = ["from", "link", "to"].map(|name| folder.path().join(name));
        std::fs::write(&from, "weights").unwrap();
        std::os::unix::fs::symlink(&from, &link).unwrap();
        std::fs::write(&to, "older and longer").unwrap();
        copy(&from, &to).unwrap();
        copy(&link, &from).unwrap();
        copy(&from, &from).unwrap();
        for path in [&from, &to] {
            assert_eq!(std::fs::read_to_string(path).unwrap(), "weights");
        }
        assert!(copy(&folder.path().join("none"), &to).is_err());
    }
}
