//! Training curves: the metrics file of a run as an image.

use crate::{
    TrainingError,
    records::{FieldRecord, METRICS, MetricsLine, MixtureRecord, Record, VaeRecord, names},
};
use carff_evaluation::{Accuracy, ByObservability};
use carff_plots::{Panel, Series};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// One chart: lines over the records of a phase.
struct Chart<R: 'static> {
    title: &'static str,
    x_label: &'static str,
    y_label: &'static str,
    log_y: bool,
    /// Name and figure of each line.
    lines: &'static [Line<R>],
}

/// Name and figure of a line.
type Line<R> = (&'static str, fn(&R) -> Option<f64>);

/// Title of a chart of accuracies, and the accuracies of its role.
type AccuracyChart = (&'static str, fn(&VaeRecord) -> &ByObservability<Accuracy>);

/// Name and figure of a line of accuracies.
type AccuracyLine = (&'static str, fn(&ByObservability<Accuracy>) -> f64);

const VAE: [Chart<VaeRecord>; 3] = [
    Chart {
        title: "VAE: loss and its parts",
        x_label: "epoch",
        y_label: "loss",
        log_y: true,
        lines: &[
            ("all", |r| Some(r.loss)),
            ("reconstruction", |r| Some(r.reconstruction)),
            ("state", |r| Some(r.state)),
        ],
    },
    Chart {
        title: "VAE: divergence of the posterior",
        x_label: "epoch",
        y_label: "KL, nats",
        log_y: false,
        lines: &[("KL", |r| Some(r.kl))],
    },
    Chart {
        title: "VAE: images, trained poses",
        x_label: "epoch",
        y_label: "PSNR, dB",
        log_y: false,
        lines: &[
            ("decoded", |r| r.figures.psnr_db),
            ("mean image of the pose", |r| r.figures.mean_image_psnr_db),
            ("decoded, pixels that change", |r| r.figures.changed_pixels_psnr_db),
        ],
    },
];

/// Charts of the state accuracy of latents.
const ACCURACY: [AccuracyChart; 3] = [
    ("State accuracy of latents, trained poses", |r| &r.figures.trained),
    ("State accuracy of latents, calibration poses", |r| &r.figures.calibration),
    ("State accuracy of latents, held-out poses", |r| &r.figures.unseen),
];

const ACCURACY_LINES: [AccuracyLine; 3] =
    [("place fully visible", |a| a.full.accuracy), ("partly", |a| a.partial.accuracy), ("not", |a| a.none.accuracy)];

const MIXTURE: [Chart<MixtureRecord>; 1] = [Chart {
    title: "Mixture density network",
    x_label: "step",
    y_label: "negative log-likelihood, nats",
    log_y: false,
    lines: &[("mean of 100 steps", |r| Some(r.negative_log_likelihood))],
}];

const FIELD: [Chart<FieldRecord>; 2] = [
    Chart {
        title: "Field: loss",
        x_label: "step",
        y_label: "loss",
        log_y: true,
        lines: &[("running mean", |r| Some(r.loss))],
    },
    Chart {
        title: "Field: rays",
        x_label: "step",
        y_label: "PSNR, dB",
        log_y: false,
        lines: &[("running mean", |r| Some(r.ray_psnr_db))],
    },
];

/// Draws `curves.png` in a run's folder from its metrics file. Without figures there is no image.
pub fn draw(dir: &Path) -> Result<(), TrainingError> {
    let panels = training_curves(dir)?;
    if panels.is_empty() {
        return Ok(());
    }
    Ok(carff_plots::curves(&dir.join("curves.png"), "Training", &panels)?)
}

/// Charts of a run's metrics file; empty without figures. A truncated line, left by a killed run, is skipped. A record
/// with an unknown or missing key is an error.
pub fn training_curves(dir: &Path) -> Result<Vec<Panel>, TrainingError> {
    let path = dir.join(METRICS);
    let bytes = match std::fs::read(&path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(source) => return Err(TrainingError::File { path, source }),
    };
    let text = String::from_utf8_lossy(&bytes);
    let lines = text.lines().enumerate();
    let lines = lines.filter_map(|(i, line)| Some((i + 1, serde_json::from_str(line).ok()?))).collect();
    Metrics { path, lines }.panels()
}

/// The metrics file: line numbers and lines.
struct Metrics {
    path: PathBuf,
    lines: Vec<(usize, Value)>,
}

impl Metrics {
    fn panels(&self) -> Result<Vec<Panel>, TrainingError> {
        let vae = self.records::<VaeRecord>(names::VAE)?;
        let mut panels = charts(&VAE, &vae);
        panels.extend(ACCURACY.map(|(title, of)| {
            let line = |(name, figure): AccuracyLine| series(name, &vae, |r| Some(100.0 * figure(of(r))));
            panel(title, ["epoch", "correct, %"], false, ACCURACY_LINES.map(line))
        }));
        panels.extend(charts(&MIXTURE, &self.records(names::MIXTURE)?));
        panels.extend(charts(&FIELD, &self.records(names::FIELD)?));
        panels.retain(|panel| !panel.series.is_empty());
        Ok(panels)
    }

    /// Records of a phase by epoch or step. A killed run resumes from its last saved state: later records of the
    /// earlier run are replaced.
    fn records<R: Record>(&self, phase: &str) -> Result<BTreeMap<u64, R>, TrainingError> {
        let mut rows = BTreeMap::new();
        for (number, line) in &self.lines {
            let wrong = |what: String| TrainingError::Format {
                path: self.path.clone(),
                what: format!("line {number}: {what}; remove the file to draw curves from now on"),
            };
            let line = MetricsLine::<Map<String, Value>>::deserialize(line).map_err(|e| wrong(e.to_string()))?;
            if line.phase != phase {
                continue;
            }
            let record: R = serde_json::from_value(line.record.into()).map_err(|e| wrong(e.to_string()))?;
            rows.split_off(&record.x());
            rows.insert(record.x(), record);
        }
        Ok(rows)
    }
}

fn charts<R>(charts: &[Chart<R>], records: &BTreeMap<u64, R>) -> Vec<Panel> {
    let chart = |chart: &Chart<R>| {
        let lines = chart.lines.iter().map(|(name, figure)| series(name, records, figure));
        panel(chart.title, [chart.x_label, chart.y_label], chart.log_y, lines)
    };
    charts.iter().map(chart).collect()
}

fn series<R>(name: &str, records: &BTreeMap<u64, R>, figure: impl Fn(&R) -> Option<f64>) -> Series {
    let points = records.iter().filter_map(|(x, record)| Some((*x as f64, figure(record)?)));
    Series { name: name.into(), points: points.filter(|(_, y)| y.is_finite()).collect(), ..Series::default() }
}

fn panel(title: &str, [x_label, y_label]: [&str; 2], log_y: bool, lines: impl IntoIterator<Item = Series>) -> Panel {
    Panel {
        title: title.into(),
        x_label: x_label.into(),
        y_label: y_label.into(),
        log_y,
        series: lines.into_iter().filter(|s| !s.points.is_empty()).collect(),
        ..Panel::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_evaluation::VaeFigures;

    /// A line of the metrics file.
    fn line(phase: &str, record: &impl serde::Serialize) -> String {
        serde_json::to_string(&MetricsLine { phase: phase.to_owned(), record }).unwrap() + "\n"
    }

    fn vae(epoch: u64, loss: f64, kl: f64) -> String {
        let mut figures = VaeFigures::default();
        figures.trained.full.accuracy = 0.25;
        line("vae", &VaeRecord { epoch, loss, reconstruction: 1.0, kl, state: 1.0, figures })
    }

    fn metrics() -> String {
        let mut text = [vae(1, 4.0, 1.0), vae(2, 3.0, 2.0), vae(3, 9.0, 3.0)].concat();
        text += "{\"phase\":\"vae\",\"epoch\":4,\"lo\n";
        text += &vae(2, 2.5, f64::NAN);
        text += "{\"phase\":\"threshold\",\"threshold\":0.5}\n";
        text += &line("nerf", &FieldRecord { step: 100, loss: 0.01, ray_psnr_db: 17.0 });
        text + "{\"phase\":\"nerf\",\"step\":200,\"loss\":0.0"
    }

    fn written(text: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(METRICS), text).unwrap();
        dir
    }

    fn points<'a>(panels: &'a [Panel], title: &str, name: &str) -> &'a [(f64, f64)] {
        let panel = panels.iter().find(|p| p.title == title).unwrap();
        &panel.series.iter().find(|s| s.name == name).unwrap().points
    }

    /// Records of a killed run are replaced from the epoch at which it resumed; truncated lines are skipped; figures
    /// that a record lacks, or that are not finite, have no point; charts without figures are left out.
    #[test]
    fn a_killed_and_resumed_run_is_read() {
        let panels = training_curves(written(&metrics()).path()).unwrap();
        assert_eq!(points(&panels, "VAE: loss and its parts", "all"), [(1.0, 4.0), (2.0, 2.5)]);
        assert_eq!(points(&panels, "VAE: divergence of the posterior", "KL"), [(1.0, 1.0)]);
        let accuracy = points(&panels, "State accuracy of latents, trained poses", "place fully visible");
        assert_eq!(accuracy, [(1.0, 25.0), (2.0, 25.0)]);
        assert_eq!(points(&panels, "Field: rays", "running mean"), [(100.0, 17.0)]);
        assert!(panels.iter().all(|p| p.title != "Mixture density network" && p.title != "VAE: images, trained poses"));
    }

    /// A file of an earlier version, whose lines name their phase `stage`, has the same curves. A key too many is an
    /// error.
    #[test]
    fn an_earlier_file_is_read() {
        let curves = |text: &str| training_curves(written(text).path());
        let earlier = curves(&metrics().replace("\"phase\"", "\"stage\"")).unwrap();
        assert_eq!(format!("{earlier:?}"), format!("{:?}", curves(&metrics()).unwrap()));
        assert!(curves(&metrics().replace("\"ray_psnr_db\"", "\"more\":1,\"ray_psnr_db\"")).is_err());
    }

    /// A record with a renamed key is an error that names file and line, never a missing point.
    #[test]
    fn a_renamed_key_is_an_error() {
        for key in ["phase", "epoch", "kl", "accuracy", "calibration", "ray_psnr_db"] {
            let text = metrics().replace(&format!("\"{key}\""), "\"renamed\"");
            let error = training_curves(written(&text).path()).expect_err(key).to_string();
            assert!(error.contains(METRICS) && error.contains("line "), "{key}: {error}");
        }
    }

    /// The image is a PNG in the run's folder. A run without metrics, or without figures, has no image and no error.
    #[test]
    fn the_image_is_in_the_run_folder() {
        let dir = tempfile::tempdir().unwrap();
        draw(dir.path()).unwrap();
        std::fs::write(dir.path().join(METRICS), "{\"phase\":\"thr").unwrap();
        draw(dir.path()).unwrap();
        assert!(!dir.path().join("curves.png").exists());
        std::fs::write(dir.path().join(METRICS), metrics()).unwrap();
        draw(dir.path()).unwrap();
        let image = carff_dataset::Image::load(&dir.path().join("curves.png")).unwrap();
        assert!(image.width_px > 1000 && image.height_px > 700);
    }
}
