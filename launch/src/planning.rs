//! The planning tables of a run's report: each rule over its drives, and over every eligible view.

use crate::filmstrip;
use crate::monitor::FrameRecord;
use crate::report::RunOutcome;
use anyhow::Context;
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::FieldProbe;
use carff_config::{CameraSource, GraphConfig};
use carff_dataset::{
    Dataset, PoseRole, PoseSplit, ScenarioInfo,
    drives::{DriveKind, EligibleInput, eligible_inputs},
};
use carff_decision::{Evidence, Plan, Policy, Step, look_ahead};
use carff_evaluation::{Models, PlanningTable, SAMPLE_COUNTS, count, planning_table, trials};
use carff_messages::ActionCode;
use carff_scenes::Scenario;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

/// Least trials of a table, where its pictures allow it.
const TRIALS: usize = 300;
/// Most times that one picture is taken: pictures that differ in sensor noise alone are no new cases.
const MOST_REPEATS: usize = 5;

/// What planning made of a run.
pub struct Planning {
    setup: Setup,
    decisive: Vec<(FrameRecord, DriveKind)>,
    tables: Map<String, Value>,
}

impl Planning {
    /// What the report holds of it: `planning` and `checkpoint_metrics`.
    pub fn tables(&self) -> Map<String, Value> {
        self.tables.clone()
    }

    /// Draws some of the run's drives into a PNG file: what was seen, what came, and what was thought possible.
    pub fn write_filmstrip(&self, path: &Path) -> anyhow::Result<()> {
        filmstrip::write(path, &self.setup, &self.decisive)
    }
}

/// Computes the tables; none for a run without drives through a scenario.
pub fn evaluate(outcome: &RunOutcome) -> anyhow::Result<Option<Planning>> {
    if outcome.records.frames.values().all(|f| f.drive < 0 || f.posterior.is_none()) {
        return Ok(None);
    }
    carff_models::allocator::keep_large_blocks();
    let setup = Setup::load(outcome)?;
    let decisive = decisive_frames(outcome, &setup.scenario);
    let (drives, live) = drives_table(&setup, &decisive);
    let mut planning = json!({ "threshold": setup.threshold, "live": live });
    let name = if setup.free.is_some() { "free_drives" } else { "drives" };
    planning[name] = serde_json::to_value(drives)?;
    let split = PoseSplit::for_dataset(&setup.dataset, setup.split_seed);
    for (name, role) in [("all_views", PoseRole::Rest), ("unseen_views", PoseRole::Unseen)] {
        let (table, views) = views_table(&setup, &split.views(role))?;
        planning[name] = serde_json::to_value(table)?;
        planning["views"][name] = views;
    }
    let mut tables = Map::new();
    tables.insert("planning".into(), planning);
    tables.insert("checkpoint_metrics".into(), setup.models.manifest.metrics.clone());
    Ok(Some(Planning { setup, decisive, tables }))
}

/// All that a run's decisions rested on.
pub struct Setup {
    /// Name of the run.
    pub run: String,
    /// The graph file.
    pub graph: GraphConfig,
    /// The data set.
    pub dataset: Dataset,
    /// Its scenario.
    pub scenario: ScenarioInfo,
    /// What free drives are rendered from; none for a run of other pictures.
    pub free: Option<Scenario>,
    /// The trained models.
    pub models: Models,
    /// Threshold of the calibrated rule.
    pub threshold: f64,
    /// Seed of the split into trained and unseen poses.
    split_seed: u64,
    /// The run's seed.
    pub seed: u64,
}

impl Setup {
    fn load(outcome: &RunOutcome) -> anyhow::Result<Self> {
        let graph = GraphConfig::load(Path::new(&outcome.graph))?;
        let dataset = Dataset::open(&outcome.dataset)?;
        let scenario = dataset.scenario().context("the data set has no scenario")?.clone();
        let known = CheckpointPlanning::load(&outcome.checkpoint)?;
        let free = match (graph.camera.source, graph.scenario_path()) {
            (CameraSource::FreeDrives, Some(path)) => Some(Scenario::load(&path)?),
            _ => None,
        };
        Ok(Self {
            free,
            run: outcome.run.clone(),
            dataset,
            scenario,
            models: Models::load(&outcome.checkpoint)?,
            threshold: graph.controller.threshold.unwrap_or(known.hazard_threshold),
            split_seed: graph.camera.split_seed.unwrap_or(known.split_seed),
            seed: outcome.seed,
            graph,
        })
    }

    /// Looks ahead from what the encoder saw in a frame, with the random numbers of the run: with its number of samples
    /// these are the run's own. `None` when no posterior was recorded.
    pub fn look_ahead(&self, probe: &mut FieldProbe, frame: &FrameRecord, samples: usize) -> Option<Vec<Step>> {
        let posterior = frame.posterior?;
        let horizon = self.graph.run.horizon;
        let plan = Plan { samples, sampling: self.graph.run.sampling, horizon, seed: self.seed, frame: frame.frame_id };
        Some(look_ahead(|input, _| self.models.mixture.forecast(input), probe, &posterior, plan))
    }
}

