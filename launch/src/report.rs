//! The report of a run: its own figures as JSON and text, and the files that hold it.

use crate::planning::{self, RunOutcome};
use crate::supervision::monitor::UnknownImages;
use anyhow::{Context, ensure};
use carff::conditions::ConditionCount;
use carff::provenance::{self, Origin};
use carff_base::files::check_writable;
use carff_base::statistics::percentile;
use carff_checkpoint::Manifest;
use carff_messages::UnknownBox;
use carff_trials::CheckpointFigures;
use carff_trials::run::{DriveCounts, RunPlanning};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Quantiles of times, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quantiles {
    /// Number of times.
    pub count: usize,
    /// Largest time; `None` without times, as for the other quantiles.
    pub max: Option<f64>,
    /// Median.
    pub p50: Option<f64>,
    /// Time that 99 of 100 do not exceed.
    pub p99: Option<f64>,
}

impl Quantiles {
    /// Quantiles of times in nanoseconds.
    fn of_ns<'a>(times_ns: impl IntoIterator<Item = &'a u64>) -> Self {
        let times_ms: Vec<f64> = times_ns.into_iter().map(|&ns| ns as f64 / 1e6).collect();
        let at = |share: f64| percentile(&times_ms, share);
        Self { count: times_ms.len(), max: at(1.0), p50: at(0.5), p99: at(0.99) }
    }
}

/// The report of a run, as its JSON file has it.
#[derive(Clone, Debug, Serialize)]
pub struct RunReport {
    /// Run name.
    pub run: String,
    /// Program, host, start and checkpoint of the run.
    pub origin: Origin,
    /// Path of the graph file.
    pub graph: String,
    /// Random seed.
    pub seed: u64,
    /// True if a signal ended the run.
    pub interrupted: bool,
    /// Camera frames.
    pub frames: u64,
    /// Frames among them that the launcher did not read in time.
    pub frames_not_recorded: u64,
    /// Frames with a decision.
    pub decisions: usize,
    /// Published actions: decisions and repeats.
    pub actions: u64,
    /// Actions among them that the launcher did not read in time.
    pub actions_not_recorded: u64,
    /// Safe actions by reason.
    pub safe_actions: BTreeMap<&'static str, u64>,
    /// Images that no decision rests on, by condition.
    pub unusable_images: BTreeMap<&'static str, ConditionCount>,
    /// Images that were compared with the known states.
    pub images_compared: u64,
    /// Images among them with something unknown.
    pub unknown_images: UnknownReport,
    /// Messages that stages have skipped.
    pub skipped: u64,
    /// Skipped messages by stage.
    pub skipped_by_stage: BTreeMap<&'static str, u64>,
    /// Invalid messages that stages have dropped.
    pub invalid_by_stage: BTreeMap<&'static str, u64>,
    /// Errors that stages have survived.
    pub errors_by_stage: BTreeMap<&'static str, u64>,
    /// Reductions under overload.
    pub given_up: BTreeMap<&'static str, u64>,
    /// Restarts of stages.
    pub restarts: u32,
    /// Restarts by stage.
    pub restarts_by_stage: BTreeMap<&'static str, u32>,
    /// Times of the frames and of the stages.
    pub latency_ms: LatencyReport,
    /// Largest resident memory by stage, MB.
    pub memory_mb: BTreeMap<&'static str, f64>,
    /// Correct decisions of the drives; missing for a run without a decisive frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drives: Option<DriveCounts>,
    /// Figures of the checkpoint, as measured in training; missing for a checkpoint without readable figures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint_metrics: Option<CheckpointFigures>,
    /// Every rule over the run's drives and over every eligible image; only on request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub planning: Option<RunPlanning>,
}

/// Times of a run.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct LatencyReport {
    /// From the capture of a frame to its decision.
    pub camera_to_action: Quantiles,
    /// Encoding of a frame.
    pub encoder: Quantiles,
    /// A forecast step.
    pub forecaster: Quantiles,
    /// Probing of a step.
    pub prober: Quantiles,
    /// Comparison of an image with the known states.
    pub comparison: Quantiles,
    /// Rendering of a view.
    pub renderer: Quantiles,
}

