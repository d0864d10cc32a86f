//! The report of a run: its own figures as JSON and text, and the files that hold it.

use crate::planning::{self, RunOutcome};
use crate::supervision::monitor::UnknownImages;
use anyhow::{Context, ensure};
use carff::conditions::{ConditionCount, Conditions};
use carff::provenance;
use carff_base::files::check_writable;
use carff_base::statistics::percentile;
use carff_checkpoint::Manifest;
use carff_messages::{Stage, UnknownBox};
use carff_trials::CheckpointFigures;
use carff_trials::run::DriveCounts;
use serde_json::{Map, Value, json};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Converts times in nanoseconds to p50, p99 and max in milliseconds; null if there are no times.
pub fn quantiles_ms<'a>(times_ns: impl IntoIterator<Item = &'a u64>) -> Value {
    let times_ms: Vec<f64> = times_ns.into_iter().map(|&ns| ns as f64 / 1e6).collect();
    let at = |share: f64| percentile(&times_ms, share);
    json!({ "p50": at(0.5), "p99": at(0.99), "max": at(1.0), "count": times_ms.len() })
}

/// Files of a report: JSON at the path that the user gave, text and filmstrip next to it.
#[derive(Clone, Debug)]
pub struct ReportFiles {
    /// The report as JSON.
    pub json: PathBuf,
    /// The report as text.
    pub text: PathBuf,
    /// The filmstrip, a PNG image.
    pub strip: PathBuf,
}

impl ReportFiles {
    /// Names the files, and checks that they can be written.
    pub fn checked(json: &Path) -> anyhow::Result<Self> {
        let files = Self { json: json.to_owned(), text: json.with_extension("txt"), strip: json.with_extension("png") };
        ensure!(
            files.json != files.text && files.json != files.strip,
            "--report {}: this is the JSON file; its text and its filmstrip get the endings .txt and .png, so name it \
             with another one, such as {}",
            json.display(),
            json.with_extension("json").display()
        );
        for path in [&files.json, &files.text, &files.strip] {
            check_writable(path)?;
        }
        Ok(files)
    }

