//! A trained scenario on disk: manifest and weights.
//!
//! A checkpoint is a folder with `manifest.json` and weights as safetensors. The manifest records the scenario, the
//! training and its results. A checkpoint contains no code. Contents that do not match are an error that names the key.
//! This crate reads the field's weights. `carff_networks` reads the weights of the tch networks, so that programs
//! without them do not link libtorch.
//!
//! ```
//! use carff_checkpoint::{Manifest, load_field_probe};
//! # let dir = std::path::Path::new("../../configs/checkpoints/approaching-intersection");
//! let manifest = Manifest::load(dir)?;
//! let mut probe = load_field_probe(dir, &manifest)?;
//! // Each known state's latent shows this state.
//! let found = probe.probe(&manifest.states[2].mean);
//! assert_eq!(found.reading.state, Some(2));
//! # Ok::<(), carff_checkpoint::CheckpointError>(())
//! ```

pub mod backbones;
mod field;
mod networks;
mod planning;
mod probe;
pub mod shapes;
mod tensors;

pub use field::{load_field, save_field};
pub use networks::{Encodes, Forecasts};
pub use planning::{
    Bound, CheckpointPlanning, CheckpointPlanningError, OccupancyRates, PlanningMemory, StepRates, load_policy,
};
pub use probe::{FieldProbe, PreparedField, load_field_probe, load_probing};
pub use tensors::{StoredTensor, read_tensors};

use carff_dataset::{ScenarioInfo, sensor::SensorNoise};
use carff_decision::{Feedback, Place, ProbeCalibration, ProbingError};
use carff_field::FieldConfig;
use carff_messages::{Gaussian, MAX_PLACES, MAX_STATES};
use serde::{Deserialize, Serialize};
use shapes::{DecoderConfig, EncoderConfig, MixtureConfig};
use std::path::{Path, PathBuf};

// The field knows no messages: its latent has the same size as theirs.
const _: () = assert!(carff_field::LATENT_DIM == carff_messages::LATENT_DIM);

/// Version of the format that this program writes and reads.
pub const FORMAT_VERSION: u32 = 1;
/// Maximum size of a manifest.
const MAX_MANIFEST_BYTES: u64 = 16 << 20;

/// Reason why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file could not be read or written.
    #[error(
        "checkpoint {path}: {source}; train it with `carff train`, or name another with --checkpoint{}",
        carff_base::names::beside(path)
    )]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The manifest is not valid.
    #[error("checkpoint {path}: {what}")]
    Manifest {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        what: String,
    },
    /// The checkpoint's scenario differs from the dataset's.
    #[error("checkpoint {path} is of another scenario: `{key}` is {trained} there, and {given} in the dataset")]
    Scenario {
        /// Path of the manifest.
        path: PathBuf,
        /// Name of the key that differs.
        key: &'static str,
        /// Value in the checkpoint.
        trained: String,
        /// Value in the dataset.
        given: String,
    },
    /// A part is missing: its training phase has not run.
    #[error("checkpoint {path} has no {part}: run `carff train --phase {phase}`")]
    Missing {
        /// Path of the checkpoint.
        path: PathBuf,
        /// Name of the missing part.
        part: &'static str,
        /// Training phase of the part.
        phase: &'static str,
    },
    /// A weights file cannot be read or written, or does not fit.
    #[error("checkpoint {path}: {what}")]
    Weights {
        /// Path of the checkpoint.
        path: PathBuf,
        /// Description of the error, with the file.
        what: String,
    },
    /// The field's weights do not match.
    #[error("checkpoint {path}: {source}")]
    Field {
        /// Path of the checkpoint.
        path: PathBuf,
        /// Error of the field.
        source: carff_field::FieldError,
    },
    /// The probing section is not valid.
    #[error("checkpoint {path}: {source}")]
    Probing {
        /// Path of the checkpoint.
        path: PathBuf,
        /// Error of the section.
        source: ProbingError,
    },
}

/// Identity of a scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScenarioIdentity {
    /// Name of the scenario.
    pub name: String,
    /// Names of the branches.
    pub branches: Vec<String>,
    /// Number of time steps per branch.
    pub timestamps: usize,
    /// Branches in which the hazard action is right.
    pub hazard_branches: Vec<usize>,
    /// First time step at which a hazard branch is a hazard.
    #[serde(default, skip_serializing_if = "shapes::is_zero")]
    pub hazard_from_timestamp: usize,
    /// Number of fixed camera poses.
    pub poses: usize,
}

impl ScenarioIdentity {
    /// Returns the identity of a dataset's scenario.
    pub fn of(scenario: &ScenarioInfo, poses: usize) -> Self {
        Self {
            name: scenario.name.clone(),
            branches: scenario.branches.clone(),
            timestamps: scenario.timestamps,
            hazard_branches: scenario.hazard_branches.clone(),
            hazard_from_timestamp: scenario.hazard_from_timestamp,
            poses,
        }
    }

    /// Returns the number of states.
    pub fn state_count(&self) -> usize {
        self.branches.len() * self.timestamps
    }

