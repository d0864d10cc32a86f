//! The planning table (paper section 4.3): success of each decision rule over eligible input views.

use carff_belief::{Plan, Probe, decision, hazard_probability, look_ahead};
use carff_dataset::{
    Dataset, DatasetError,
    drives::{DriveKind, EligibleInput},
    sensor::{SensorNoise, apply_noise_into},
};
use carff_models::{
    LatentGaussian,
    encoder::{Encoder, pictures_from_bytes},
    mixture::{MixtureNet, Sampling},
};
use carff_planning::Rule;
use carff_random::Key;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use tch::Tensor;

/// Numbers of samples that the table has columns for.
pub const SAMPLE_COUNTS: [usize; 3] = [2, 10, 35];

/// One trial: what the encoder made of an input view with one right answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trial {
    /// The posterior.
    pub posterior: LatentGaussian,
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
        let mut noisy = vec![0_u8; image.rgb.len()];
        for repeat in 0..repeats {
            // Frames are numbered by picture and repeat, so that no two trials share their random draws.
            let frame = (index * 1000 + repeat) as u64;
            let key = Key { seed, frame, step: 0, sample: 0 };
            if apply_noise_into(&image.rgb, &mut noisy, noise, key).is_err() {
                noisy.copy_from_slice(&image.rgb);
            }
            let picture = pictures_from_bytes(&Tensor::from_slice(&noisy).view([
                1,
                i64::from(image.height_px),
                i64::from(image.width_px),
                3,
            ]));
            trials.extend(encoder.encode(&picture).into_iter().map(|posterior| Trial {
                posterior,
                kind: input.kind,
                frame,
                seed,
            }));
        }
    }
    Ok(trials)
}

/// What was found in one trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrialOutcome {
    /// Hazard probability over the horizon, 0..=1.
    pub hazard_probability: f32,
    /// What the right action is.
    pub kind: DriveKind,
}

/// Runs every trial with every rule and number of samples. Outcomes are those of n = 10.
pub fn planning_table(
    net: &MixtureNet,
    probe: &mut Probe,
    trials: &[Trial],
    rules: &[Rule],
    sampling: Sampling,
    horizon: u32,
) -> (PlanningTable, Vec<TrialOutcome>) {
    let mut table = PlanningTable::new();
    let mut outcomes = Vec::with_capacity(trials.len());
    for trial in trials {
        for samples in SAMPLE_COUNTS {
            let plan = Plan { samples, sampling, horizon, seed: trial.seed, frame: trial.frame };
            let steps = look_ahead(net, probe, &trial.posterior, plan);
            for rule in rules {
                let right = decision(*rule, &steps).halt == (trial.kind == DriveKind::Hazard);
                table
                    .entry(rule.name().to_owned())
                    .or_default()
                    .entry(samples.to_string())
                    .or_default()
                    .entry(trial.kind.name().to_owned())
                    .or_default()
                    .add(right);
            }
            if samples == 10 {
                let hazard = steps.iter().map(|s| (s.resolved.hazard_probability, s.path_probability));
                outcomes.push(TrialOutcome { hazard_probability: hazard_probability(hazard), kind: trial.kind });
            }
        }
    }
    (table, outcomes)
}