    /// Writes the report.
    pub fn write(&self, report: &Value, text: &str) -> anyhow::Result<()> {
        for (path, text) in
            [(&self.json, &(serde_json::to_string_pretty(report)? + "\n")), (&self.text, &text.to_owned())]
        {
            std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }
}

/// Returns the report as JSON.
pub fn json(outcome: &RunOutcome) -> Value {
    let records = &outcome.records;
    let decided: Vec<u64> = records.frames.values().filter(|f| f.action.is_some()).map(|f| f.latency_ns).collect();
    let by_stage = |value: &dyn Fn(Stage) -> Option<Value>| -> Value {
        Stage::ALL.iter().filter_map(|&s| Some((s.name().to_owned(), value(s)?))).collect::<Map<_, _>>().into()
    };
    let stage = |s: Stage| records.stages.get(&s);
    let mut report = json!({
        "run": outcome.run,
        "origin": outcome.origin,
        "graph": outcome.graph_file,
        "seed": outcome.graph.run.seed,
        "interrupted": outcome.interrupted,
        "frames": records.frame_count(),
        "frames_not_recorded": records.frame_count() - records.frames.len() as u64,
        "decisions": decided.len(),
        "actions": records.actions,
        "actions_not_recorded": records.actions_not_recorded,
        "safe_actions": records.safe_actions,
        "unusable_images": unusable_images(&records.conditions),
        "images_compared": records.compared,
        "unknown_images": unknown_images(&records.unknown),
        "skipped": records.skipped(),
        "skipped_by_stage": by_stage(&|s| Some(stage(s)?.skipped.into())),
        "invalid_by_stage": by_stage(&|s| Some(stage(s)?.invalid.into())),
        "errors_by_stage": by_stage(&|s| Some(stage(s)?.errors.into())),
        "given_up": records.given_up,
        "restarts": outcome.restarts.values().sum::<u32>(),
        "restarts_by_stage": by_stage(&|s| Some((*outcome.restarts.get(&s)?).into())),
        "latency_ms": {
            "camera_to_action": quantiles_ms(&decided),
            "encoder": quantiles_ms(&records.encoder_ns),
            "forecaster": quantiles_ms(&records.forecaster_ns),
            "prober": quantiles_ms(&records.prober_ns),
            "comparison": quantiles_ms(&records.compare_ns),
            "renderer": quantiles_ms(&records.renderer_ns),
        },
        "memory_mb": by_stage(&|s| Some((stage(s)?.max_rss_bytes as f64 / 1e6).into())),
    });
    if let Some(drives) = drives(outcome) {
        report["drives"] = json!(drives);
    }
    if let Some(figures) = checkpoint_figures(outcome) {
        report["checkpoint_metrics"] = json!(figures);
    }
    report
}

/// Counts of the images that no decision rests on, by condition.
fn unusable_images(conditions: &Conditions) -> Map<String, Value> {
    let count = |count: &ConditionCount| {
        json!({
            "images": count.images,
            "episodes": count.episodes,
            "worst_frames_to_safe_action": count.worst_frames_to_safe_action,
        })
    };
    conditions.unusable().map(|(condition, counted)| (condition.name().to_owned(), count(counted))).collect()
}

/// Returns the same as lines of text; empty if every image was usable.
fn unusable_text(conditions: &Conditions) -> String {
    conditions.unusable().fold(String::new(), |text, (condition, count)| {
        let ConditionCount { images, episodes, .. } = count;
        let action = count.worst_frames_to_safe_action.map_or("none was recorded".to_owned(), |frames| {
            format!("at the latest with frame {frames} of an episode")
        });
        text + &format!("unusable images: {images} {condition} ({episodes}x); safe action: {action}\n")
    })
}

/// Images with something that no known state explains, and the box of the most probable one.
fn unknown_images(unknown: &UnknownImages) -> Value {
    let surest = unknown.surest.map(|(frame_id, surest)| {
        let UnknownBox { center, half_size, probability, .. } = surest;
        json!({ "frame_id": frame_id, "probability": probability, "center_m": center, "half_size_m": half_size })
    });
    json!({ "images": unknown.images, "surest": surest })
}

/// Returns the same as a line of text; empty without such images.
fn unknown_text(unknown: &UnknownImages) -> String {
    let surest = unknown.surest.map(|(frame_id, surest)| {
        let ([x, y, _], percent) = (surest.center, 100.0 * surest.probability);
        format!("; the surest box is in frame {frame_id} at x {x:.1} m, y {y:.1} m ({percent:.0} %)")
    });
    match unknown.images {
        0 => String::new(),
        images => format!("something unknown: {images} images{}\n", surest.unwrap_or_default()),
    }
}

/// Correct decisions of the run's drives; `None` for a run without a decisive frame.
fn drives(outcome: &RunOutcome) -> Option<DriveCounts> {
    let decisive = planning::decisive(outcome);
    (!decisive.is_empty()).then(|| {
        let run = &outcome.graph.run;
        DriveCounts::of(outcome.graph.controller.rule, run.samples as usize, &decisive)
    })
}

/// Figures of the checkpoint, as measured in training; `None` for a checkpoint without readable figures.
fn checkpoint_figures(outcome: &RunOutcome) -> Option<CheckpointFigures> {
    CheckpointFigures::of(&Manifest::load(&outcome.checkpoint).ok()?, &outcome.checkpoint).ok()
}

/// Returns the report as text: counts and latency, the correct decisions of the drives, figures of the checkpoint.
pub fn text(outcome: &RunOutcome, report: &Value) -> String {
    let latency = &report["latency_ms"]["camera_to_action"];
    let ms = |key: &str| latency[key].as_f64().map_or("-".to_owned(), |v| format!("{v:.1}"));
    let mut text = format!(
        "{} frames, {} decisions, {} actions, {} skipped, {} restarts; camera to action: p50 {} ms, p99 {} ms, max {} ms\n",
        report["frames"],
        report["decisions"],
        report["actions"],
        report["skipped"],
        report["restarts"],
        ms("p50"),
        ms("p99"),
        ms("max")
    );
    let [frames, actions] =
        ["frames_not_recorded", "actions_not_recorded"].map(|key| report[key].as_u64().unwrap_or(0));
    if frames + actions > 0 {
        let _ = writeln!(
            text,
            "not recorded, because the launcher was stopped or slow: {frames} frames, {actions} actions; the counts of \
             decisions and drives are without them"
        );
    }
    text += &unusable_text(&outcome.records.conditions);
    text += &unknown_text(&outcome.records.unknown);
    if let Some(drives) = drives(outcome) {
        let _ = writeln!(text, "\n{}", drives.text());
    }
    if let Some(figures) = checkpoint_figures(outcome) {
        let _ = writeln!(text, "\nModels, as measured in training\n  {}", figures.summary().replace('\n', "\n  "));
    }
    let _ = writeln!(text, "\n{}", provenance::text(&outcome.origin));
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Header, ImageCheck, ImageCondition};

