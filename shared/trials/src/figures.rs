//! Figures of a finished training: `metrics` of a checkpoint's manifest.

use crate::{Accuracy, BirdsEye, ByObservability, EvaluationError, PlanningTable, SampleAccuracy};
use carff_checkpoint::{Manifest, files};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Figures of the models of a checkpoint. A model that is not trained has no figures.
///
/// The names of the fields are the keys of the file: an unknown key is an error, never a missing figure.
///
/// ```
/// use carff_trials::CheckpointFigures;
/// let text = r#"{"views": {"trained": {"poses": 24, "psnr_db": 31.5}, "unseen": {"poses": 3, "psnr_db": null}}}"#;
/// let figures: CheckpointFigures = serde_json::from_str(text)?;
/// assert_eq!(figures.summary(), "PSNR of views: trained poses 31.5 dB");
/// assert!(serde_json::from_str::<CheckpointFigures>(&text.replace("psnr_db", "psnr")).is_err());
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointFigures {
    /// Pose-conditional VAE.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vae: Option<VaeFigures>,
    /// Density probing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probing: Option<ProbingFigures>,
    /// Field from above. Absent where the dataset has no such view.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub birds_eye: Option<BirdsEye>,
    /// Decision rules.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub planning: Option<PlanningFigures>,
    /// Probed samples of the forecast.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<TrainedAndUnseen<SampleFigures>>,
    /// Field of a dataset with one state, from the dataset's own poses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub views: Option<TrainedAndUnseen<ViewFigures>>,
}

/// One value for trained poses and one for held-out poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainedAndUnseen<T> {
    /// Trained poses that chose no setting.
    pub trained: T,
    /// Held-out poses.
    pub unseen: T,
}

/// State accuracy of posterior means, and the quality of decoded images on trained poses where it was measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VaeFigures {
    /// Trained poses that chose no setting.
    pub trained: ByObservability<Accuracy>,
    /// Trained poses from which the threshold is chosen.
    pub calibration: ByObservability<Accuracy>,
    /// Held-out poses.
    pub unseen: ByObservability<Accuracy>,
    /// PSNR, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db: Option<f64>,
    /// PSNR of each pose's mean image, which needs no encoder, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[serde(alias = "mean_picture_psnr_db")]
    pub mean_image_psnr_db: Option<f64>,
    /// PSNR over the pixels that differ from the mean image, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub changed_pixels_psnr_db: Option<f64>,
}

/// Quality of decoded images, over all valid pixels of all images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DecodedQuality {
    /// PSNR, dB.
    pub psnr_db: f64,
    /// PSNR of each pose's mean image over the states, which needs no encoder, dB.
    #[serde(alias = "mean_picture_psnr_db")]
    pub mean_image_psnr_db: f64,
    /// PSNR over the pixels that differ from the mean image by more than [`carff_dataset::PIXEL_TOLERANCE`], dB.
    pub changed_pixels_psnr_db: f64,
    /// Images.
    pub images: usize,
}

impl VaeFigures {
    /// Adds the quality of decoded images.
    #[must_use]
    pub fn with_quality(self, quality: DecodedQuality) -> Self {
        Self {
            psnr_db: Some(quality.psnr_db),
            mean_image_psnr_db: Some(quality.mean_image_psnr_db),
            changed_pixels_psnr_db: Some(quality.changed_pixels_psnr_db),
            ..self
        }
    }
}

/// Separation of occupied and free places.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProbingFigures {
    /// Distance of the two means of each place, in standard deviations.
    pub separations: Vec<f64>,
    /// Probed places.
    pub places: usize,
}

/// Planning tables by role of the poses.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanningFigures {
    /// Trained poses that chose no setting.
    pub all_views: PlanningTable,
    /// Poses from which the threshold was chosen.
    pub calibration_views: PlanningTable,
    /// Held-out poses.
    pub unseen_views: PlanningTable,
}

/// Accuracy of probed samples on unoccluded views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SampleFigures {
    /// Counts.
    pub full: SampleAccuracy,
    /// Share of samples that show the next state, 0..=1.
    pub accuracy: f64,
    /// Share of samples that show a possible next state, 0..=1.
    pub possible: f64,
}

impl From<SampleAccuracy> for SampleFigures {
    fn from(full: SampleAccuracy) -> Self {
        Self { full, accuracy: full.accuracy(), possible: full.possible_share() }
    }
}

/// Images of the field from some poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewFigures {
    /// Images.
    pub poses: usize,
    /// Mean PSNR, dB; absent for no images. The key is always there.
    #[serde(deserialize_with = "Option::deserialize")]
    pub psnr_db: Option<f64>,
}

impl CheckpointFigures {
    /// Reads the figures of the checkpoint in `dir`; the error names the key that is wrong.
    pub fn of(manifest: &Manifest, dir: &Path) -> Result<Self, EvaluationError> {
        Self::deserialize(&manifest.metrics).map_err(|e| EvaluationError::Format {
            path: dir.join(files::MANIFEST),
            what: format!("`metrics`: {e}; make the checkpoint again with `carff train`"),
        })
    }