/// Every rule over the drives of the run; and how often what the graph did is what the library says.
fn drives_table(setup: &Setup, decisive: &[(FrameRecord, DriveKind)]) -> (PlanningTable, Value) {
    let mut probe = setup.models.probe.clone();
    let mut table = PlanningTable::new();
    let (live_rule, live_samples) = (setup.graph.controller.rule, setup.graph.run.samples as usize);
    let (mut agreeing, mut compared) = (0, 0);
    for (frame, kind) in decisive {
        for samples in SAMPLE_COUNTS {
            let Some(steps) = setup.look_ahead(&mut probe, frame, samples) else { continue };
            let evidence = Evidence::of_steps(&steps);
            for policy in Policy::all(setup.threshold) {
                let mut halted = policy.decide(&evidence).halt;
                if policy.rule == live_rule && samples == live_samples {
                    // What the graph did counts, not what it should have done.
                    compared += 1;
                    agreeing += usize::from(halts(frame) == halted);
                    halted = halts(frame);
                }
                count(&mut table, policy.rule.name(), samples, *kind, halted == (*kind == DriveKind::Hazard));
            }
        }
    }
    let live = json!({
        "rule": live_rule.name(),
        "samples": live_samples,
        "compared": compared,
        "agrees_with_library": agreeing,
    });
    (table, live)
}

/// Whether the graph halted at a frame: with anything but an advance it did.
pub fn halts(frame: &FrameRecord) -> bool {
    frame.action != Some(ActionCode::Advance)
}

/// Every rule over all eligible pictures of some poses; and how many those were.
fn views_table(setup: &Setup, views: &[usize]) -> anyhow::Result<(PlanningTable, Value)> {
    let inputs = eligible_inputs(&setup.dataset, views)?;
    let of = |kind| inputs.iter().filter(|i: &&EligibleInput| i.kind == kind).count();
    let (hazards, clears) = (of(DriveKind::Hazard), of(DriveKind::Clear));
    let repeats = TRIALS.div_ceil(inputs.len().max(1)).min(MOST_REPEATS);
    let models = &setup.models;
    let trials = trials(&models.encoder, &setup.dataset, &inputs, repeats, &setup.graph.camera.noise, setup.seed)?;
    let horizon = setup.graph.run.horizon;
    let (table, _) = planning_table(
        &models.mixture,
        &models.probe,
        &trials,
        &Policy::all(setup.threshold),
        setup.graph.run.sampling,
        horizon,
    );
    Ok((table, json!({ "hazard": hazards, "clear": clears, "repeats": repeats })))
}

/// Per drive the frame whose decision counts: the last decided one of the first timestamp at which the drive is a
/// trial, as [`ScenarioInfo::trial_kind`] says.
pub fn decisive_frames(outcome: &RunOutcome, scenario: &ScenarioInfo) -> Vec<(FrameRecord, DriveKind)> {
    let mut by_drive: BTreeMap<i32, (FrameRecord, DriveKind)> = BTreeMap::new();
    for frame in outcome.records.frames.values() {
        let (Ok(branch), Ok(timestamp)) = (usize::try_from(frame.branch), usize::try_from(frame.timestamp)) else {
            continue;
        };
        if frame.drive < 0 || frame.action.is_none() {
            continue;
        }
        let Some(kind) = scenario.trial_kind(branch, timestamp, frame.observability) else { continue };
        match by_drive.get(&frame.drive) {
            Some((there, _)) if there.timestamp < frame.timestamp => {}
            _ => {
                by_drive.insert(frame.drive, (frame.clone(), kind));
            }
        }
    }
    by_drive.into_values().collect()
}

/// The tables as text.
pub fn text(report: &Value) -> String {
    let planning = &report["planning"];
    let mut out = String::new();
    if planning.is_null() {
        return out;
    }
    let _ = writeln!(out, "\nPlanning: right actions out of trials, with 95 % interval of the rate");
    for (name, title) in [
        ("drives", "drives of this run"),
        ("free_drives", "free drives of this run: moving, from poses that no training saw"),
        ("all_views", "every eligible view of the trained poses"),
        ("unseen_views", "every eligible view of poses never trained on"),
    ] {
        if planning[name].is_null() {
            continue;
        }
        let views = &planning["views"][name];
        let times = match (views["hazard"].as_u64(), views["clear"].as_u64(), views["repeats"].as_u64()) {
            (Some(hazard), Some(clear), Some(repeats)) => {
                format!(" ({hazard} hazard and {clear} clear pictures, each {repeats} times with fresh sensor noise)")
            }
            _ => String::new(),
        };
        let _ = writeln!(out, "\n  {title}{times}");
        let _ = writeln!(out, "  {:<15} {:>3}  {:<32} {:<32}", "rule", "n", "hazard: halts", "clear: advances");
        for rule in ["underconfident", "overconfident", "paper", "calibrated"] {
            for samples in SAMPLE_COUNTS {
                let counts = &planning[name][rule][samples.to_string()];
                let (hazard, clear) = (share(&counts["hazard"]), share(&counts["clear"]));
                let _ = writeln!(out, "  {rule:<15} {samples:>3}  {hazard:<32} {clear}");
            }
        }
    }
    let metrics = carff_training::pipeline::summary(&report["checkpoint_metrics"]);
    if !metrics.is_empty() {
        let _ = writeln!(out, "\nModels, as measured when they were trained\n  {}", metrics.replace('\n', "\n  "));
    }
    out
}

