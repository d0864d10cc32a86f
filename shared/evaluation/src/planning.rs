//! The planning table (paper section 4.3): success of each decision rule over eligible input views.

use carff_checkpoint::FieldProbe;
use carff_dataset::{
    Dataset, DatasetError, Image,
    drives::{DriveKind, EligibleInput},
    sensor::{SensorNoise, apply_noise_into},
};
use carff_decision::{Evidence, Plan, Policy, Sampling, look_ahead};
use carff_messages::Gaussian;
use carff_models::{
    encoder::{Encoder, pictures_from_bytes},
    mixture::MixtureNet,
};
use carff_random::Key;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use tch::Tensor;

/// Numbers of samples that the table has columns for.
pub const SAMPLE_COUNTS: [usize; 3] = [2, 10, 35];

/// One trial: what the encoder made of an input view with one right answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// The posterior.
    pub posterior: Gaussian,
    /// What the right action is.
    pub kind: DriveKind,
    /// The frame's number: it names the random draws of this trial.
    pub frame: u64,
    /// The run's seed.
    pub seed: u64,
}

/// Successes out of trials, with a 95 % Wilson interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Count {
    /// Right actions.
    pub success: usize,
    /// Trials.
    pub trials: usize,
    /// 95 % interval of the success rate, `[low, high]`.
    pub interval: [f64; 2],
}

impl Count {
    /// Counts one trial.
    pub fn add(&mut self, right: bool) {
        self.trials += 1;
        self.success += usize::from(right);
        self.interval = carff_metrics::wilson_interval(self.success, self.trials);
    }
}

/// Success by rule, number of samples (as text, for JSON), and kind of trial (`hazard`, `clear`).
pub type PlanningTable = BTreeMap<String, BTreeMap<String, BTreeMap<String, Count>>>;

/// Takes each input's picture `repeats` times, with fresh sensor noise, through the encoder.
pub fn trials(
    encoder: &Encoder,
    dataset: &Dataset,
    inputs: &[EligibleInput],
    repeats: usize,
    noise: &SensorNoise,
    seed: u64,
) -> Result<Vec<Trial>, DatasetError> {
    let mut trials = Vec::with_capacity(inputs.len() * repeats);
    let timestamps = dataset.scenario().map_or(1, |s| s.timestamps);
    for input in inputs {
        let Some(index) = dataset.frame_index(input.branch * timestamps + input.timestamp, input.view) else {
            continue;
        };
        let image = dataset.load_image(index)?;
        for repeat in 0..repeats {
            // Frames are numbered by picture and repeat, so that no two trials share their random draws.
            trials.extend(trial(encoder, &image, input.kind, noise, seed, (index * 1000 + repeat) as u64));
        }
    }
    Ok(trials)
}

/// Takes one picture, with sensor noise, through the encoder. `frame` names its random draws.
pub fn trial(
    encoder: &Encoder,
    image: &Image,
    kind: DriveKind,
    noise: &SensorNoise,
    seed: u64,
    frame: u64,
) -> Option<Trial> {
    let mut noisy = vec![0_u8; image.rgb.len()];
    if apply_noise_into(&image.rgb, &mut noisy, noise, Key { seed, frame, step: 0, sample: 0 }).is_err() {
        noisy.copy_from_slice(&image.rgb);
    }
    let sides = [1, i64::from(image.height_px), i64::from(image.width_px), 3];
    let posterior = encoder.encode(&pictures_from_bytes(&Tensor::from_slice(&noisy).view(sides))).into_iter().next()?;
    Some(Trial { posterior, kind, frame, seed })
}

/// What was found in one trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrialOutcome {
    /// Hazard probability over the horizon, 0..=1.
    pub hazard_probability: f32,
    /// What the right action is.
    pub kind: DriveKind,
}

/// Index of a rule, index of a number of samples, and whether it halted.
type Halt = (usize, usize, bool);

/// Runs every trial with every rule and number of samples, on all threads of rayon's pool. Outcomes, in the order of
/// the trials, are those of n = 10.
pub fn planning_table(
    net: &MixtureNet,
    probe: &FieldProbe,
    trials: &[Trial],
    policies: &[Policy],
    sampling: Sampling,
    horizon: u32,
) -> (PlanningTable, Vec<TrialOutcome>) {
    let posteriors: Vec<Gaussian> = trials.iter().map(|t| t.posterior).collect();
    let first = if posteriors.is_empty() { Vec::new() } else { net.forecast_all(&posteriors) };
    let later = net.forecast_all(probe.states());
    let results: Vec<(Vec<Halt>, TrialOutcome)> = trials
        .par_iter()
        .zip(&first)
        .map_init(
            || probe.clone(),
            |probe, (trial, mixture)| {
                let mut actions = Vec::with_capacity(SAMPLE_COUNTS.len() * policies.len());
                let mut outcome = TrialOutcome { hazard_probability: 0.0, kind: trial.kind };
                for (column, samples) in SAMPLE_COUNTS.into_iter().enumerate() {
                    let plan = Plan { samples, sampling, horizon, seed: trial.seed, frame: trial.frame };
                    let forecast = |_: &Gaussian, state: Option<usize>| state.map_or(mixture, |s| &later[s]).clone();
                    let steps = look_ahead(forecast, probe, &trial.posterior, plan);
                    let evidence = Evidence::of_steps(&steps);
                    let halts = policies.iter().map(|policy| policy.decide(&evidence).halt);
                    actions.extend(halts.enumerate().map(|(rule, halt)| (rule, column, halt)));
                    if samples == 10 {
                        outcome.hazard_probability = evidence.hazard_probability() as f32;
                    }
                }
                (actions, outcome)
            },
        )
        .collect();
    let mut table = PlanningTable::new();
    for (actions, outcome) in &results {
        for &(rule, column, halted) in actions {
            let right = halted == (outcome.kind == DriveKind::Hazard);
            count(&mut table, policies[rule].rule.name(), SAMPLE_COUNTS[column], outcome.kind, right);
        }
    }
    (table, results.into_iter().map(|(_, outcome)| outcome).collect())
}

/// Counts one trial of a rule.
pub fn count(table: &mut PlanningTable, rule: &str, samples: usize, kind: DriveKind, right: bool) {
    let by_samples = table.entry(rule.to_owned()).or_default();
    let by_kind = by_samples.entry(samples.to_string()).or_default();
    by_kind.entry(kind.name().to_owned()).or_default().add(right);
}