/// Images with something that no known state explains.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct UnknownReport {
    /// Number of images.
    pub images: u64,
    /// Box of the most probable one.
    pub surest: Option<SurestUnknown>,
}

/// The most probable box of something unknown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SurestUnknown {
    /// Number of its frame.
    pub frame_id: u64,
    /// Probability, 0..=1.
    pub probability: f32,
    /// Center, metres, world space.
    pub center_m: [f64; 3],
    /// Half of its size, metres.
    pub half_size_m: [f64; 3],
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
    pub fn write(&self, report: &RunReport, text: &str) -> anyhow::Result<()> {
        for (path, text) in
            [(&self.json, &(serde_json::to_string_pretty(report)? + "\n")), (&self.text, &text.to_owned())]
        {
            std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }
}

impl RunReport {
    /// Reports a finished run, without tables.
    pub fn of(outcome: &RunOutcome) -> Self {
        let records = &outcome.records;
        let decided: Vec<u64> = records.frames.values().filter(|f| f.action.is_some()).map(|f| f.latency_ns).collect();
        let stages = || records.stages.iter().map(|(stage, summary)| (stage.name(), summary));
        Self {
            run: outcome.run.clone(),
            origin: outcome.origin.clone(),
            graph: outcome.graph_file.clone(),
            seed: outcome.graph.run.seed,
            interrupted: outcome.interrupted,
            frames: records.frame_count(),
            frames_not_recorded: records.frame_count() - records.frames.len() as u64,
            decisions: decided.len(),
            actions: records.actions,
            actions_not_recorded: records.actions_not_recorded,
            safe_actions: records.safe_actions.clone(),
            unusable_images: records.conditions.unusable().map(|(what, count)| (what.name(), *count)).collect(),
            images_compared: records.compared,
            unknown_images: UnknownReport::of(&records.unknown),
            skipped: records.skipped(),
            skipped_by_stage: stages().map(|(stage, summary)| (stage, summary.skipped)).collect(),
            invalid_by_stage: stages().map(|(stage, summary)| (stage, summary.invalid)).collect(),
            errors_by_stage: stages().map(|(stage, summary)| (stage, summary.errors)).collect(),
            given_up: records.given_up.clone(),
            restarts: outcome.restarts.values().sum(),
            restarts_by_stage: outcome.restarts.iter().map(|(stage, count)| (stage.name(), *count)).collect(),
            latency_ms: LatencyReport {
                camera_to_action: Quantiles::of_ns(&decided),
                encoder: Quantiles::of_ns(&records.encoder_ns),
                forecaster: Quantiles::of_ns(&records.forecaster_ns),
                prober: Quantiles::of_ns(&records.prober_ns),
                comparison: Quantiles::of_ns(&records.compare_ns),
                renderer: Quantiles::of_ns(&records.renderer_ns),
            },
            memory_mb: stages().map(|(stage, summary)| (stage, summary.max_rss_bytes as f64 / 1e6)).collect(),
            drives: drives(outcome),
            checkpoint_metrics: checkpoint_figures(outcome),
            planning: None,
        }
    }

    /// Returns the report as text: counts and latency, the correct decisions of the drives, figures of the checkpoint.
    pub fn text(&self) -> String {
        let Self { frames, decisions, actions, skipped, restarts, .. } = self;
        let [p50, p99, max] = {
            let Quantiles { p50, p99, max, .. } = self.latency_ms.camera_to_action;
            [p50, p99, max].map(|ms| ms.map_or("-".to_owned(), |ms| format!("{ms:.1}")))
        };
        let mut text = format!(
            "{frames} frames, {decisions} decisions, {actions} actions, {skipped} skipped, {restarts} restarts; \
             camera to action: p50 {p50} ms, p99 {p99} ms, max {max} ms\n"
        );
        let (frames, actions) = (self.frames_not_recorded, self.actions_not_recorded);
        if frames + actions > 0 {
            let _ = writeln!(
                text,
                "not recorded, because the launcher was stopped or slow: {frames} frames, {actions} actions; the \
                 counts of decisions and drives are without them"
            );
        }
        text += &unusable_text(&self.unusable_images);
        text += &self.unknown_images.text();
        if let Some(drives) = &self.drives {
            let _ = writeln!(text, "\n{}", drives.text());
        }
        if let Some(figures) = &self.checkpoint_metrics {
            let _ = writeln!(text, "\nModels, as measured in training\n  {}", figures.summary().replace('\n', "\n  "));
        }
        let _ = writeln!(text, "\n{}", provenance::text(&self.origin));
        text
    }
}