    /// Returns the name of each state: its branch and its time step.
    pub fn state_names(&self) -> Vec<String> {
        self.branches.iter().flat_map(|b| (0..self.timestamps).map(move |t| format!("{b}, t{t}"))).collect()
    }

    /// Returns for each state whether it is a hazard: it belongs to a hazard branch, at or after its first such time step.
    ///
    /// ```
    /// use carff_checkpoint::ScenarioIdentity;
    /// let identity = ScenarioIdentity {
    ///     name: "open-branch".into(),
    ///     branches: vec!["crosses".into(), "turns".into()],
    ///     timestamps: 2,
    ///     hazard_branches: vec![0],
    ///     hazard_from_timestamp: 1,
    ///     poses: 100,
    /// };
    /// assert_eq!(identity.hazard_states(), [false, true, false, false]);
    /// ```
    pub fn hazard_states(&self) -> Vec<bool> {
        let steps = self.timestamps.max(1);
        let is_hazard =
            |s: usize| self.hazard_branches.contains(&(s / steps)) && s % steps >= self.hazard_from_timestamp;
        (0..self.state_count()).map(is_hazard).collect()
    }
}

/// Split of the poses for training.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitRecord {
    /// Seed of the split.
    pub seed: u64,
    /// Held-out poses.
    pub unseen: Vec<usize>,
    /// Training poses that are used for thresholds and choices.
    pub calibration: Vec<usize>,
}

/// The manifest: scenario, split, network shapes, states, training and results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of this format.
    pub format_version: u32,
    /// The scenario.
    pub scenario: ScenarioIdentity,
    /// Duration of a time step, seconds, if the scenario has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step_s: Option<f64>,
    /// Seed of the training.
    pub seed: u64,
    /// Split of the poses for training.
    pub split: SplitRecord,
    /// Shape of the encoder.
    pub encoder: EncoderConfig,
    /// Shape of the decoder.
    pub decoder: DecoderConfig,
    /// Shape of the mixture density network.
    pub mixture: MixtureConfig,
    /// Structure of the field, once it is trained.
    pub field: Option<FieldConfig>,
    /// Posterior of each known state, which a resolved state feeds back.
    pub states: Vec<Gaussian>,
    /// Places to probe.
    pub places: Vec<Place>,
    /// Calibration of the places' occupancy, once the field is trained.
    pub probing: Option<ProbeCalibration>,
    /// The training file, as used.
    pub training: serde_json::Value,
    /// Results by training phase.
    pub metrics: serde_json::Value,
}

/// The settings of the training file that programs of a checkpoint take over.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct TrainedWith {
    /// Folder of the training dataset.
    pub dataset: PathBuf,
    /// Scenario file that the dataset was rendered from.
    pub scenario: Option<PathBuf>,
    /// Settings of the calibration.
    pub calibration: CalibratedWith,
    /// Settings of the encoder's training.
    pub vae: VaeTrainedWith,
}

/// The settings of a checkpoint's calibration.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct CalibratedWith {
    /// Noise of the sensor.
    pub sensor: SensorNoise,
    /// Input of each further step of the look-ahead.
    #[serde(default)]
    pub feedback: Feedback,
    /// Steps of the look-ahead, 1..=[`MAX_HORIZON`](carff_messages::MAX_HORIZON).
    pub horizon: u32,
}

/// The settings of an encoder's training.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct VaeTrainedWith {
    /// True if the decoder decodes what an image adds to its pose's mean image.
    pub residual: bool,
}

/// File names in a checkpoint.
pub mod files {
    /// Name of the manifest.
    pub const MANIFEST: &str = "manifest.json";
    /// Name of the frozen backbone's weights.
    pub const BACKBONE: &str = "backbone.safetensors";
    /// Name of the encoder head's weights.
    pub const ENCODER: &str = "encoder.safetensors";
    /// Name of the decoder's weights.
    pub const DECODER: &str = "decoder.safetensors";
    /// Name of the mixture density network's weights.
    pub const MIXTURE: &str = "mixture.safetensors";
    /// Name of the field's weights.
    pub const FIELD: &str = "field.safetensors";
    /// Names of all files with weights. Checkpoints may share them through links.
    pub const WEIGHTS: [&str; 5] = [BACKBONE, ENCODER, DECODER, MIXTURE, FIELD];
}

