//! Calibration of a trained checkpoint: the probing, and the threshold of the calibrated rule.

use crate::{
    TrainingError,
    augmentation::Augmentation,
    field::Clouds,
    records::{ThresholdRecord, names},
    run::Context,
};
use carff_belief::{Plan, hazard_probability, look_ahead};
use carff_checkpoint::Manifest;
use carff_config::CheckpointPlanning;
use carff_dataset::{
    PoseRole,
    drives::{DriveKind, eligible_inputs},
};
use carff_evaluation::{Models, Progress, Trial, trial_frame};
use carff_field::Field;
use carff_latent::{LATENT_DIM, Sampling};
use carff_planning::{CalibrationTrial, choose_threshold, unchosen_threshold};
use carff_probing::{Calibration, Prober};
use carff_random::{Key, tag};
use std::path::Path;

/// Latents of each known state on which the probing is calibrated.
const CALIBRATION_LATENTS: usize = 64;

/// Calibrates the probing of a field on latents of the known states.
pub fn calibrated_probing(
    manifest: &Manifest,
    field: &Field,
    clouds: &Clouds,
    seed: u64,
) -> Result<(Prober, Calibration), TrainingError> {
    let prober = Prober::new(manifest.places.clone(), manifest.scenario.hazard_states())?;
    let places = prober.places().len();
    let mut densities = vec![0.0; prober.points().len()];
    let occupancies: Vec<Vec<f32>> = (0..prober.state_count())
        .map(|state| {
            let mut rng = carff_random::stream(Key::named("prob", seed, state as u64));
            let mut rows = Vec::with_capacity(CALIBRATION_LATENTS * places);
            for _ in 0..CALIBRATION_LATENTS {
                let latent: [f32; LATENT_DIM] = clouds.draw(state, 1.0, &mut rng);
                field.density(prober.points(), &latent, &mut densities);
                let mut row = vec![0.0; places];
                prober.occupancies(&densities, &mut row);
                rows.extend(row);
            }
            rows
        })
        .collect();
    let calibration = Calibration::fit(&prober, &occupancies)?;
    Ok((prober, calibration))
}

/// Chooses the threshold of the calibrated rule on the calibration poses, and saves it in the checkpoint.
pub fn choose_and_save_threshold(context: Context, models: &mut Models, out: &Path) -> Result<(), TrainingError> {
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
    let trials = calibration_trials(context, models)?;
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

/// Hazard probabilities of the calibration poses. Images are augmented as in training: a threshold from unaugmented
/// training images would be too narrow for other images.
fn calibration_trials(context: Context, models: &mut Models) -> Result<Vec<CalibrationTrial>, TrainingError> {
    let Context { config, posed, .. } = context;
    let settings = &config.calibration;
    let inputs = eligible_inputs(&posed.dataset, &posed.split.views(PoseRole::Calibration))
        .map_err(|e| TrainingError::Unfit(e.to_string()))?;
    let augmentation = Augmentation { sensor: settings.sensor, ..config.augmentation.clone() };
    // Another seed than in training, so that no image is augmented as in training.
    let augmentation_seed = config.seed ^ tag("calibrat");
    let mut trials = Vec::with_capacity(inputs.len() * settings.repeats);
    for input in &inputs {
        let state = posed.scenario.state(input.branch, input.timestamp);
        let Some(index) = state.and_then(|state| posed.dataset.frame_index(state, input.view)) else { continue };
        for repeat in 0..settings.repeats {
            let image = augmentation.inputs(posed, &[index], repeat, augmentation_seed);
            let (kind, frame, seed) = (input.kind, trial_frame(index, repeat), config.seed);
            let posteriors = models.encoder.encode(&image).into_iter();
            trials.extend(posteriors.map(|posterior| Trial { posterior, kind, frame, seed }));
        }
    }
    let Models { mixture, probe, .. } = models;
    let (samples, horizon, sampling) = (settings.samples, settings.horizon, Sampling::Stratified);
    let judged = trials.iter().map(|trial| {
        let plan = Plan { samples, sampling, horizon, seed: trial.seed, frame: trial.frame };
        let steps = look_ahead(|input, _| mixture.forecast(input), probe, &trial.posterior, plan);
        let hazard = hazard_probability(steps.iter().map(|s| (s.resolved.hazard_probability, s.path_probability)));
        CalibrationTrial { hazard_probability: f64::from(hazard), halt_is_right: trial.kind == DriveKind::Hazard }
    });
    Ok(judged.collect())
}
