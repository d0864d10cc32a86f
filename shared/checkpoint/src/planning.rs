//! The part of a checkpoint for stages without models: the split of the poses and the calibrated threshold.

use carff_decision::{MemorySettings, Policy};
use carff_messages::{MAX_HORIZON, Rule};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// File name in a checkpoint folder.
const FILE: &str = "planning.json";
/// Version of the file's format.
const FORMAT_VERSION: u32 = 1;

/// Contents of a checkpoint's `planning.json`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointPlanning {
    /// Format of this file; 1.
    pub format_version: u32,
    /// Seed of the split into held-out, calibration and other poses.
    pub split_seed: u64,
    /// Hazard probability from which on the calibrated rule halts, 0 to 1; chosen on the calibration poses.
    pub hazard_threshold: f64,
    /// Bound that the threshold keeps, if it was chosen by one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<Bound>,
    /// The belief's memory, if it was learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub memory: Option<PlanningMemory>,
    /// Rates of the occupancy grid at each step of the look-ahead, if they were learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub occupancy: Option<StepRates>,
}

/// Rates of the occupancy grid at each step of the look-ahead, from the first.
pub type StepRates = [OccupancyRates; MAX_HORIZON as usize];

/// Shares of the cells on the other vehicles' lane that are taken when a step of the look-ahead has come, by what the
/// belief states. Vehicles are anywhere on their lane, and known states have them at a few places.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OccupancyRates {
    /// Share of the cells that are free in the known state, 0 to 1.
    pub where_free: f64,
    /// Share of the cells that a vehicle takes in the known state, 0 to 1.
    pub where_taken: f64,
}

impl OccupancyRates {
    /// The rates of states that hold exactly.
    pub const EXACT: Self = Self { where_free: 0.0, where_taken: 1.0 };

    /// Returns the probability that a cell is taken, from the belief that it is, 0..=1.
    ///
    /// ```
    /// use carff_checkpoint::OccupancyRates;
    /// let rates = OccupancyRates { where_free: 0.1, where_taken: 0.6 };
    /// assert_eq!((rates.of(0.0), rates.of(1.0)), (0.1, 0.6));
    /// assert_eq!(OccupancyRates::EXACT.of(0.3), 0.3);
    /// ```
    pub fn of(self, believed: f64) -> f64 {
        self.where_free + (self.where_taken - self.where_free) * believed
    }
}

/// Memory of the belief, with the threshold of the calibrated rule for it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanningMemory {
    /// Learned numbers.
    pub settings: MemorySettings,
    /// Hazard probability from which on the calibrated rule halts, 0 to 1; the threshold without memory if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hazard_threshold: Option<f64>,
    /// Bound that the threshold keeps over all frames of a drive.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<Bound>,
}

/// Bound on the calibrated rule: at most a share `level` of the drives with a hazard are answered with `advance`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bound {
    /// Largest share, 0 to 1.
    pub level: f64,
    /// Probability, over the draw of the calibration drives, that the bound holds.
    pub confidence: f64,
    /// Calibration drives with a hazard.
    pub drives: usize,
    /// Calibration drives with a hazard that the threshold answers with `advance`.
    pub advances: usize,
}

/// Returns the policy of a rule: with `threshold` if given, else with the checkpoint's threshold, with or without a
/// memory. Only the calibrated rule reads the threshold.
///
/// # Errors
///
/// The calibrated rule has no given threshold, and `planning.json` cannot be used.
pub fn load_policy(
    rule: Rule,
    threshold: Option<f64>,
    checkpoint: &Path,
    remembers: bool,
) -> Result<Policy, CheckpointPlanningError> {
    let threshold = match (rule, threshold) {
        (_, Some(threshold)) => threshold,
        (Rule::Calibrated, None) => CheckpointPlanning::load(checkpoint)?.threshold(remembers),
        (_, None) => 1.0,
    };
    Ok(Policy::new(rule, threshold))
}

/// Reason why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointPlanningError {
    /// The file cannot be read or written.
    #[error("{path}: {source}; is this the folder of a checkpoint that `carff train` made?")]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file's contents are not valid.
    #[error("{path}: {problem}; make the checkpoint again with `carff train`")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        problem: String,
    },
}

impl CheckpointPlanning {
    /// Creates the contents with the current format version.
    pub fn new(split_seed: u64, hazard_threshold: f64) -> Self {
        Self {
            format_version: FORMAT_VERSION,
            split_seed,
            hazard_threshold,
            bound: None,
            memory: None,
            occupancy: None,
        }
    }

