//! A finished run, and the inputs by which `carff_trials::run` judges its drives.

use crate::supervision::monitor::{FrameHistory, Records};
use carff::provenance::Origin;
use carff_checkpoint::{CheckpointPlanning, load_policy};
use carff_config::{CameraSource, CompareImages, GraphConfig};
use carff_dataset::{ScenarioInfo, drives::DriveKind};
use carff_decision::{ImageEvidence, TakeFrame};
use carff_messages::{ActionCode, Reason, Rule, Stage};
use carff_scenes::Scenario;
use carff_trials::run::{DecidedFrame, JudgedRun, RunPlanning, RunSettings, TakenImage, decisive_frames};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A finished run.
#[derive(Clone, Debug)]
pub struct RunOutcome {
    /// Run name.
    pub run: String,
    /// Program, host, start and checkpoint of the run.
    pub origin: Origin,
    /// Path of the graph file.
    pub graph_file: String,
    /// Effective configuration.
    pub graph: GraphConfig,
    /// Scenario of the dataset, where it has one.
    pub scenario: Option<ScenarioInfo>,
    /// True if a signal ended the run.
    pub interrupted: bool,
    /// Folder of the dataset.
    pub dataset: PathBuf,
    /// Folder of the trained models.
    pub checkpoint: PathBuf,
    /// Records of the run.
    pub records: Records,
    /// Restarts by stage.
    pub restarts: BTreeMap<Stage, u32>,
    /// Number of invalid messages that the launcher received.
    pub invalid: u64,
}

/// A run with drives, and its models.
pub struct Planning {
    run: JudgedRun,
    decisive: Vec<(DecidedFrame, DriveKind)>,
}

impl Planning {
    /// Loads the models of a run; `None` for a run without drives through a scenario.
    pub fn load(outcome: &RunOutcome) -> anyhow::Result<Option<Self>> {
        let decisive = decisive(outcome);
        if decisive.iter().all(|(frame, _)| frame.posterior.is_none()) {
            return Ok(None);
        }
        let images: Vec<_> = outcome.records.frames.values().filter_map(taken).collect();
        Ok(Some(Self { run: JudgedRun::load(settings(outcome)?, &images)?, decisive }))
    }

    /// Computes every rule over the run's drives and over every eligible view.
    pub fn tables(&self, progress: impl Fn(String)) -> anyhow::Result<RunPlanning> {
        Ok(self.run.planning(&self.decisive, progress)?)
    }

    /// Draws some of the run's drives into a PNG file.
    pub fn write_filmstrip(&self, path: &Path) -> anyhow::Result<()> {
        Ok(self.run.write_filmstrip(path, &self.decisive)?)
    }
}

/// Selects the frame of each drive whose decision counts; none for a run without a scenario.
pub fn decisive(outcome: &RunOutcome) -> Vec<(DecidedFrame, DriveKind)> {
    let is_late = outcome.graph.checks.compare == CompareImages::NextFrame;
    let frames = &outcome.records.frames;
    let frames = frames.values().filter_map(|frame| {
        let states = outcome.scenario.as_ref().map_or(0, ScenarioInfo::state_count);
        let image = if is_late { image_before(frames, frame, states) } else { frame.image.clone() };
        Some(DecidedFrame { image, ..decided(frame)? })
    });
    outcome.scenario.as_ref().map_or_else(Vec::new, |scenario| decisive_frames(frames, scenario))
}

/// Evidence of the last compared image of a take before a frame; for the take's first frame, and after a pause, that
/// nothing explains it. Images are compared after their decisions.
fn image_before(frames: &BTreeMap<u64, FrameHistory>, frame: &FrameHistory, states: usize) -> Option<ImageEvidence> {
    let mut before = frames.range(frame.take_start..frame.frame_id.max(frame.take_start)).rev();
    let compared = before.find(|(_, frame)| frame.action.is_some());
    let compared = compared.filter(|(before, _)| ImageEvidence::counts_later(**before, frame.frame_id));
    compared.map_or_else(|| Some(ImageEvidence::unexplained(states)), |(_, before)| before.image.clone())
}

/// The image of a frame, with its place in its take.
fn taken(frame: &FrameHistory) -> Option<TakenImage> {
    let FrameHistory { take_start, frame_id, capture_time_ns, .. } = *frame;
    let place = TakeFrame { take_start, frame: frame_id, capture_time_ns };
    Some(TakenImage { frame: place, posterior: frame.posterior?, image: frame.image.clone() })
}

