//! The paper's encoder ablation (table 2), trainings without state labels, and a training in one stage: one training
//! with one setting changed at a time.
//!
//! Each variant has a folder for each seed, with its run, its checkpoint and its row. A variant with a row is finished.

use crate::{Phases, Training, TrainingConfig, TrainingError, TrainingRun};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind, EncoderConfig, VitConfig};
use carff_evaluation::{ByObservability, EncoderTable, EvalOptions, Share, Subject, encoder_rows, encoder_table};
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
    /// No loss names a state; the decoder is asked for eight other poses of what each image shows.
    EightPoses,
    /// No loss names a state; the decoder is asked for one other pose (the paper's c'').
    OnePose,
    /// No loss names a state; the decoder is asked for the image's own pose.
    OwnPose,
    /// No loss names a state; the encoder learns through the field, in one stage (NeRF-VAE).
    OneStage,
}

/// Channels of an added stem.
const STEM_CHANNELS: i64 = 16;

/// Weight of the KL term of trainings without state labels. With 0.01, some seeds do not leave the mean image.
const UNLABELLED_KL: f64 = 1e-3;

/// Steps of the training in one stage for each pass of the others, and passes of its decoder afterwards.
const ONE_STAGE_STEPS: usize = 130;
const ONE_STAGE_DECODER_EPOCHS: usize = 20;

impl Variant {
    /// All variants, in the order of the table.
    pub const ALL: [Self; 10] = [
        Self::Full,
        Self::Stem,
        Self::ConvNet,
        Self::Unfrozen,
        Self::Transformer,
        Self::NoPose,
        Self::EightPoses,
        Self::OnePose,
        Self::OwnPose,
        Self::OneStage,
    ];

    /// Name of the folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Stem => "stem",
            Self::ConvNet => "conv-net",
            Self::Unfrozen => "unfrozen",
            Self::Transformer => "transformer",
            Self::NoPose => "no-pose",
            Self::EightPoses => "eight-poses",
            Self::OnePose => "one-pose",
            Self::OwnPose => "own-pose",
            Self::OneStage => "one-stage",
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
            Self::EightPoses => "no state labels, eight other poses",
            Self::OnePose => "no state labels, one other pose",
            Self::OwnPose => "no state labels, own pose",
            Self::OneStage => "no state labels, one stage with the field",
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
                config.encoder.backbone.vit = VitConfig { patch_px: 16, width: 192, depth: 4, heads: 3, registers: 0 };
                config.pretrained_backbone = None;
            }
            Self::NoPose => {
                config.decoder.pose_condition = false;
                config.vae.residual = false;
            }
            Self::EightPoses => unlabelled(&mut config, 8),
            Self::OnePose => unlabelled(&mut config, 1),
            Self::OwnPose => unlabelled(&mut config, 0),
            Self::OneStage => {
                unlabelled(&mut config, 0);
                config.vae.one_stage_steps = ONE_STAGE_STEPS * config.vae.epochs;
                config.vae.decoder_epochs = ONE_STAGE_DECODER_EPOCHS;
            }
        }
        config
    }
}

/// Removes the state labels; the decoder is asked for `other_poses` of each image, or for its own pose.
fn unlabelled(config: &mut TrainingConfig, other_poses: usize) {
    config.vae.state_weight = 0.0;
    config.vae.contrastive_weight = 0.0;
    config.vae.kl_weight = UNLABELLED_KL;
    config.vae.other_poses = other_poses;
}

/// File of a row in its [`folder`].
const ROW: &str = "row.json";

/// A row of the table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AblationRow {
    /// The variant.
    pub variant: Variant,
    /// Description of the variant.
    pub description: String,
    /// Seed of the training.
    pub seed: u64,
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
    /// Free poses in addition to those of the dataset, for every variant.
    pub free_poses: usize,
    /// One row for each variant and seed.
    pub rows: Vec<AblationRow>,
}

/// Folder of a variant and a seed, with its run, its checkpoint and its row.
pub fn folder(out: &Path, variant: Variant, seed: u64) -> PathBuf {
    out.join(variant.name()).join(format!("seed-{seed}"))
}

/// Trains the VAE of one variant with the seed of the training file, or resumes its training, and scores it. A row that
/// is there is read. `run` is in `run` of the variant's [`folder`].
pub fn row(
    training: &Training,
    variant: Variant,
    run: &TrainingRun,
    options: EvalOptions,
) -> Result<AblationRow, TrainingError> {
    let seed = training.config.seed;
    let folder = folder(training.out, variant, seed);
    let path = folder.join(ROW);
    if let Some(row) = read_row(&path)? {
        return Ok(row);
    }
    let out = folder.join("checkpoint");
    let config = variant.apply(training.config);
    Training { config: &config, out: &out, device: options.device, ..*training }.run(Phases::Vae, run)?;
    let subject = Subject::load(&out, training.dataset, options, run.on_progress)?;
    let description = variant.description(training.config).to_owned();
    let row = AblationRow { variant, description, seed, scores: encoder_table(&subject) };
    write(&path, &to_json(&row, &path)?)?;
    Ok(row)
}

