//! The paper's encoder ablation (table 2): one training with one setting changed at a time.
//!
//! Each variant has a folder with its run, its checkpoint and its row. A variant with a row is finished.

use crate::{Phases, Run, Training, TrainingConfig, TrainingError};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind, EncoderConfig, VitConfig};
use carff_evaluation::{ByObservability, EncoderTable, EvalOptions, Subject, encoder_rows, encoder_table};
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A variant: the setting that is changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// No change.
    Full,
    /// The convolutional stem before the backbone: removed where the file has one, added where it has none.
    Stem,
    /// A small convolutional network, trained from scratch, instead of the backbone.
    ConvNet,
    /// A trainable backbone.
    Unfrozen,
    /// Another backbone: a small vision transformer, trained from scratch.
    Transformer,
    /// A decoder without the pose that learns the image: the mean image of a pose would give it the pose.
    NoPose,
}

/// Channels of an added stem.
const STEM_CHANNELS: i64 = 16;

impl Variant {
    /// All variants, in the order of the table.
    pub const ALL: [Self; 6] = [Self::Full, Self::Stem, Self::ConvNet, Self::Unfrozen, Self::Transformer, Self::NoPose];

    /// Name of the folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Stem => "stem",
            Self::ConvNet => "conv-net",
            Self::Unfrozen => "unfrozen",
            Self::Transformer => "transformer",
            Self::NoPose => "no-pose",
        }
    }

    /// Description, relative to the training file.
    pub fn description(self, config: &TrainingConfig) -> &'static str {
        match self {
            Self::Full => "full model, as configured",
            Self::Stem if config.encoder.stem_channels > 0 => "without the convolutional stem",
            Self::Stem => "with a convolutional stem",
            Self::ConvNet => "vanilla convolutional encoder",
            Self::Unfrozen => "backbone not frozen",
            Self::Transformer => "another backbone: small vision transformer, from scratch",
            Self::NoPose => "no pose condition",
        }
    }

    /// The training file with this change.
    pub fn apply(self, config: &TrainingConfig) -> TrainingConfig {
        let mut config = config.clone();
        let from_scratch = |kind, encoder: &EncoderConfig| EncoderConfig {
            backbone: BackboneConfig { kind, frozen: false, ..encoder.backbone.clone() },
            stem_channels: 0,
            ..encoder.clone()
        };
        match self {
            Self::Full => {}
            Self::Stem if config.encoder.stem_channels > 0 => config.encoder.stem_channels = 0,
            Self::Stem => config.encoder.stem_channels = STEM_CHANNELS,
            Self::ConvNet => {
                config.encoder = from_scratch(BackboneKind::ConvNet, &config.encoder);
                config.pretrained_backbone = None;
            }
            Self::Unfrozen => config.encoder.backbone.frozen = false,
            Self::Transformer => {
                config.encoder = from_scratch(BackboneKind::Vit, &config.encoder);
                config.encoder.backbone.vit = VitConfig { patch_px: 16, width: 192, depth: 4, heads: 3 };
                config.pretrained_backbone = None;
            }
            Self::NoPose => {
                config.decoder.pose_condition = false;
                config.vae.residual = false;
            }
        }
        config
    }
}

/// A row of the table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The variant.
    pub variant: Variant,
    /// Description of the variant.
    pub description: String,
    /// Scores of the variant.
    pub scores: EncoderTable,
}

/// The table, as in `ablation.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AblationTable {
    /// Folder of the dataset.
    pub dataset: String,
    /// Passes over the training images, for every variant.
    pub epochs: usize,
    /// Random poses in addition to those of the dataset, for every variant.
    pub free_poses: usize,
    /// Seed of the training; each variant is trained once.
    pub seed: u64,
    /// One row for each variant.
    pub rows: Vec<Row>,
}

/// Folders of a variant's run and checkpoint.
pub fn folders(out: &Path, variant: Variant) -> (PathBuf, PathBuf) {
    let dir = out.join(variant.name());
    (dir.join("run"), dir.join("checkpoint"))
}

