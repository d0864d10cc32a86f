//! Calibration of a trained checkpoint: the probing, and the threshold of the calibrated rule.

use crate::{
    TrainingError,
    augmentation::Augmentation,
    field::Clouds,
    records::{ThresholdRecord, names},
    run::Context,
};
use carff_base::random::{Key, tag};
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::Manifest;
use carff_dataset::{
    PoseRole,
    drives::{DriveKind, eligible_inputs},
};
use carff_decision::{
    CalibrationTrial, Evidence, Plan, ProbeCalibration, ProbeLayout, Sampling, choose_threshold, look_ahead,
    unchosen_threshold,
};
use carff_evaluation::{Models, Perception, Progress, Trial, trial_frame};
use carff_field::Field;
use carff_messages::LATENT_DIM;
use carff_scenes::Scenario;
use std::path::Path;

/// Latents of each known state on which the probing is calibrated.
const CALIBRATION_LATENTS: usize = 64;

/// Part of the seed of calibration trials, so that they share no draws with training or evaluation.
const CALIBRATION: u64 = tag("calibrat");

/// Calibrates the probing of a field on latents of the known states.
pub fn calibrated_probing(
    manifest: &Manifest,
    field: &Field,
    clouds: &Clouds,
    seed: u64,
) -> Result<(ProbeLayout, ProbeCalibration), TrainingError> {
    let layout = ProbeLayout::new(manifest.places.clone(), manifest.scenario.hazard_states())?;
    let places = layout.places().len();
    let mut densities = vec![0.0; layout.points().len()];
    let occupancies: Vec<Vec<f32>> = (0..layout.state_count())
        .map(|state| {
            let mut rng = carff_base::random::stream(Key::named("prob", seed, state as u64));
            let mut rows = Vec::with_capacity(CALIBRATION_LATENTS * places);
            for _ in 0..CALIBRATION_LATENTS {
                let latent: [f32; LATENT_DIM] = clouds.draw(state, 1.0, &mut rng);
                field.density(layout.points(), &latent, &mut densities);
                let mut row = vec![0.0; places];
                layout.occupancies(&densities, &mut row);
                rows.extend(row);
            }
            rows
        })
        .collect();
    let calibration = ProbeCalibration::fit(&layout, &occupancies)?;
    Ok((layout, calibration))
}

/// Chooses the threshold of the calibrated rule, and saves it in the checkpoint. The trials are free poses of
/// `scenario`, from a seed that no evaluation uses; without a scenario they are the calibration poses of the dataset.
pub fn choose_and_save_threshold(
    context: Context,
    models: &mut Models,
    scenario: Option<&Scenario>,
    out: &Path,
) -> Result<(), TrainingError> {
    let Context { config, posed, run } = context;
    let (hazards, branches) = (posed.scenario.hazard_branches.len(), posed.scenario.branches.len());
    let save = |threshold| {
        let planning = CheckpointPlanning::new(config.split_seed, threshold);
        planning.save(out).map_err(|e| TrainingError::Unfit(e.to_string()))
    };
    if hazards == 0 {
        // Without hazard states the hazard probability is always 0: any positive threshold is never reached.
        return save(0.5);
    }
    let trials = match scenario {
        Some(scenario) => free_trials(context, models, scenario)?,
        None => calibration_trials(context, models)?,
    };
    let trials = judged(context, models, &trials);
    let chosen = choose_threshold(&trials);
    let threshold = chosen.unwrap_or_else(|| unchosen_threshold(hazards, branches));
    if chosen.is_none() {
        let line = format!(
            "the calibration poses have no trial of one kind (hazard or clear), so the threshold of the calibrated \
             rule is {threshold}, half of an even belief; another `split_seed` may give trials of both kinds"
        );
        (run.on_progress)(&Progress { phase: names::THRESHOLD, done: 1, total: 1, line });
    }
    let probabilities = |halt: bool| -> Vec<f64> {
        trials.iter().filter(|t| t.halt_is_right == halt).map(|t| t.hazard_probability).collect()
    };
    let record = ThresholdRecord {
        threshold,
        chosen: chosen.is_some(),
        trials: trials.len(),
        hazard: probabilities(true),
        clear: probabilities(false),
    };
    run.record(names::THRESHOLD, &record)?;
    save(threshold)
}

/// Free poses of the scenario whose images have a right answer.
fn free_trials(context: Context, models: &Models, scenario: &Scenario) -> Result<Vec<Trial>, TrainingError> {
    let Context { config, run, .. } = context;
    let settings = &config.calibration;
    let seed = config.seed ^ CALIBRATION;
    let perception = Perception { encoder: &models.encoder, noise: settings.sensor, seed, known: None };
    let mut trials = Vec::new();
    for number in 0..settings.free_poses {
        if run.stopped() {
            return Err(TrainingError::Stopped);
        }
        let pose = scenario.free_pose(number as u64, seed).map_err(|e| TrainingError::Unfit(e.to_string()))?;
        for (branch, view) in pose.views.iter().enumerate() {
            if let Some(kind) = scenario.info().trial_kind(branch, pose.timestamp, view.observability) {
                trials.extend(perception.trial((&pose.camera, &view.image), kind, trial_frame(number, branch)));
            }
        }
    }
    Ok(trials)
}

/// Images of the calibration poses. Images are augmented as in training: a threshold from unaugmented
/// training images would be too narrow for other images.
fn calibration_trials(context: Context, models: &Models) -> Result<Vec<Trial>, TrainingError> {
    let Context { config, posed, .. } = context;
    let settings = &config.calibration;
    let inputs = eligible_inputs(&posed.dataset, &posed.split.views(PoseRole::Calibration))
        .map_err(|e| TrainingError::Unfit(e.to_string()))?;
    let augmentation = Augmentation { sensor: settings.sensor, ..config.augmentation.clone() };
    // Another seed than in training, so that no image is augmented as in training.
    let augmentation_seed = config.seed ^ CALIBRATION;
    let mut trials = Vec::with_capacity(inputs.len() * settings.repeats);
    for input in &inputs {
        let state = posed.scenario.state(input.branch, input.timestamp);
        let Some(index) = state.and_then(|state| posed.dataset.frame_index(state, input.view)) else { continue };
        for repeat in 0..settings.repeats {
            let image = augmentation.inputs(posed, &[index], repeat, augmentation_seed);
            let (kind, frame, seed) = (input.kind, trial_frame(index, repeat), config.seed);
            let posteriors = models.encoder.encode(&image).into_iter();
            trials.extend(posteriors.map(|posterior| Trial {
                posterior,
                image: None,
                remembered: None,
                kind,
                frame,
                seed,
            }));
        }
    }
    Ok(trials)
}

/// Hazard probabilities of trials.
fn judged(context: Context, models: &mut Models, trials: &[Trial]) -> Vec<CalibrationTrial> {
    let settings = &context.config.calibration;
    let Models { mixture, probe, .. } = models;
    let (samples, horizon) = (settings.samples, settings.horizon);
    let (sampling, feedback) = (Sampling::Stratified, settings.feedback);
    let judge = |trial: &Trial| {
        let plan = Plan { samples, sampling, feedback, horizon, seed: trial.seed, frame: trial.frame };
        let steps = look_ahead(|input, _| mixture.forecast(input), probe, &trial.posterior, None, plan);
        let hazard_probability = Evidence::of_steps(&steps).hazard_probability();
        CalibrationTrial { hazard_probability, halt_is_right: trial.kind == DriveKind::Hazard }
    };
    trials.iter().map(judge).collect()
}