/// Reads all rows in `out`, those of earlier runs included: by variant, then by seed.
pub fn rows(out: &Path) -> Result<Vec<AblationRow>, TrainingError> {
    let mut rows = Vec::new();
    for variant in Variant::ALL {
        let Ok(seeds) = std::fs::read_dir(out.join(variant.name())) else { continue };
        for seed in seeds.flatten() {
            rows.extend(read_row(&seed.path().join(ROW))?);
        }
    }
    rows.sort_by_key(|row| (Variant::ALL.iter().position(|variant| *variant == row.variant), row.seed));
    Ok(rows)
}

/// Reads a row; `None` if there is none.
fn read_row(path: &Path) -> Result<Option<AblationRow>, TrainingError> {
    let Ok(text) = std::fs::read_to_string(path) else { return Ok(None) };
    serde_json::from_str(&text).map(Some).map_err(|e| TrainingError::Format {
        path: path.to_owned(),
        what: format!("{e}; remove the file to score it again"),
    })
}

/// Writes `ablation.json` and `README.md` into `out`.
pub fn write_table(table: &AblationTable, out: &Path) -> Result<(), TrainingError> {
    let path = out.join("ablation.json");
    write(&path, &to_json(table, &path)?)?;
    write(&out.join("README.md"), &markdown(table))
}

fn markdown(table: &AblationTable) -> String {
    let mut text = format!(
        "# Encoder ablation\n\nDataset `{}`, {} epochs and {} free poses for every variant. Only the VAE is trained.\n\n",
        table.dataset, table.epochs, table.free_poses
    );
    let rows: Vec<(String, &EncoderTable)> =
        table.rows.iter().map(|r| (format!("{}, seed {}", r.description, r.seed), &r.scores)).collect();
    encoder_rows(&mut text, &rows);
    let _ = writeln!(text, "State accuracy up to visual equivalence, place fully visible:\n");
    let _ = writeln!(text, "| encoder | trained poses, % | held-out poses, % |\n|---|---|---|");
    for (name, scores) in &rows {
        let share = |accuracy| {
            full(accuracy)
                .map_or_else(|| "-".to_owned(), |s| format!("{:.1} of {} images", 100.0 * s.accuracy(), s.trials))
        };
        let accuracy = &scores.state_accuracy;
        let [trained, held_out] = [accuracy.trained, accuracy.unseen].map(share);
        let _ = writeln!(text, "| {name} | {trained} | {held_out} |");
    }
    over_seeds(&mut text, table);
    text
}

/// State accuracy on images that show the place fully; `None` where there are none.
fn full(accuracy: Option<ByObservability>) -> Option<Share> {
    accuracy.map(|a| a.full).filter(|s| s.trials > 0)
}

/// Name and figure of a column.
type Column = (&'static str, fn(&EncoderTable) -> Option<f64>);

/// Columns of the table over seeds, %.
const OVER_SEEDS: [Column; 4] = [
    ("SVM by pose", |t| Some(t.svm.trained_by_pose.accuracy)),
    ("up to equivalence", |t| Some(t.svm.trained_by_pose.up_to_equivalence)),
    ("state accuracy, trained poses", |t| full(t.state_accuracy.trained).map(|s| s.accuracy())),
    ("state accuracy, held-out poses", |t| full(t.state_accuracy.unseen).map(|s| s.accuracy())),
];

/// Mean and range over the seeds of each variant, if any has several.
fn over_seeds(text: &mut String, table: &AblationTable) {
    let of = |variant| table.rows.iter().filter(move |r| r.variant == variant);
    let several: Vec<Variant> = Variant::ALL.into_iter().filter(|&v| of(v).count() > 1).collect();
    if several.is_empty() {
        return;
    }
    let _ = writeln!(text, "\nMean over the seeds, and least to most, %:\n");
    let _ = writeln!(text, "| encoder | seeds | {} |", OVER_SEEDS.map(|(name, _)| name).join(" | "));
    let _ = writeln!(text, "|---|---|---|---|---|---|");
    for variant in several {
        let cells = OVER_SEEDS.map(|(_, figure)| {
            let values: Vec<f64> = of(variant).filter_map(|r| figure(&r.scores)).map(|v| 100.0 * v).collect();
            let least = values.iter().copied().fold(f64::INFINITY, f64::min);
            let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            format!("{:.1} ({least:.1} to {most:.1})", carff_base::statistics::mean(&values).unwrap_or(f64::NAN))
        });
        let description = of(variant).next().map_or("", |r| &r.description);
        let _ = writeln!(text, "| {description} | {} | {} |", of(variant).count(), cells.join(" | "));
    }
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
