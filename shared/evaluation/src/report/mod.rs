//! The results of a checkpoint on a dataset: `results.json`, the images, and one page.

mod gallery;
mod horizon_page;
mod images_page;
mod localisation_page;
mod markdown;
mod memory_page;
mod page;
mod planning_page;
mod robustness_page;
mod targets;
mod trials_page;
mod unknown_sheet;
mod vehicles_page;

use crate::tables::{
    encoder::{EncoderTable, encoder_table},
    field::{ImageTable, image_table},
    forecast::{self, ForecastTable, FrequencyTable},
    horizon::{self, HorizonTable},
    localisation::{self, LocalisationTable},
    memory::{self, MemoryTable},
    planning::{self, PlanningResults},
    robustness::{self, Robustness},
    trials::{self, Baseline, ByPart},
    vehicles::{self, VehicleTable},
};
use crate::{ByRole, CheckpointAbout, EvaluationError, Progress, Subject};
pub use gallery::Gallery;
pub use page::encoder_rows;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
pub use targets::Target;

/// A table, in the order of the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Table {
    /// PSNR matrices and novel views.
    Psnr,
    /// Decoder, support vector machine, state accuracy.
    Encoder,
    /// Accuracy and recall against the number of samples.
    Recall,
    /// Every decision rule, and the reliability of the hazard probability.
    Planning,
    /// Six kinds of trial, with baselines on the same images.
    Trials,
    /// Decisions of several horizons.
    Horizon,
    /// Unknown objects and corrupted images.
    Robustness,
    /// Density probing and segmentation of rendered views.
    Localisation,
    /// The belief with and without memory.
    Memory,
    /// Place and speed of vehicles on the others' lane.
    Vehicles,
    /// Frequency of each outcome where several are open.
    Frequencies,
    /// t-SNE, reconstructions, curves, beliefs, density.
    Images,
}

impl Table {
    /// All tables.
    pub const ALL: [Self; 12] = [
        Self::Psnr,
        Self::Encoder,
        Self::Recall,
        Self::Planning,
        Self::Trials,
        Self::Horizon,
        Self::Robustness,
        Self::Localisation,
        Self::Memory,
        Self::Vehicles,
        Self::Frequencies,
        Self::Images,
    ];

    /// Name of the table for `--only`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Psnr => "psnr",
            Self::Encoder => "encoder",
            Self::Recall => "recall",
            Self::Planning => "planning",
            Self::Trials => "trials",
            Self::Horizon => "horizon",
            Self::Robustness => "robustness",
            Self::Localisation => "localisation",
            Self::Memory => "memory",
            Self::Vehicles => "vehicles",
            Self::Frequencies => "frequencies",
            Self::Images => "images",
        }
    }
}

/// All results, as in `results.json`. A table that was not requested, or that the scenario cannot have, is absent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Results {
    /// Subject of the evaluation.
    pub subject: CheckpointAbout,
    /// Targets and measured figures.
    pub targets: Vec<Target>,
    /// Images of the field.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub images: Option<ImageTable>,
    /// Encoder and decoder.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub encoder: Option<EncoderTable>,
    /// Accuracy and recall against the number of samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forecast: Option<ForecastTable>,
    /// Every decision rule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub planning: Option<PlanningResults>,
    /// Reliability of the hazard probability.
    #[serde(skip_serializing_if = "ByRole::is_empty", default)]
    pub hazard_reliability: ByRole<carff_trials::Reliability>,
    /// Six kinds of trial: figures by part and kind.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub trials: ByPart,
    /// Baselines on the images of the trials, by name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub baselines: BTreeMap<String, Baseline>,
    /// Decisions of several horizons.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub horizon: Option<HorizonTable>,
    /// Unknown objects and corrupted images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robustness: Option<Robustness>,
    /// Density probing and segmentation of rendered views.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub localisation: Option<LocalisationTable>,
    /// The belief with and without memory.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub memory: Option<MemoryTable>,
    /// Place and speed of vehicles on the others' lane.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub vehicles: Option<VehicleTable>,
    /// Frequency of each outcome where several are open.
    #[serde(skip_serializing_if = "ByRole::is_empty", default)]
    pub frequencies: ByRole<FrequencyTable>,
    /// Image files, in the order of the page.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gallery: Option<Gallery>,
    /// Tables that are left out, each with the reason.
    pub left_out: BTreeMap<String, String>,
}