/// Counts of unusable images as lines of text; empty if every image was usable.
fn unusable_text(unusable: &BTreeMap<&str, ConditionCount>) -> String {
    unusable.iter().fold(String::new(), |text, (condition, count)| {
        let ConditionCount { images, episodes, .. } = count;
        let action = count.worst_frames_to_safe_action.map_or("none was recorded".to_owned(), |frames| {
            format!("at the latest with frame {frames} of an episode")
        });
        text + &format!("unusable images: {images} {condition} ({episodes}x); safe action: {action}\n")
    })
}

impl UnknownReport {
    fn of(unknown: &UnknownImages) -> Self {
        let surest = unknown.surest.map(|(frame_id, surest)| {
            let UnknownBox { center, half_size, probability, .. } = surest;
            SurestUnknown { frame_id, probability, center_m: center, half_size_m: half_size }
        });
        Self { images: unknown.images, surest }
    }

    /// Returns a line of text; empty without such images.
    fn text(&self) -> String {
        let surest = self.surest.map(|surest| {
            let SurestUnknown { frame_id, center_m: [x, y, _], probability, .. } = surest;
            let percent = 100.0 * probability;
            format!("; the surest box is in frame {frame_id} at x {x:.1} m, y {y:.1} m ({percent:.0} %)")
        });
        match self.images {
            0 => String::new(),
            images => format!("something unknown: {images} images{}\n", surest.unwrap_or_default()),
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use carff::conditions::Conditions;
    use carff_messages::{Header, ImageCheck, ImageCondition};
    use serde_json::{Value, json};

    /// Quantiles are measured times; of a hundred, p99 is the 99th and max the last; of none, there are none.
    #[test]
    fn quantiles_are_exact() {
        let times: Vec<u64> = (1..=100).rev().map(|ms| ms * 1_000_000).collect();
        let quantiles = Quantiles { count: 100, max: Some(100.0), p50: Some(50.0), p99: Some(99.0) };
        assert_eq!(Quantiles::of_ns(&times), quantiles);
        assert_eq!(Quantiles::of_ns(&[7_000_000]).p99, Some(7.0));
        assert_eq!(json!(Quantiles::of_ns(&[]))["p50"], Value::Null);
    }

    /// The report has the number of images with something unknown, and the box of the most probable one.
    #[test]
    fn unknown_images_are_reported() {
        let none = UnknownReport::of(&UnknownImages::default());
        assert_eq!((none.text(), json!(none)), (String::new(), json!({ "images": 0, "surest": null })));
        let (center, half_size) = ([-6.25, -1.5, 0.5], [1.0, 2.0, 0.5]);
        let surest = UnknownBox { center, half_size, probability: 0.75, place: -1 };
        let unknown = UnknownReport::of(&UnknownImages { images: 3, surest: Some((41, surest)) });
        let found = json!({ "frame_id": 41, "probability": 0.75, "center_m": center, "half_size_m": half_size });
        assert_eq!(json!(unknown), json!({ "images": 3, "surest": found }));
        let line = "something unknown: 3 images; the surest box is in frame 41 at x -6.2 m, y -1.5 m (75 %)\n";
        assert_eq!(unknown.text(), line);
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
        let counted: BTreeMap<_, _> = conditions.unusable().map(|(what, count)| (what.name(), *count)).collect();
        let counts = json!({ "images": 2, "episodes": 1, "worst_frames_to_safe_action": null });
        assert_eq!(json!(counted), json!({ "black": counts }));
        let text = unusable_text(&counted);
        assert_eq!(text, "unusable images: 2 black (1x); safe action: none was recorded\n");
    }
}