/// Trains the VAE of one variant, or resumes its training, and scores it. A row that is there is read.
pub fn row(training: &Training, variant: Variant, run: &Run, options: EvalOptions) -> Result<Row, TrainingError> {
    let path = training.out.join(variant.name()).join("row.json");
    if let Ok(text) = std::fs::read_to_string(&path) {
        return serde_json::from_str(&text)
            .map_err(|e| TrainingError::Format { path, what: format!("{e}; remove the file to score it again") });
    }
    let (_, out) = folders(training.out, variant);
    let config = variant.apply(training.config);
    Training { config: &config, out: &out, device: options.device, ..*training }.run(Phases::Vae, run)?;
    let subject = Subject::load(&out, training.dataset, options, run.on_progress)?;
    let description = variant.description(training.config).to_owned();
    let row = Row { variant, description, scores: encoder_table(&subject) };
    write(&path, &to_json(&row, &path)?)?;
    Ok(row)
}

/// Writes `ablation.json` and `README.md` into `out`.
pub fn write_table(table: &AblationTable, out: &Path) -> Result<(), TrainingError> {
    let path = out.join("ablation.json");
    write(&path, &to_json(table, &path)?)?;
    write(&out.join("README.md"), &markdown(table))
}

fn markdown(table: &AblationTable) -> String {
    let mut text = format!(
        "# Encoder ablation\n\nDataset `{}`, {} epochs and {} random poses for every variant, seed {}, one run each. \
         Only the VAE is trained.\n\n",
        table.dataset, table.epochs, table.free_poses, table.seed
    );
    let rows: Vec<(String, &EncoderTable)> = table.rows.iter().map(|r| (r.description.clone(), &r.scores)).collect();
    encoder_rows(&mut text, &rows);
    let _ = writeln!(text, "State accuracy up to visual equivalence, place fully visible:\n");
    let _ = writeln!(text, "| encoder | trained poses, % | held-out poses, % |\n|---|---|---|");
    for row in &table.rows {
        let share = |accuracy: Option<ByObservability>| {
            let full = accuracy.map(|a| a.full).filter(|s| s.trials > 0);
            full.map_or_else(|| "-".to_owned(), |s| format!("{:.1} of {} images", 100.0 * s.accuracy(), s.trials))
        };
        let accuracy = &row.scores.state_accuracy;
        let [trained, held_out] = [accuracy.trained, accuracy.unseen].map(share);
        let _ = writeln!(text, "| {} | {trained} | {held_out} |", row.description);
    }
    text
}

fn to_json(value: &impl Serialize, path: &Path) -> Result<String, TrainingError> {
    let text = serde_json::to_string_pretty(value);
    text.map(|t| t + "\n").map_err(|e| TrainingError::Format { path: path.into(), what: e.to_string() })
}

/// Writes a file atomically.
fn write(path: &Path, text: &str) -> Result<(), TrainingError> {
    let partial = path.with_extension("partial");
    let written = path.parent().map_or(Ok(()), std::fs::create_dir_all);
    written
        .and_then(|()| std::fs::write(&partial, text))
        .and_then(|()| std::fs::rename(&partial, path))
        .map_err(|source| TrainingError::File { path: path.into(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> TrainingConfig {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "dataset = \"d\"\nout = \"o\"\nseed = 1\nsplit_seed = 2\n").unwrap();
        TrainingConfig::load(file.path()).unwrap()
    }

    /// Each variant is a valid training file that differs from every other; the stem of a file that has one is removed.
    #[test]
    fn variants_are_valid_and_differ() {
        let config = config();
        let all: Vec<TrainingConfig> = Variant::ALL.iter().map(|v| v.apply(&config)).collect();
        for (i, one) in all.iter().enumerate() {
            one.validate().unwrap();
            assert!(all[..i].iter().all(|other| other != one), "{:?}", Variant::ALL[i]);
        }
        let with_stem = Variant::Stem.apply(&config);
        assert_eq!(Variant::Stem.apply(&with_stem), config);
        assert_ne!(Variant::Stem.description(&config), Variant::Stem.description(&with_stem));
    }

    /// A decoder without the pose must not get it from the mean image.
    #[test]
    fn no_pose_means_no_pose() {
        let mut config = Variant::NoPose.apply(&config());
        config.vae.residual = true;
        assert!(config.validate().unwrap_err().contains("pose_condition"));
    }
}