/// One count of a table as text; a dash where nothing was tried.
fn share(count: &Value) -> String {
    match (count["success"].as_u64(), count["trials"].as_u64()) {
        (Some(success), Some(trials)) if trials > 0 => format!(
            "{success}/{trials} = {:.1} % [{:.1}, {:.1}]",
            100.0 * success as f64 / trials as f64,
            100.0 * count["interval"][0].as_f64().unwrap_or(0.0),
            100.0 * count["interval"][1].as_f64().unwrap_or(1.0)
        ),
        _ => "-".to_owned(),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use carff_messages::Observability;

    /// A decided frame of the first timestamp of a drive, that shows nothing of the place that matters.
    pub(crate) fn frame() -> FrameRecord {
        FrameRecord {
            frame_id: 0,
            view: 0,
            branch: 0,
            timestamp: 0,
            drive: 0,
            frame_in_drive: 0,
            last_of_timestamp: false,
            observability: Some(Observability::None),
            capture_time_ns: 0,
            posterior: None,
            action: Some(ActionCode::Halt),
            reason: None,
            hazard_probability: 0.5,
            confidence: 0.5,
            latency_ns: 1,
        }
    }

    fn outcome(frames: impl IntoIterator<Item = FrameRecord>) -> RunOutcome {
        let frames = frames.into_iter().enumerate().map(|(i, f)| (i as u64, FrameRecord { frame_id: i as u64, ..f }));
        let mut outcome = RunOutcome::default();
        outcome.records.frames = frames.collect();
        outcome
    }

    /// A run without drives, or of which no posterior was recorded, has no tables, and no model is looked for.
    #[test]
    fn nothing_is_computed_without_drives() {
        let known = Some(carff_messages::Gaussian::standard());
        let no_drive = FrameRecord { drive: -1, posterior: known, ..frame() };
        for outcome in [outcome([]), outcome([no_drive]), outcome([frame()])] {
            assert!(evaluate(&outcome).unwrap().is_none());
        }
        let driven = outcome([FrameRecord { posterior: known, ..frame() }]);
        assert!(evaluate(&driven).is_err(), "without its graph file a run cannot be judged");
    }

    /// Of each drive the last decided frame of the first timestamp with one right answer counts: hidden in a hazard
    /// branch, fully visible in another, never the last timestamp, never an undecided frame.
    #[test]
    fn decisive_frames_are_those_with_one_right_answer() {
        let at = |drive, timestamp, branch, observability| FrameRecord {
            branch,
            timestamp,
            drive,
            observability: Some(observability),
            ..frame()
        };
        let undecided = FrameRecord { action: None, ..at(0, 0, 0, Observability::None) };
        let outcome = outcome([
            at(0, 0, 0, Observability::None),
            at(0, 0, 0, Observability::None),
            undecided,
            at(0, 1, 0, Observability::None),
            at(1, 0, 1, Observability::None),
            at(1, 1, 1, Observability::Full),
            at(1, 2, 1, Observability::Full),
            at(2, 0, 0, Observability::Full),
            at(3, 2, 0, Observability::None),
            at(-1, 0, 0, Observability::None),
        ]);
        let scenario = ScenarioInfo {
            name: "test".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["hazard".into(), "clear".into()],
            timestamps: 3,
            bev_view: None,
            states: Vec::new(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        let found: Vec<_> = decisive_frames(&outcome, &scenario).iter().map(|(f, kind)| (f.frame_id, *kind)).collect();
        assert_eq!(found, [(1, DriveKind::Hazard), (5, DriveKind::Clear)]);
    }

    /// The text holds each count with its interval, a dash where nothing was tried, and nothing for a run without
    /// planning.
    #[test]
    fn tables_become_text() {
        assert_eq!(text(&json!({ "frames": 3 })), "");
        let count = json!({ "success": 29, "trials": 30, "interval": [0.833, 0.994] });
        let report = json!({ "planning": { "drives": { "paper": { "10": { "hazard": count } } } } });
        let text = text(&report);
        let line = text.lines().find(|l| l.contains("29/30")).unwrap();
        assert_eq!(line.split_whitespace().collect::<Vec<_>>()[..2], ["paper", "10"]);
        assert!(line.contains("29/30 = 96.7 % [83.3, 99.4]") && line.trim_end().ends_with('-'), "{line}");
    }
}
