//! Table 2 in one go: the same training with one thing changed at a time (paper's encoder ablation).
//!
//! Each variant has a folder of its own with its run, its checkpoint and its row; a variant whose row is there is done.

use crate::subject::{EvalOptions, Subject};
use crate::{EncoderTable, ResultsError, encoder_table, page};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind, EncoderConfig, VitConfig};
use carff_training::{
    config::TrainingConfig,
    pipeline::{self, Stage},
    run::Run,
};
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// What is changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// Nothing: the training file as it is.
    Full,
    /// The convolutional stem before the backbone: left out where the file has one, put in where it has none.
    Stem,
    /// A small convolutional network from scratch in place of the backbone.
    ConvNet,
    /// The backbone learns on.
    Unfrozen,
    /// Another backbone: a small vision transformer, from scratch.
    Transformer,
    /// The decoder is not told the pose, and learns the picture itself: the mean picture of a pose would tell it.
    NoPose,
}

/// Channels of a stem that is put in.
const STEM_CHANNELS: i64 = 16;

impl Variant {
    /// All, in the order of the table.
    pub const ALL: [Self; 6] = [Self::Full, Self::Stem, Self::ConvNet, Self::Unfrozen, Self::Transformer, Self::NoPose];

    /// The name of its folder.
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

    /// What it is, beside the training file.
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

    /// The training file with this changed.
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

/// One row of the table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// What was changed.
    pub variant: Variant,
    /// The same in words.
    pub description: String,
    /// What it scores.
    pub scores: EncoderTable,
}

/// The table; `ablation.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AblationTable {
    /// The data set's folder.
    pub dataset: String,
    /// Passes over the training pictures, of every variant.
    pub epochs: usize,
    /// Freely drawn poses beside those of the data set, of every variant.
    pub free_poses: usize,
    /// Seed of the training; one run each.
    pub seed: u64,
    /// One a variant.
    pub rows: Vec<Row>,
}

/// The folder of a variant's run, and that of its checkpoint.
pub fn folders(out: &Path, variant: Variant) -> (PathBuf, PathBuf) {
    let dir = out.join(variant.name());
    (dir.join("run"), dir.join("checkpoint"))
}

/// Trains one variant's VAE, or goes on, and scores it; a row that is there is read.
pub fn row(
    config: &TrainingConfig,
    variant: Variant,
    dataset: &Path,
    free: Option<&Path>,
    out: &Path,
    run: &Run,
    options: EvalOptions,
) -> Result<Row, ResultsError> {
    let path = out.join(variant.name()).join("row.json");
    if let Ok(text) = std::fs::read_to_string(&path) {
        return serde_json::from_str(&text)
            .map_err(|e| ResultsError::Format { path, what: format!("{e}; remove the file to score it again") });
    }
    let (_, checkpoint) = folders(out, variant);
    pipeline::train(&variant.apply(config), dataset, free, &checkpoint, Stage::Vae, options.device, run)?;
    let subject = Subject::load(&checkpoint, dataset, options, run.on_progress)?;
    let row = Row { variant, description: variant.description(config).to_owned(), scores: encoder_table(&subject) };
    write(&path, &to_json(&row, &path)?)?;
    Ok(row)
}

/// Writes `ablation.json` and `README.md`.
pub fn write_table(table: &AblationTable, out: &Path) -> Result<(), ResultsError> {
    let path = out.join("ablation.json");
    write(&path, &to_json(table, &path)?)?;
    write(&out.join("README.md"), &markdown(table))
}

fn markdown(table: &AblationTable) -> String {
    let mut text = format!(
        "# Encoder ablation\n\nData set `{}`, {} epochs and {} free poses for every variant, seed {}, one run each. Only \
         the VAE is trained.\n\n",
        table.dataset, table.epochs, table.free_poses, table.seed
    );
    let rows: Vec<(String, &EncoderTable)> = table.rows.iter().map(|r| (r.description.clone(), &r.scores)).collect();
    page::encoder(&mut text, &rows);
    let _ = writeln!(text, "State accuracy up to what looks the same, place fully visible:\n");
    let _ = writeln!(text, "| encoder | trained poses, % | unseen poses, % |\n|---|---|---|");
    for row in &table.rows {
        let share = |part: &str| {
            let full = row.scores.state_accuracy.get(part).map(|a| a.full).filter(|s| s.trials > 0);
            full.map_or_else(|| "-".to_owned(), |s| format!("{:.1} of {} pictures", 100.0 * s.accuracy(), s.trials))
        };
        let _ = writeln!(text, "| {} | {} | {} |", row.description, share("trained"), share("unseen"));
    }
    text
}

fn to_json(value: &impl Serialize, path: &Path) -> Result<String, ResultsError> {
    let text = serde_json::to_string_pretty(value);
    text.map(|t| t + "\n").map_err(|e| ResultsError::Format { path: path.into(), what: e.to_string() })
}

/// Whole or not at all.
fn write(path: &Path, text: &str) -> Result<(), ResultsError> {
    let partial = path.with_extension("partial");
    let written = path.parent().map_or(Ok(()), std::fs::create_dir_all);
    written
        .and_then(|()| std::fs::write(&partial, text))
        .and_then(|()| std::fs::rename(&partial, path))
        .map_err(|source| ResultsError::File { path: path.into(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> TrainingConfig {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "dataset = \"d\"\nout = \"o\"\nseed = 1\nsplit_seed = 2\n").unwrap();
        TrainingConfig::load(file.path()).unwrap()
    }

    /// Each variant is a valid training file that differs from every other; a file with a stem has it taken out.
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

    /// A decoder that is not told the pose must not be told it by the mean picture either.
    #[test]
    fn no_pose_means_no_pose() {
        let mut config = Variant::NoPose.apply(&config());
        config.vae.residual = true;
        assert!(config.validate().unwrap_err().contains("pose_condition"));
    }
}
