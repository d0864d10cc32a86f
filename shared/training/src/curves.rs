//! What a run's `metrics.jsonl` says, as a picture: `curves.png` beside it.

use crate::TrainingError;
use carff_plots::{Panel, Series};
use serde_json::Value;
use std::{collections::BTreeMap, path::Path};

/// One chart: its figures by their place in a record of a stage.
struct Chart {
    title: &'static str,
    stage: &'static str,
    /// Key of what is counted along x.
    x: &'static str,
    y_label: &'static str,
    log_y: bool,
    /// Figures are multiplied by this.
    factor: f64,
    /// Name and JSON pointer of each line.
    lines: &'static [(&'static str, &'static str)],
}

const PLAIN: Chart = Chart { title: "", stage: "vae", x: "epoch", y_label: "", log_y: false, factor: 1.0, lines: &[] };
const ACCURACY: Chart = Chart { y_label: "right, %", factor: 100.0, ..PLAIN };

const CHARTS: [Chart; 9] = [
    Chart {
        title: "VAE: loss and its parts",
        y_label: "loss",
        log_y: true,
        lines: &[("all", "/loss"), ("reconstruction", "/reconstruction"), ("state", "/state")],
        ..PLAIN
    },
    Chart { title: "VAE: divergence of the posterior", y_label: "KL, nats", lines: &[("KL", "/kl")], ..PLAIN },
    Chart {
        title: "VAE: pictures, trained poses",
        y_label: "PSNR, dB",
        lines: &[
            ("decoded", "/psnr_db"),
            ("mean picture of the pose", "/mean_picture_psnr_db"),
            ("decoded, pixels that change", "/changed_pixels_psnr_db"),
        ],
        ..PLAIN
    },
    Chart {
        title: "State accuracy of latents, trained poses",
        lines: &[
            ("place fully visible", "/trained/full/accuracy"),
            ("partly", "/trained/partial/accuracy"),
            ("not", "/trained/none/accuracy"),
        ],
        ..ACCURACY
    },
    Chart {
        title: "State accuracy of latents, calibration poses",
        lines: &[
            ("place fully visible", "/calibration/full/accuracy"),
            ("partly", "/calibration/partial/accuracy"),
            ("not", "/calibration/none/accuracy"),
        ],
        ..ACCURACY
    },
    Chart {
        title: "State accuracy of latents, unseen poses",
        lines: &[
            ("place fully visible", "/unseen/full/accuracy"),
            ("partly", "/unseen/partial/accuracy"),
            ("not", "/unseen/none/accuracy"),
        ],
        ..ACCURACY
    },
    Chart {
        title: "Mixture density network",
        stage: "mdn",
        x: "step",
        y_label: "negative log-likelihood, nats",
        lines: &[("mean of 100 steps", "/negative_log_likelihood")],
        ..PLAIN
    },
    Chart {
        title: "Field: loss",
        stage: "nerf",
        x: "step",
        y_label: "loss",
        log_y: true,
        lines: &[("running mean", "/loss")],
        ..PLAIN
    },
    Chart {
        title: "Field: rays",
        stage: "nerf",
        x: "step",
        y_label: "PSNR, dB",
        lines: &[("running mean", "/ray_psnr_db")],
        ..PLAIN
    },
];

/// Draws `curves.png` in a run's folder from its `metrics.jsonl`. Without any figure there is no picture.
pub fn draw(dir: &Path) -> Result<(), TrainingError> {
    draw_to(dir, &dir.join("curves.png")).map(|_| ())
}

/// [`draw`] into another file; says whether there was anything to draw.
pub fn draw_to(dir: &Path, picture: &Path) -> Result<bool, TrainingError> {
    let path = dir.join("metrics.jsonl");
    let bytes = match std::fs::read(&path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(false),
        Err(source) => return Err(TrainingError::File { path, source }),
    };
    let panels = panels(&String::from_utf8_lossy(&bytes));
    if panels.is_empty() {
        return Ok(false);
    }
    carff_plots::curves(picture, "Training", &panels)?;
    Ok(true)
}

/// The charts for which there are figures. A line that was cut off when a run was killed is passed over.
fn panels(metrics: &str) -> Vec<Panel> {
    let records: Vec<Value> = metrics.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    CHARTS.iter().map(|chart| panel(chart, &records)).filter(|p| !p.series.is_empty()).collect()
}