/// Settings of a run, from its graph file and checkpoint.
fn settings(outcome: &RunOutcome) -> anyhow::Result<RunSettings> {
    let graph = &outcome.graph;
    let known = CheckpointPlanning::load(&outcome.checkpoint)?;
    let free = match (graph.camera.source, graph.scenario_path()) {
        (CameraSource::FreeDrives, Some(path)) => Some(Scenario::load(&path)?),
        _ => None,
    };
    let given = graph.controller.threshold;
    let policy = load_policy(Rule::Calibrated, given, &outcome.checkpoint, graph.remembers())?;
    Ok(RunSettings {
        run: outcome.run.clone(),
        dataset: outcome.dataset.clone(),
        checkpoint: outcome.checkpoint.clone(),
        free,
        frames_per_timestamp: graph.camera.frames_per_timestamp as usize,
        rule: graph.controller.rule,
        threshold: policy.threshold,
        samples: graph.run.samples as usize,
        sampling: graph.run.sampling,
        feedback: graph.run.feedback,
        horizon: graph.run.horizon,
        compares: graph.checks.compare != CompareImages::Off,
        compares_late: graph.checks.compare == CompareImages::NextFrame,
        ignores_unknown: graph.checks.ignores_unknown(),
        remembers: graph.step_length(None).filter(|_| graph.remembers()),
        noise: graph.camera.noise,
        split_seed: graph.camera.split_seed.unwrap_or(known.split_seed),
        seed: graph.run.seed,
    })
}

/// A frame of a drive on which the controller decided; `None` for any other frame.
pub(crate) fn decided(frame: &FrameHistory) -> Option<DecidedFrame> {
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
        image: frame.image.clone(),
        evidence: frame.evidence(),
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
    fn frame() -> FrameHistory {
        FrameHistory {
            frame_id: 0,
            view: 0,
            branch: 0,
            timestamp: 0,
            drive: 0,
            frame_in_drive: 0,
            last_of_timestamp: false,
            observability: Some(Observability::None),
            capture_time_ns: 0,
            take_start: 0,
            posterior: None,
            image: None,
            evidence: carff_decision::Evidence::NONE,
            steps: [0; 2],
            action: Some(ActionCode::Halt),
            reason: None,
            unknown_probability: 0.0,
            hazard_probability: 0.5,
            confidence: 0.5,
            latency_ns: 1,
        }
    }

    /// Frames outside a drive, without a state, or without a decision do not count; a free drive has no view; every
    /// action except an advance is a halt.
    #[test]
    fn decided_frames_are_those_of_drives() {
        let found = decided(&FrameHistory { view: -1, ..frame() }).unwrap();
        assert_eq!((found.view, found.halted, found.other_reason), (None, true, None));
        assert!(!decided(&FrameHistory { action: Some(ActionCode::Advance), ..frame() }).unwrap().halted);
        let others = [
            FrameHistory { drive: -1, ..frame() },
            FrameHistory { branch: -1, ..frame() },
            FrameHistory { timestamp: -1, ..frame() },
            FrameHistory { action: None, ..frame() },
        ];
        assert!(others.iter().all(|other| decided(other).is_none()));
    }

    /// The image before is that of the last decided frame of the take; nothing explains a take's first frame, or one
    /// after a pause.
    #[test]
    fn images_of_the_frame_before_count() {
        let image = |ratio: f32| Some(ImageEvidence::new(&[ratio]));
        let with = |frame_id, take_start, action, ratio| {
            (frame_id, FrameHistory { frame_id, take_start, action, image: image(ratio), ..frame() })
        };
        let halt = Some(ActionCode::Halt);
        let frames = [
            with(3, 3, halt, 3.0),
            with(4, 3, None, 4.0),
            with(5, 3, halt, 5.0),
            with(6, 6, halt, 6.0),
            with(12, 6, halt, 9.0),
        ];
        let frames = BTreeMap::from(frames);
        for (frame, before) in [(3, 0.0), (5, 3.0), (6, 0.0), (12, 0.0)] {
            assert_eq!(image_before(&frames, &frames[&frame], 1), image(before), "{frame}");
        }
    }
}
