//! Records of a run's metrics file. The names of the fields are the keys of the file.

use carff_evaluation::{CheckpointFigures, VaeFigures};
use serde::{Deserialize, Deserializer, Serialize};

/// Name of the metrics file in a run's folder: one JSON object a line.
pub const METRICS: &str = "metrics.jsonl";

/// Names of the phases in progress, saved states and metrics, and of the records that are not of a phase.
pub mod names {
    /// Pose-conditional VAE.
    pub const VAE: &str = "vae";
    /// Field.
    pub const FIELD: &str = "nerf";
    /// Mixture density network.
    pub const MIXTURE: &str = "mdn";
    /// Field that renders free poses.
    pub const FREE_POSES: &str = "free";
    /// Choice of the threshold.
    pub const THRESHOLD: &str = "threshold";
    /// Encoder and field in one stage.
    pub const ONE_STAGE: &str = "one-stage";
    /// End of the training.
    pub const DONE: &str = "done";
}

/// A line of the metrics file: a record under the name of its phase.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MetricsLine<R> {
    /// Name of the phase, one of [`names`]; the key is `stage` in files of earlier versions.
    #[serde(alias = "stage")]
    pub phase: String,
    /// The record; its keys stand next to `phase`.
    #[serde(flatten)]
    pub record: R,
}

/// Record with a place on the x axis of its curves.
pub trait Record: Serialize + for<'de> Deserialize<'de> {
    /// Epoch or step.
    fn x(&self) -> u64;
}

/// An epoch of the VAE.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VaeRecord {
    /// Epochs done.
    pub epoch: u64,
    /// Mean loss.
    #[serde(deserialize_with = "nan_for_null")]
    pub loss: f64,
    /// Mean reconstruction term.
    #[serde(deserialize_with = "nan_for_null")]
    pub reconstruction: f64,
    /// Mean KL divergence, nats.
    #[serde(deserialize_with = "nan_for_null")]
    pub kl: f64,
    /// Mean state term.
    #[serde(deserialize_with = "nan_for_null")]
    pub state: f64,
    /// Figures of the models.
    #[serde(flatten)]
    pub figures: VaeFigures,
}

/// Some steps of the mixture density network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MixtureRecord {
    /// Steps done.
    pub step: u64,
    /// Mean negative log-likelihood of the last 100 steps, nats.
    #[serde(deserialize_with = "nan_for_null")]
    pub negative_log_likelihood: f64,
}

/// Some steps of the field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldRecord {
    /// Steps done.
    pub step: u64,
    /// Running mean of the loss.
    #[serde(deserialize_with = "nan_for_null")]
    pub loss: f64,
    /// Running mean of the PSNR of rays, dB.
    #[serde(deserialize_with = "nan_for_null")]
    pub ray_psnr_db: f64,
}

/// Choice of the threshold.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ThresholdRecord {
    /// The threshold.
    pub threshold: f64,
    /// True if the trials determined it.
    pub chosen: bool,
    /// Trials.
    pub trials: usize,
    /// Hazard probabilities of the trials in which halting is correct.
    pub hazard: Vec<f64>,
    /// Hazard probabilities of the trials in which advancing is correct.
    pub clear: Vec<f64>,
}

/// End of the training.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DoneRecord<'a> {
    /// Figures of the checkpoint.
    pub metrics: &'a CheckpointFigures,
}

impl Record for VaeRecord {
    fn x(&self) -> u64 {
        self.epoch
    }
}

impl Record for MixtureRecord {
    fn x(&self) -> u64 {
        self.step
    }
}

impl Record for FieldRecord {
    fn x(&self) -> u64 {
        self.step
    }
}

/// JSON has no NaN: a diverged loss is written as null. A missing key is an error.
fn nan_for_null<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}
