//! The planning tables of a run's report: each rule over its drives, and over every eligible view.

use crate::monitor::FrameRecord;
use crate::report::RunOutcome;
use anyhow::Context;
use carff_belief::{Plan, decision, look_ahead};
use carff_config::{CheckpointPlanning, GraphConfig};
use carff_dataset::{
    Dataset, PoseRole, PoseSplit,
    drives::{DriveKind, EligibleInput, eligible_inputs},
    sensor::SensorNoise,
};
use carff_evaluation::{Models, PlanningTable, SAMPLE_COUNTS, count, planning_table, trials};
use carff_messages::{ActionCode, Observability};
use carff_models::{LatentGaussian, mixture::Sampling};
use carff_planning::Rule;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

/// Least trials of each kind over the trained poses.
const TRIALS: usize = 300;
/// Most times that one picture is taken.
const MOST_REPEATS: usize = 20;

/// What planning made of a run.
pub struct Planning {
    tables: Map<String, Value>,
}

impl Planning {
    /// What the report holds of it.
    pub fn tables(&self) -> Map<String, Value> {
        self.tables.clone()
    }

    /// Pictures and hypotheses of some drives.
    pub fn write_filmstrip(&self, _path: &Path) -> anyhow::Result<()> {
        Ok(())
    }
}

/// Computes the tables; none for a run without drives through a scenario.
pub fn evaluate(outcome: &RunOutcome) -> anyhow::Result<Option<Planning>> {
    let mut tables = Map::new();
    if outcome.records.frames.values().all(|f| f.drive < 0 || f.posterior.is_none()) {
        return Ok(None);
    }
    carff_models::allocator::keep_large_blocks();
    let graph = GraphConfig::load(Path::new(&outcome.graph))?;
    let dataset = Dataset::open(&outcome.dataset)?;
    let timestamps = dataset.scenario().context("the data set has no scenario")?.timestamps;
    let hazard_branches = dataset.scenario().map(|s| s.hazard_branches.clone()).unwrap_or_default();
    let mut models = Models::load(&outcome.checkpoint)?;
    let known = CheckpointPlanning::load(&outcome.checkpoint)?;
    let threshold = graph.controller.threshold.unwrap_or(known.hazard_threshold);
    let rules = [Rule::Underconfident, Rule::Overconfident, Rule::Paper, Rule::Calibrated { threshold }];
    let sampling = match graph.run.sampling {
        carff_config::Sampling::Stratified => Sampling::Stratified,
        carff_config::Sampling::Independent => Sampling::Independent,
    };

    let decisive = decisive_frames(outcome, timestamps, &hazard_branches);
    let mut drives = PlanningTable::new();
    let (mut agreeing, mut compared) = (0, 0);
    let live_rule = format!("{:?}", graph.controller.rule).to_lowercase();
    for (frame, kind) in &decisive {
        let Some(posterior) = frame.posterior else { continue };
        let posterior = LatentGaussian { mean: posterior.mean, log_variance: posterior.log_variance };
        for samples in SAMPLE_COUNTS {
            let plan =
                Plan { samples, sampling, horizon: graph.run.horizon, seed: outcome.seed, frame: frame.frame_id };
            let steps = look_ahead(&models.mixture, &mut models.probe, &posterior, plan);
            for rule in rules {
                let mut halted = decision(rule, &steps).halt;
                if rule.name() == live_rule && samples == graph.run.samples as usize {
                    // What the graph did counts, not what it should have done.
                    let live = frame.action != Some(ActionCode::Advance);
                    compared += 1;
                    agreeing += usize::from(live == halted);
                    halted = live;
                }
                count(&mut drives, rule.name(), samples, *kind, halted == (*kind == DriveKind::Hazard));
            }
        }
    }

    let split = PoseSplit::for_dataset(&dataset, graph.camera.split_seed.unwrap_or(known.split_seed));
    let noise = SensorNoise {
        sigma: graph.camera.noise.sigma,
        gain_sigma: graph.camera.noise.gain_sigma,
        channel_gain_sigma: graph.camera.noise.channel_gain_sigma,
        channel_offset_sigma: graph.camera.noise.channel_offset_sigma,
    };
    let mut planning = json!({
        "drives": drives,
        "threshold": threshold,
        "live": { "rule": live_rule, "samples": graph.run.samples, "compared": compared, "agrees_with_library": agreeing },
    });
    for (name, role) in [("all_views", PoseRole::Rest), ("unseen_views", PoseRole::Unseen)] {
        let inputs = eligible_inputs(&dataset, &split.views(role))?;
        let of = |kind| inputs.iter().filter(|i: &&EligibleInput| i.kind == kind).count();
        let (hazards, clears) = (of(DriveKind::Hazard), of(DriveKind::Clear));
        let repeats = TRIALS.div_ceil(hazards.min(clears).max(1)).min(MOST_REPEATS);
        let trials = trials(&models.encoder, &dataset, &inputs, repeats, &noise, outcome.seed)?;
        let (table, _) = planning_table(&models.mixture, &models.probe, &trials, &rules, sampling, graph.run.horizon);
        planning[name] = serde_json::to_value(table)?;
        planning["views"][name] = json!({"hazard": hazards, "clear": clears, "repeats": repeats});
    }
    tables.insert("planning".into(), planning);
    tables.insert("checkpoint_metrics".into(), models.manifest.metrics.clone());
    Ok(Some(Planning { tables }))
}