/// Computes the requested tables and writes `results.json`, `README.md` and their images into `out`.
pub fn evaluate(
    subject: &Subject,
    tables: &[Table],
    out: &Path,
    on_progress: &dyn Fn(&Progress),
) -> Result<Results, EvaluationError> {
    std::fs::create_dir_all(out).map_err(|source| EvaluationError::File { path: out.into(), source })?;
    let mut results = Results { subject: subject.about(), ..Results::default() };
    let has = |table| tables.contains(&table);
    if has(Table::Psnr) {
        results.images = results.kept(Table::Psnr, image_table(subject, on_progress));
    }
    if has(Table::Encoder) {
        results.encoder = Some(encoder_table(subject));
    }
    if has(Table::Recall) || has(Table::Frequencies) {
        let (recall, frequencies) = match forecast::forecast(subject, on_progress) {
            Ok((recall, frequencies)) => (Ok(recall), frequencies),
            Err(why) => (Err(why.clone()), Err(why)),
        };
        if has(Table::Recall) {
            results.forecast = results.kept(Table::Recall, recall);
            results.forecast.as_ref().map(|table| forecast::draw(table, out)).transpose()?;
        }
        if has(Table::Frequencies) {
            results.frequencies = results.kept(Table::Frequencies, frequencies).unwrap_or_default();
        }
    }
    if has(Table::Planning)
        && let Some((table, reliability)) = results.kept(Table::Planning, planning::planning(subject, on_progress)?)
    {
        planning::draw(&reliability, out)?;
        results.planning = Some(table);
        results.hazard_reliability = reliability;
    }
    if has(Table::Trials)
        && let Some((trials, baselines)) = results.kept(Table::Trials, trials::trials(subject, on_progress))
    {
        (results.trials, results.baselines) = (trials, baselines);
    }
    if has(Table::Horizon) {
        results.horizon = results.kept(Table::Horizon, horizon::horizon(subject, on_progress));
    }
    if has(Table::Robustness) {
        results.robustness = results.kept(Table::Robustness, robustness::robustness(subject, on_progress));
    }
    if has(Table::Localisation) {
        results.localisation = results.kept(Table::Localisation, localisation::localisation(subject, on_progress));
    }
    if has(Table::Memory) {
        results.memory = results.kept(Table::Memory, memory::memory(subject, on_progress));
    }
    if has(Table::Vehicles) {
        results.vehicles = results.kept(Table::Vehicles, vehicles::vehicles(subject, on_progress));
    }
    if has(Table::Images) {
        results.gallery = Some(gallery::gallery(subject, out, on_progress)?);
    }
    results.targets = targets::targets(&results);
    let json = serde_json::to_string_pretty(&results)
        .map_err(|e| EvaluationError::Format { path: out.join("results.json"), what: e.to_string() })?;
    for (name, text) in [("results.json", json + "\n"), ("README.md", page::page(&results))] {
        let path = out.join(name);
        std::fs::write(&path, text).map_err(|source| EvaluationError::File { path, source })?;
    }
    Ok(results)
}

impl Results {
    /// Returns a table; of a table that is missing, the reason is kept instead.
    fn kept<T>(&mut self, table: Table, found: Result<T, String>) -> Option<T> {
        found.map_err(|why| self.left_out.insert(table.name().to_owned(), why)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Results with a renamed key are a read error, not a missing figure.
    #[test]
    fn a_renamed_key_is_an_error() {
        let results = Results { encoder: Some(EncoderTable::default()), ..Results::default() };
        let text = serde_json::to_string(&results).unwrap();
        assert_eq!(serde_json::from_str::<Results>(&text).unwrap(), results);
        for key in ["encoder", "psnr_db", "up_to_equivalence", "training_seed"] {
            let other = text.replace(&format!("\"{key}\""), "\"renamed\"");
            assert!(serde_json::from_str::<Results>(&other).is_err(), "{key}");
        }
    }
}