    /// Returns the threshold of the calibrated rule, with or without a memory.
    pub fn threshold(&self, remembers: bool) -> f64 {
        let of_memory = self.memory.filter(|_| remembers).and_then(|memory| memory.hazard_threshold);
        of_memory.unwrap_or(self.hazard_threshold)
    }

    /// Reads and checks the file of a checkpoint folder.
    pub fn load(checkpoint: &Path) -> Result<Self, CheckpointPlanningError> {
        let path = checkpoint.join(FILE);
        let format = |problem: String| CheckpointPlanningError::Format { path: path.clone(), problem };
        let text = std::fs::read_to_string(&path)
            .map_err(|source| CheckpointPlanningError::Io { path: path.clone(), source })?;
        let planning: Self = serde_json::from_str(&text).map_err(|e| format(e.to_string()))?;
        if planning.format_version != FORMAT_VERSION {
            let found = planning.format_version;
            return Err(format(format!("`format_version` is {found}, this program reads {FORMAT_VERSION}")));
        }
        for threshold in [planning.hazard_threshold, planning.threshold(true)] {
            if !(0.0..=1.0).contains(&threshold) {
                return Err(format(format!("`hazard_threshold` is {threshold}; allowed: 0 to 1")));
            }
        }
        for rates in planning.occupancy.iter().flatten() {
            if ![rates.where_free, rates.where_taken].iter().all(|rate| (0.0..=1.0).contains(rate)) {
                return Err(format(format!("`occupancy` has the rates {rates:?}; allowed: 0 to 1")));
            }
        }
        Ok(planning)
    }

    /// Writes the file into a checkpoint folder.
    pub fn save(&self, checkpoint: &Path) -> Result<(), CheckpointPlanningError> {
        let path = checkpoint.join(FILE);
        let text = serde_json::to_string_pretty(self)
            .map_err(|e| CheckpointPlanningError::Format { path: path.clone(), problem: e.to_string() })?;
        std::fs::write(&path, text + "\n").map_err(|source| CheckpointPlanningError::Io { path, source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Manifest;
    use carff_decision::ImageEvidence;

    /// No shipped threshold lets a vehicle advance while a hazard can be hidden: a place that the encoder takes for clear
    /// and one state with the hazard explains, too. A given threshold is used unchanged.
    #[test]
    fn shipped_thresholds_respect_a_hidden_hazard() {
        let checkpoints = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/checkpoints");
        for name in ["approaching-intersection", "two-lane-merge"] {
            let checkpoint = checkpoints.join(name);
            let states = Manifest::load(&checkpoint).unwrap().scenario.hazard_states();
            let limit = ImageEvidence::hidden_hazard(&states, 1);
            let threshold = |given| load_policy(Rule::Calibrated, given, &checkpoint, false).unwrap().threshold;
            assert!(threshold(None) <= limit, "{name}: {} of {limit}", threshold(None));
            assert_eq!(threshold(Some(0.3)), 0.3);
        }
    }

    /// A saved file is loaded unchanged; a missing file, another version and a bad threshold name the file and the key.
    #[test]
    fn round_trip_and_errors() {
        let folder = tempfile::tempdir().unwrap();
        let missing = CheckpointPlanning::load(folder.path()).unwrap_err().to_string();
        assert!(missing.contains(FILE) && missing.contains("carff train"), "{missing}");
        let occupancy = Some([OccupancyRates { where_free: 0.1, where_taken: 0.4 }; MAX_HORIZON as usize]);
        let planning = CheckpointPlanning { occupancy, ..CheckpointPlanning::new(7, 0.25) };
        planning.save(folder.path()).unwrap();
        assert_eq!(CheckpointPlanning::load(folder.path()).unwrap(), planning);
        let wrong_rates = OccupancyRates { where_free: -0.1, where_taken: 1.0 };
        for (wrong, key) in [
            (CheckpointPlanning { format_version: 2, ..planning }, "format_version"),
            (CheckpointPlanning { hazard_threshold: 1.5, ..planning }, "hazard_threshold"),
            (CheckpointPlanning { occupancy: Some([wrong_rates; MAX_HORIZON as usize]), ..planning }, "occupancy"),
        ] {
            wrong.save(folder.path()).unwrap();
            let error = CheckpointPlanning::load(folder.path()).unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
    }
}