/// Per drive the frame whose decision counts: the last decided one of the first timestamp at which the drive is a
/// trial (hazard: actor's branch, actor not visible; clear: other branch, place fully visible; not the last timestamp).
pub fn decisive_frames(
    outcome: &RunOutcome,
    timestamps: usize,
    hazard_branches: &[usize],
) -> Vec<(FrameRecord, DriveKind)> {
    let mut by_drive: BTreeMap<i32, (FrameRecord, DriveKind)> = BTreeMap::new();
    for frame in outcome.records.frames.values() {
        if frame.drive < 0 || frame.timestamp < 0 || frame.timestamp as usize + 2 > timestamps || frame.action.is_none()
        {
            continue;
        }
        let hazard = usize::try_from(frame.branch).is_ok_and(|b| hazard_branches.contains(&b));
        let kind = match (hazard, frame.observability) {
            (true, Observability::None) => DriveKind::Hazard,
            (false, Observability::Full) => DriveKind::Clear,
            _ => continue,
        };
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
        ("all_views", "every eligible view of the trained poses"),
        ("unseen_views", "every eligible view of poses never trained on"),
    ] {
        let _ = writeln!(out, "\n  {title}");
        let _ = writeln!(out, "  {:<15} {:>3}  {:<28} {:<28}", "rule", "n", "hazard: halts", "clear: advances");
        for rule in ["underconfident", "overconfident", "paper", "calibrated"] {
            for samples in SAMPLE_COUNTS {
                let cell = |kind: &str| {
                    let c = &planning[name][rule][samples.to_string()][kind];
                    match (c["success"].as_u64(), c["trials"].as_u64()) {
                        (Some(s), Some(t)) if t > 0 => format!(
                            "{s}/{t} = {:.1} % [{:.1}, {:.1}]",
                            100.0 * s as f64 / t as f64,
                            100.0 * c["interval"][0].as_f64().unwrap_or(0.0),
                            100.0 * c["interval"][1].as_f64().unwrap_or(1.0)
                        ),
                        _ => "-".to_owned(),
                    }
                };
                let _ = writeln!(out, "  {rule:<15} {samples:>3}  {:<28} {:<28}", cell("hazard"), cell("clear"));
            }
        }
    }
    let metrics = carff_training::pipeline::summary(&report["checkpoint_metrics"]);
    if !metrics.is_empty() {
        let _ = writeln!(out, "\nModels, as measured when they were trained\n  {}", metrics.replace('\n', "\n  "));
    }
    out
}
