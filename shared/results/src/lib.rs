//! The results of a checkpoint on a data set: every table of the paper and what it leaves out, as JSON, pictures, and one
//! page for a reader.
//!
//! What lives here: which views, poses and draws a table is about, and how it is shown. The arithmetic is in
//! `carff_evaluation` and `carff_metrics`. What never does: training (but for [`ablation`], which calls it), and choosing
//! anything: thresholds come from the checkpoint.

pub mod ablation;
mod encoder;
mod forecast;
mod gallery;
mod page;
mod pictures;
mod planning;
mod subject;
mod targets;

pub use encoder::{EncoderTable, SvmScore, encoder_table};
pub use forecast::{ForecastTable, RoleCurves};
pub use gallery::Gallery;
pub use pictures::{FieldPictures, NovelViews, PictureTable};
pub use planning::{OneImage, PlanningResults, ViewCounts};
pub use subject::{EvalOptions, Subject};
pub use targets::Target;

use carff_evaluation::draws::Frequencies;
use carff_metrics::Reliability;
use carff_training::run::Progress;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Why there are no results.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// The checkpoint cannot be used.
    #[error(transparent)]
    Checkpoint(#[from] carff_checkpoint::CheckpointError),
    /// The data set cannot be read.
    #[error(transparent)]
    Dataset(#[from] carff_dataset::DatasetError),
    /// The data set or the training do not fit.
    #[error(transparent)]
    Training(#[from] carff_training::TrainingError),
    /// A picture cannot be drawn.
    #[error(transparent)]
    Plot(#[from] carff_plots::PlotError),
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Something in the checkpoint or an earlier result is not what it must be.
    #[error("{path}: {what}")]
    Format {
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

/// The tables, in the order of the page.
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
    /// How often each outcome is drawn where several are open.
    Frequencies,
    /// t-SNE, reconstructions, curves, beliefs, density.
    Pictures,
}

impl Table {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Psnr, Self::Encoder, Self::Recall, Self::Planning, Self::Frequencies, Self::Pictures];

    /// The name that `--only` takes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Psnr => "psnr",
            Self::Encoder => "encoder",
            Self::Recall => "recall",
            Self::Planning => "planning",
            Self::Frequencies => "frequencies",
            Self::Pictures => "pictures",
        }
    }
}

/// All results; `results.json`. A table that was not asked for, or that the scenario cannot have, is absent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// What was judged.
    pub subject: About,
    /// What is wanted, and what was found.
    pub targets: Vec<Target>,
    /// Pictures of the field from above and from poses it was not trained on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pictures: Option<PictureTable>,
    /// Encoder and decoder.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub encoder: Option<EncoderTable>,
    /// Accuracy and recall against the number of samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forecast: Option<ForecastTable>,
    /// Every decision rule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub planning: Option<PlanningResults>,
    /// Reliability of the hazard probability, by part of the poses.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub hazard_reliability: BTreeMap<String, Reliability>,
    /// How often each outcome is drawn where several are open, by part of the poses.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub frequencies: BTreeMap<String, FrequencyTable>,
    /// Files with pictures, in the order of the page.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gallery: Option<Gallery>,
    /// Tables that cannot be, each with the reason.
    pub left_out: BTreeMap<String, String>,
}

/// What was judged, and with which random numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct About {
    /// Version of the program.
    pub program_version: String,
    /// The scenario's name.
    pub scenario: String,
    /// Names of its branches.
    pub branches: Vec<String>,
    /// Steps of a branch.
    pub timestamps: usize,
    /// The checkpoint's folder, as given.
    pub checkpoint: String,
    /// The data set's folder, as given.
    pub dataset: String,
    /// Pictures of the data set.
    pub pictures: usize,
    /// Poses by part: `trained`, `calibration`, `unseen`.
    pub poses: BTreeMap<String, usize>,
    /// Seed of the training.
    pub training_seed: u64,
    /// Seed of the split of the poses.
    pub split_seed: u64,
    /// Seed of what is drawn here.
    pub seed: u64,
}

/// Frequencies where pictures leave several outcomes open. Draws are independent, from the forecast of the next step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrequencyTable {
    /// Outcome: the branch.
    pub by_branch: Vec<Frequencies>,
    /// Outcome: whether any of the boxes that come and go stands there. Empty with two branches, which say as much.
    pub by_presence: Vec<Frequencies>,
}

/// Computes the asked tables and writes `results.json`, `README.md` and their pictures into `out`.
pub fn evaluate(
    subject: &mut Subject,
    tables: &[Table],
    out: &Path,
    on_progress: &dyn Fn(&Progress),
) -> Result<Results, ResultsError> {
    std::fs::create_dir_all(out).map_err(|source| ResultsError::File { path: out.into(), source })?;
    let mut results = Results { subject: subject.about(), ..Results::default() };
    let has = |table| tables.contains(&table);
    if has(Table::Psnr) {
        match pictures::picture_table(subject, on_progress) {
            Ok(table) => results.pictures = Some(table),
            Err(why) => results.leave_out(Table::Psnr, why),
        }
    }
    if has(Table::Encoder) {
        results.encoder = Some(encoder::encoder_table(subject));
    }
    if has(Table::Recall) || has(Table::Frequencies) {
        match forecast::forecast(subject, on_progress) {
            Ok((table, frequencies)) => {
                if has(Table::Recall) {
                    forecast::draw(&table, out)?;
                    results.forecast = Some(table);
                }
                match frequencies {
                    _ if !has(Table::Frequencies) => {}
                    Ok(frequencies) => results.frequencies = frequencies,
                    Err(why) => results.leave_out(Table::Frequencies, why),
                }
            }
            Err(why) => {
                for table in [Table::Recall, Table::Frequencies].into_iter().filter(|t| has(*t)) {
                    results.leave_out(table, why.clone());
                }
            }
        }
    }
    if has(Table::Planning) {
        match planning::planning(subject, on_progress)? {
            Ok((table, reliability)) => {
                planning::draw(&reliability, out)?;
                results.planning = Some(table);
                results.hazard_reliability = reliability;
            }
            Err(why) => results.leave_out(Table::Planning, why),
        }
    }
    if has(Table::Pictures) {
        results.gallery = Some(gallery::gallery(subject, out, on_progress)?);
    }
    results.targets = targets::targets(&results);
    let json = serde_json::to_string_pretty(&results)
        .map_err(|e| ResultsError::Format { path: out.join("results.json"), what: e.to_string() })?;
    for (name, text) in [("results.json", json + "\n"), ("README.md", page::page(&results))] {
        let path = out.join(name);
        std::fs::write(&path, text).map_err(|source| ResultsError::File { path, source })?;
    }
    Ok(results)
}

impl Results {
    fn leave_out(&mut self, table: Table, why: String) {
        self.left_out.insert(table.name().to_owned(), why);
    }
}
