//! The planning tables of a run's report: from the run's records to `carff_evaluation::run`.

use crate::report::RunOutcome;
use crate::supervision::monitor::FrameRecord;
use carff_checkpoint::CheckpointPlanning;
use carff_config::{CameraSource, GraphConfig};
use carff_dataset::drives::DriveKind;
use carff_evaluation::run::{DecidedFrame, JudgedRun, RunPlanning, RunSettings, decisive_frames};
use carff_messages::{ActionCode, Reason};
use carff_scenes::Scenario;
use serde_json::{Map, Value};
use std::path::Path;

/// Planning tables of a run.
pub struct Planning {
    run: JudgedRun,
    decisive: Vec<(DecidedFrame, DriveKind)>,
    tables: RunPlanning,
    text: String,
}

impl Planning {
    /// Returns `planning` and `checkpoint_metrics` of the report.
    pub fn tables(&self) -> anyhow::Result<Map<String, Value>> {
        let mut tables = Map::new();
        tables.insert("planning".into(), serde_json::to_value(&self.tables)?);
        tables.insert("checkpoint_metrics".into(), serde_json::to_value(self.run.checkpoint_figures()?)?);
        Ok(tables)
    }

    /// Returns the tables and the figures of the checkpoint as text.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Draws some of the run's drives into a PNG file.
    pub fn write_filmstrip(&self, path: &Path) -> anyhow::Result<()> {
        Ok(self.run.write_filmstrip(path, &self.decisive)?)
    }
}

/// Computes the tables; `None` for a run without drives through a scenario.
pub fn evaluate(outcome: &RunOutcome) -> anyhow::Result<Option<Planning>> {
    if outcome.records.frames.values().all(|f| f.drive < 0 || f.posterior.is_none()) {
        return Ok(None);
    }
    carff_networks::allocator::keep_large_blocks();
    let run = JudgedRun::load(settings(outcome)?)?;
    let decisive = decisive_frames(outcome.records.frames.values().filter_map(decided), run.scenario());
    let tables = run.planning(&decisive)?;
    let figures = run.checkpoint_figures()?.summary().replace('\n', "\n  ");
    let text = format!("{}\nModels, as measured in training\n  {figures}\n", tables.text());
    Ok(Some(Planning { run, decisive, tables, text }))
}

/// Settings of a run, from its graph file and checkpoint.
fn settings(outcome: &RunOutcome) -> anyhow::Result<RunSettings> {
    let graph = GraphConfig::load(Path::new(&outcome.graph))?;
    let known = CheckpointPlanning::load(&outcome.checkpoint)?;
    let free = match (graph.camera.source, graph.scenario_path()) {
        (CameraSource::FreeDrives, Some(path)) => Some(Scenario::load(&path)?),
        _ => None,
    };
    let threshold = graph.controller.threshold.unwrap_or(known.hazard_threshold);
    Ok(RunSettings {
        run: outcome.run.clone(),
        dataset: outcome.dataset.clone(),
        checkpoint: outcome.checkpoint.clone(),
        free,
        frames_per_timestamp: graph.camera.frames_per_timestamp as usize,
        rule: graph.controller.rule,
        threshold,
        samples: graph.run.samples as usize,
        sampling: graph.run.sampling,
        horizon: graph.run.horizon,
        noise: graph.camera.noise,
        split_seed: graph.camera.split_seed.unwrap_or(known.split_seed),
        seed: outcome.seed,
    })
}

/// A frame of a drive on which the controller decided; `None` for any other frame.
fn decided(frame: &FrameRecord) -> Option<DecidedFrame> {
    let action = frame.action?;
    Some(DecidedFrame {
        frame: frame.frame_id,
        drive: u64::try_from(frame.drive).ok()?,
        frame_in_drive: usize::try_from(frame.frame_in_drive).unwrap_or(0),
        branch: usize::try_from(frame.branch).ok()?,
        timestamp: usize::try_from(frame.timestamp).ok()?,
        view: usize::try_from(frame.view).ok(),
        observability: frame.observability,
        posterior: frame.posterior,
        halted: action != ActionCode::Advance,
        hazard_probability: frame.hazard_probability,
        other_reason: frame.reason.filter(|r| *r != Reason::Belief).map(|r| r.name().to_owned()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Observability;

    /// A decided frame of the first timestamp of a drive that hides the actor's place.
    fn frame() -> FrameRecord {
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

    /// A run without drives, or without a recorded posterior, has no tables and loads no model.
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

    /// Frames outside a drive, without a state, or without a decision do not count; a free drive has no view; every
    /// action except an advance is a halt.
    #[test]
    fn decided_frames_are_those_of_drives() {
        let found = decided(&FrameRecord { view: -1, ..frame() }).unwrap();
        assert_eq!((found.view, found.halted, found.other_reason), (None, true, None));
        assert!(!decided(&FrameRecord { action: Some(ActionCode::Advance), ..frame() }).unwrap().halted);
        let others = [
            FrameRecord { drive: -1, ..frame() },
            FrameRecord { branch: -1, ..frame() },
            FrameRecord { timestamp: -1, ..frame() },
            FrameRecord { action: None, ..frame() },
        ];
        assert!(others.iter().all(|other| decided(other).is_none()));
    }
}