    /// The main figures as text, one line for each subject.
    pub fn summary(&self) -> String {
        let percent = |name: &str, share: f64| format!("{name} {:.1} %", 100.0 * share);
        let db = |name: &str, value: f64| format!("{name} {value:.1} dB");
        let mut lines = Vec::new();
        if let Some(vae) = &self.vae {
            let [trained, unseen] = [vae.trained.full, vae.unseen.full];
            lines.push((
                "state accuracy of latents, fully observable views",
                vec![percent("trained poses", trained.accuracy), percent("held-out poses", unseen.accuracy)],
            ));
            lines.push((
                "exact-state accuracy of latents, where equivalent states count as wrong",
                vec![
                    percent("trained poses", trained.raw),
                    percent("of at most", trained.raw_ceiling),
                    percent("held-out poses", unseen.raw),
                    percent("of at most", unseen.raw_ceiling),
                ],
            ));
        }
        if let Some(TrainedAndUnseen { trained, unseen }) = &self.samples {
            lines.push((
                "state accuracy of probed samples, fully observable views",
                vec![percent("trained poses", trained.accuracy), percent("held-out poses", unseen.accuracy)],
            ));
            lines.push((
                "probed samples that show any possible next state",
                vec![percent("trained poses", trained.possible), percent("held-out poses", unseen.possible)],
            ));
        }
        if let Some(TrainedAndUnseen { trained, unseen }) = &self.views {
            let values = [("trained poses", trained.psnr_db), ("held-out poses", unseen.psnr_db)];
            let values = values.into_iter().filter_map(|(name, value)| Some(db(name, value?))).collect();
            lines.push(("PSNR of views", values));
        }
        if let Some(birds_eye) = &self.birds_eye {
            lines.push((
                "bird's-eye PSNR",
                vec![
                    db("matching", birds_eye.matching_db),
                    db("un-matching", birds_eye.unmatching_db),
                    db("mean image of all states", birds_eye.mean_image_db),
                    db("pixels that change among states", birds_eye.changed_db),
                ],
            ));
        }
        let text = |(label, values): (&str, Vec<String>)| {
            (!values.is_empty()).then(|| format!("{label}: {}", values.join(", ")))
        };
        lines.into_iter().filter_map(text).collect::<Vec<_>>().join("\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    fn shipped(name: &str) -> Manifest {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/checkpoints");
        Manifest::load(&root.join(name)).unwrap()
    }

    /// The figures of every shipped checkpoint are read, and written again as the same JSON.
    #[test]
    fn shipped_figures_are_read() {
        for name in [
            "approaching-intersection",
            "hand-reaching",
            "open-branch-intersection",
            "single-approaching-intersection",
            "toy",
            "two-lane-merge",
        ] {
            let manifest = shipped(name);
            let figures = CheckpointFigures::of(&manifest, Path::new(name)).unwrap();
            assert_eq!(serde_json::to_value(&figures).unwrap(), manifest.metrics, "{name}");
            assert!(figures.summary().lines().count() >= 5, "{name}: {}", figures.summary());
            // The keys of earlier versions.
            let mut earlier = manifest.clone();
            renamed(&mut earlier.metrics, "mean_image_db", "mean_picture_db");
            renamed(&mut earlier.metrics, "mean_image_psnr_db", "mean_picture_psnr_db");
            assert_eq!(CheckpointFigures::of(&earlier, Path::new(name)).unwrap(), figures);
        }
    }

    /// Puts `other` in the place of every key `key`.
    fn renamed(value: &mut Value, key: &str, other: &str) {
        match value {
            Value::Object(map) => {
                if let Some(value) = map.remove(key) {
                    map.insert(other.to_owned(), value);
                }
                map.values_mut().for_each(|value| renamed(value, key, other));
            }
            Value::Array(values) => values.iter_mut().for_each(|value| renamed(value, key, other)),
            _ => {}
        }
    }

    fn keys(value: &Value, found: &mut std::collections::BTreeSet<String>) {
        match value {
            Value::Object(map) => {
                found.extend(map.keys().cloned());
                map.values().for_each(|value| keys(value, found));
            }
            Value::Array(values) => values.iter().for_each(|value| keys(value, found)),
            _ => {}
        }
    }

    /// A renamed key, whichever it is, is a read error that names the file; it is never a missing figure or a zero.
    #[test]
    fn a_renamed_key_is_an_error() {
        let manifest = shipped("toy");
        let mut all = std::collections::BTreeSet::new();
        keys(&manifest.metrics, &mut all);
        assert!(all.len() > 30, "{all:?}");
        for key in all {
            let mut other = manifest.clone();
            renamed(&mut other.metrics, &key, "renamed");
            let error = CheckpointFigures::of(&other, Path::new("toy")).expect_err(&key).to_string();
            assert!(error.contains("manifest.json"), "{key}: {error}");
        }
    }
}