impl Manifest {
    /// Reads the manifest of a checkpoint and checks that its parts agree.
    pub fn load(dir: &Path) -> Result<Self, CheckpointError> {
        let path = dir.join(files::MANIFEST);
        let file = |source| CheckpointError::File { path: path.clone(), source };
        let wrong = |what: String| CheckpointError::Manifest { path: path.clone(), what };
        let is_broken = |name: &&&str| dir.join(name).is_symlink() && !dir.join(name).exists();
        if let Some(name) = files::WEIGHTS.iter().find(is_broken) {
            return Err(wrong(format!("`{name}` is a link to a missing file; copy checkpoints with `cp -rL`")));
        }
        let size = std::fs::metadata(&path).map_err(file)?.len();
        if size > MAX_MANIFEST_BYTES {
            return Err(wrong(format!("{size} bytes; at most {MAX_MANIFEST_BYTES} are allowed")));
        }
        let text = std::fs::read_to_string(&path).map_err(file)?;
        // The version is checked first: in another format, any other key may differ.
        let value: serde_json::Value = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        match value.get("format_version").and_then(serde_json::Value::as_u64) {
            Some(v) if v == u64::from(FORMAT_VERSION) => {}
            found => {
                let found = found.map_or("missing".to_owned(), |v| v.to_string());
                return Err(wrong(format!(
                    "`format_version` is {found}, this program reads {FORMAT_VERSION}; train the checkpoint again"
                )));
            }
        }
        let manifest: Self = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        manifest.check().map_err(wrong)?;
        Ok(manifest)
    }

    /// Returns the training settings that programs of the checkpoint in `dir` take over.
    pub fn trained_with(&self, dir: &Path) -> Result<TrainedWith, CheckpointError> {
        TrainedWith::deserialize(&self.training).map_err(|e| CheckpointError::Manifest {
            path: dir.join(files::MANIFEST),
            what: format!("`training`: {e}; make the checkpoint again with `carff train`"),
        })
    }

    fn check(&self) -> Result<(), String> {
        let states = self.scenario.state_count();
        if !(1..=MAX_STATES).contains(&states) {
            return Err(format!("`scenario` has {states} states; 1 to {MAX_STATES} are allowed"));
        }
        if let Some(b) = self.scenario.hazard_branches.iter().find(|b| **b >= self.scenario.branches.len()) {
            return Err(format!(
                "`scenario.hazard_branches` names branch {b}, there are {}",
                self.scenario.branches.len()
            ));
        }
        let (from, steps) = (self.scenario.hazard_from_timestamp, self.scenario.timestamps);
        if from > 0 && from >= steps {
            return Err(format!("`scenario.hazard_from_timestamp` is {from}, there are {steps} time steps"));
        }
        if self.states.len() != states {
            return Err(format!("`states` has {} entries, the scenario {states}", self.states.len()));
        }
        let finite = |g: &Gaussian| g.mean.iter().chain(&g.log_variance).all(|v| v.is_finite());
        if !self.states.iter().all(finite) {
            return Err("`states` has a number that is not finite".into());
        }
        if self.places.len() > MAX_PLACES {
            return Err(format!("`places` has {} entries; at most {MAX_PLACES} are allowed", self.places.len()));
        }
        Ok(())
    }

    /// Writes the manifest atomically.
    pub fn save(&self, dir: &Path) -> Result<(), CheckpointError> {
        let path = dir.join(files::MANIFEST);
        let file = |source| CheckpointError::File { path: path.clone(), source };
        let text = serde_json::to_string_pretty(self)
            .map_err(|e| CheckpointError::Manifest { path: path.clone(), what: e.to_string() })?;
        let partial = path.with_extension("partial");
        std::fs::create_dir_all(dir).map_err(file)?;
        std::fs::write(&partial, text + "\n").map_err(file)?;
        std::fs::rename(&partial, &path).map_err(file)
    }

    /// Checks that a dataset's scenario matches the trained one; the error names the key that differs.
    pub fn check_scenario(&self, dir: &Path, given: &ScenarioIdentity) -> Result<(), CheckpointError> {
        let trained = &self.scenario;
        let show = |key, a: &dyn std::fmt::Debug, b: &dyn std::fmt::Debug| CheckpointError::Scenario {
            path: dir.join(files::MANIFEST),
            key,
            trained: format!("{a:?}"),
            given: format!("{b:?}"),
        };
        if trained.name != given.name {
            return Err(show("scenario.name", &trained.name, &given.name));
        }
        if trained.branches != given.branches {
            return Err(show("scenario.branches", &trained.branches, &given.branches));
        }
        if trained.timestamps != given.timestamps {
            return Err(show("scenario.timestamps", &trained.timestamps, &given.timestamps));
        }
        if trained.hazard_branches != given.hazard_branches {
            return Err(show("scenario.hazard_branches", &trained.hazard_branches, &given.hazard_branches));
        }
        if trained.hazard_from_timestamp != given.hazard_from_timestamp {
            let [trained, given] = [trained, given].map(|identity| identity.hazard_from_timestamp);
            return Err(show("scenario.hazard_from_timestamp", &trained, &given));
        }
        if trained.poses != given.poses {
            return Err(show("scenario.poses", &trained.poses, &given.poses));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A checkpoint that was copied without the files that its links name is refused, with the remedy.
    #[test]
    fn a_broken_link_is_named() {
        let folder = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink("../backbones/none.safetensors", folder.path().join(files::BACKBONE)).unwrap();
        let error = Manifest::load(folder.path()).unwrap_err().to_string();
        assert!(error.contains("`backbone.safetensors` is a link") && error.contains("cp -rL"), "{error}");
    }
}