fn panel(chart: &Chart, records: &[Value]) -> Panel {
    let rows = current(chart, records);
    let points = |pointer: &str| -> Vec<(f64, f64)> {
        let figure = |record: &Value| record.pointer(pointer).and_then(Value::as_f64);
        rows.iter().filter_map(|(x, record)| Some((*x as f64, figure(record)? * chart.factor))).collect()
    };
    let series = chart.lines.iter().map(|(name, pointer)| Series {
        name: (*name).into(),
        points: points(pointer),
        ..Series::default()
    });
    Panel {
        title: chart.title.into(),
        x_label: chart.x.into(),
        y_label: chart.y_label.into(),
        log_y: chart.log_y,
        series: series.filter(|s| !s.points.is_empty()).collect(),
        ..Panel::default()
    }
}

/// A stage's records by epoch or step. A run that was killed goes on from its last saved state: what an earlier run
/// recorded from there on counts no more.
fn current<'a>(chart: &Chart, records: &'a [Value]) -> BTreeMap<u64, &'a Value> {
    let mut rows = BTreeMap::new();
    for record in records.iter().filter(|r| r["stage"] == chart.stage) {
        if let Some(x) = record[chart.x].as_u64() {
            rows.split_off(&x);
            rows.insert(x, record);
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    const METRICS: &str = concat!(
        r#"{"stage":"vae","epoch":1,"loss":4.0,"kl":1.0,"trained":{"full":{"accuracy":0.25}}}"#,
        "\n",
        r#"{"stage":"vae","epoch":2,"loss":3.0,"kl":2.0,"psnr_db":20.0}"#,
        "\n",
        r#"{"stage":"vae","epoch":3,"loss":9.0,"kl":3.0}"#,
        "\n",
        r#"{"stage":"vae","epoch":4,"lo"#,
        "\n",
        r#"{"stage":"vae","epoch":2,"loss":2.5,"kl":null}"#,
        "\n",
        r#"{"stage":"threshold","threshold":0.5}"#,
        "\n",
        r#"{"stage":"nerf","step":100,"loss":0.01,"ray_psnr_db":17.0}"#,
        "\n",
        r#"{"stage":"nerf","step":200,"loss":0.0"#,
    );

    fn points<'a>(panels: &'a [Panel], title: &str, name: &str) -> &'a [(f64, f64)] {
        let panel = panels.iter().find(|p| p.title == title).unwrap();
        &panel.series.iter().find(|s| s.name == name).unwrap().points
    }

    /// Of a run that was killed in the middle of a line and went on from an earlier epoch, what counts is what came
    /// later; lines cut off are passed over; figures that a record lacks leave no point, and charts without figures are
    /// left out.
    #[test]
    fn a_killed_and_resumed_run_is_read() {
        let panels = panels(METRICS);
        assert_eq!(points(&panels, "VAE: loss and its parts", "all"), [(1.0, 4.0), (2.0, 2.5)]);
        assert_eq!(points(&panels, "VAE: divergence of the posterior", "KL"), [(1.0, 1.0)]);
        assert_eq!(points(&panels, "State accuracy of latents, trained poses", "place fully visible"), [(1.0, 25.0)]);
        assert_eq!(points(&panels, "Field: rays", "running mean"), [(100.0, 17.0)]);
        assert!(
            panels.iter().all(|p| p.title != "Mixture density network" && p.title != "VAE: pictures, trained poses")
        );
    }

    /// The picture is a PNG in the run's folder; a run without metrics, or with none that are drawn, has no picture and
    /// no error.
    #[test]
    fn the_picture_is_in_the_run_folder() {
        let dir = tempfile::tempdir().unwrap();
        draw(dir.path()).unwrap();
        std::fs::write(dir.path().join("metrics.jsonl"), "{\"stage\":\"thr").unwrap();
        draw(dir.path()).unwrap();
        assert!(!dir.path().join("curves.png").exists());
        std::fs::write(dir.path().join("metrics.jsonl"), METRICS).unwrap();
        draw(dir.path()).unwrap();
        let image = carff_dataset::Image::load_png(&dir.path().join("curves.png")).unwrap();
        assert!(image.width_px > 1000 && image.height_px > 700);
    }
}