    /// Quantiles are measured times; of a hundred, p99 is the 99th and max the last; of none, they are null.
    #[test]
    fn quantiles_are_exact() {
        let times: Vec<u64> = (1..=100).rev().map(|ms| ms * 1_000_000).collect();
        assert_eq!(quantiles_ms(&times), json!({ "p50": 50.0, "p99": 99.0, "max": 100.0, "count": 100 }));
        assert_eq!(quantiles_ms(&[7_000_000])["p99"], json!(7.0));
        assert_eq!(quantiles_ms(&[])["p50"], Value::Null);
    }

    /// The report has the number of images with something unknown, and the box of the most probable one.
    #[test]
    fn unknown_images_are_reported() {
        assert_eq!(unknown_text(&UnknownImages::default()), "");
        assert_eq!(unknown_images(&UnknownImages::default()), json!({ "images": 0, "surest": null }));
        let (center, half_size) = ([-6.25, -1.5, 0.5], [1.0, 2.0, 0.5]);
        let surest = UnknownBox { center, half_size, probability: 0.75, place: -1 };
        let unknown = UnknownImages { images: 3, surest: Some((41, surest)) };
        let found = json!({ "frame_id": 41, "probability": 0.75, "center_m": center, "half_size_m": half_size });
        assert_eq!(unknown_images(&unknown), json!({ "images": 3, "surest": found }));
        let text = unknown_text(&unknown);
        assert_eq!(text, "something unknown: 3 images; the surest box is in frame 41 at x -6.2 m, y -1.5 m (75 %)\n");
    }

    /// The files of a report are three, and a path that would make two of them one is refused.
    #[test]
    fn reports_do_not_overwrite_themselves() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["run.json", "run", "run.report", ".json"] {
            let files = ReportFiles::checked(&dir.path().join(name)).unwrap();
            assert!(files.json != files.text && files.json != files.strip, "{files:?}");
        }
        for name in ["run.txt", "run.png"] {
            let error = ReportFiles::checked(&dir.path().join(name)).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("run.json"), "{error}");
        }
    }

    /// Each unusable condition has its counts in JSON and a line of text; usable images have none.
    #[test]
    fn unusable_images_are_reported() {
        let mut conditions = Conditions::default();
        for (frame_id, condition) in
            [(1, ImageCondition::Usable), (2, ImageCondition::Black), (3, ImageCondition::Black)]
        {
            let check = ImageCheck::of_frame(Header::of_frame(frame_id, frame_id, 1));
            conditions.take_check(&ImageCheck { condition: condition.code(), ..check });
        }
        let counts = json!({ "images": 2, "episodes": 1, "worst_frames_to_safe_action": null });
        assert_eq!(Value::from(unusable_images(&conditions)), json!({ "black": counts }));
        let text = unusable_text(&conditions);
        assert_eq!(text, "unusable images: 2 black (1x); safe action: none was recorded\n");
    }
}
