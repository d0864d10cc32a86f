//! The calibrated rule's threshold as a bound: at most a chosen share of advances where the hazard is there.
//!
//! The trials are free drives of the scenario, from a seed of their own, decided as the graph decides: with the
//! comparison of each image.

use crate::TrainingError;
use carff_base::random::tag;
use carff_checkpoint::{Bound, CalibratedWith, CheckpointPlanning, PlanningMemory};
use carff_dataset::{drives::DriveKind, sensor::SensorNoise};
use carff_decision::{
    CalibrationTrial, Evidence, ImageEvidence, MemorySettings, Sampling, bounded_threshold, choose_threshold,
};
use carff_evaluation::{KnownStates, Models, Perception, Planner, Progress, SAMPLES, TakeMemories, Trial};
use carff_scenes::{FRAMES_PER_TIMESTAMP, Scenario};
use carff_unknown::Known;
use rayon::prelude::*;
use std::path::Path;

/// Part of the seed of these drives, so that they share no draws with training, limits or evaluation.
const BOUND: u64 = tag("bounded");
/// Largest number of frames of a drive; it names random draws.
const MOST_FRAMES: usize = 1000;

/// Input of the bound.
#[derive(Clone, Copy)]
pub struct BoundInput<'a> {
    /// Folder of the checkpoint; `planning.json` is written into it.
    pub checkpoint: &'a Path,
    /// The scenario that the checkpoint was trained on.
    pub scenario: &'a Scenario,
    /// Free drives; half of them have the hazard.
    pub drives: usize,
    /// Largest share of advances where the hazard is there, 0 to 1.
    pub level: f64,
    /// Probability with which the bound holds, 0 to 1.
    pub confidence: f64,
    /// True for the threshold with the memory: a drive with a hazard counts by its most doubtful frame before the last
    /// time step.
    pub remembers: bool,
    /// Threads that render.
    pub threads: usize,
}

/// The threshold, its bound, and the probabilities of hazard or unknown that it rests on.
#[derive(Clone, Debug)]
pub struct ChosenBound {
    /// The contents of `planning.json`.
    pub planning: CheckpointPlanning,
    /// Probabilities of the drives with a hazard, of each its lowest one, ascending.
    pub hazard: Vec<f64>,
    /// Probabilities of the drives without one, ascending.
    pub clear: Vec<f64>,
}

/// Chooses the threshold that separates drives with and without the hazard, and writes it into the checkpoint. It is at
/// most the largest one that keeps the bound, and at most the hazard probability that one hidden state leaves: a vehicle
/// that gains speed in view of a hidden lane cannot stop any more when somebody appears there.
///
/// # Errors
///
/// There are too few drives for the bound, or the scenario has no hazard.
pub fn bound_threshold(input: BoundInput, on_progress: &dyn Fn(&Progress)) -> Result<ChosenBound, TrainingError> {
    let BoundInput { level, confidence, .. } = input;
    // Every second drive has the hazard. Too few are refused before any is rendered.
    let expected = input.drives.div_ceil(2);
    bounded_threshold(&vec![1.0; expected], level, confidence).ok_or_else(|| too_few(&input, expected))?;
    let models = Models::load(input.checkpoint)?;
    let known = Known::load(input.checkpoint)?;
    let seed = models.manifest.seed ^ BOUND;
    let old = CheckpointPlanning::load(input.checkpoint)?;
    let settings = match old.memory.filter(|_| input.remembers) {
        None if input.remembers => {
            let missing = "no memory was learned: run `carff checkpoint memory` first";
            return Err(TrainingError::Insufficient(missing.into()));
        }
        memory => memory.map(|memory| memory.settings),
    };
    let drives = drives(input, &models, known.as_ref(), settings, seed, on_progress)?;
    let CalibratedWith { feedback, horizon, .. } = models.manifest.trained_with(input.checkpoint)?.calibration;
    let sampling = Sampling::Stratified;
    let planner = Planner { net: &models.mixture, probe: &models.probe, sampling, feedback, horizon };
    let (mut hazard, mut clear) = (Vec::new(), Vec::new());
    for (kind, trials) in drives {
        let evidence = planner.evidence(&trials, SAMPLES);
        let lowest = evidence.iter().map(Evidence::hazard_or_unknown_probability).fold(1.0, f64::min);
        if kind == DriveKind::Hazard { hazard.push(lowest) } else { clear.push(lowest) }
    }
    hazard.sort_by(f64::total_cmp);
    clear.sort_by(f64::total_cmp);
    let largest = bounded_threshold(&hazard, level, confidence).ok_or_else(|| too_few(&input, hazard.len()))?;
    let trial = |halt_is_right: bool| move |&p: &f64| CalibrationTrial { hazard_probability: p, halt_is_right };
    let drives: Vec<_> = hazard.iter().map(trial(true)).chain(clear.iter().map(trial(false))).collect();
    let unseen = known.as_ref().map_or(1.0, |known| ImageEvidence::hidden_hazard(&known.hazard_states, 1));
    let largest = largest.min(unseen);
    let hazard_threshold = choose_threshold(&drives).map_or(largest, |t| t.min(largest));
    let advances = hazard.iter().filter(|p| **p < hazard_threshold).count();
    let bound = Some(Bound { level, confidence, drives: hazard.len(), advances });
    let planning = match settings {
        Some(settings) => {
            let hazard_threshold = Some(hazard_threshold);
            CheckpointPlanning { memory: Some(PlanningMemory { settings, hazard_threshold, bound }), ..old }
        }
        None => CheckpointPlanning { hazard_threshold, bound, ..old },
    };
    planning.save(input.checkpoint)?;
    Ok(ChosenBound { planning, hazard, clear })
}

fn too_few(input: &BoundInput, hazards: usize) -> TrainingError {
    let least = ((1.0 - input.confidence).ln() / (1.0 - input.level).ln()).ceil();
    TrainingError::Insufficient(format!(
        "{hazards} drives with a hazard are too few for this bound: it needs {least}, give more drives"
    ))
}

/// The trials of each drive: its decisive image, or with a memory all images before the last time step of a drive with a
/// hazard.
fn drives(
    input: BoundInput,
    models: &Models,
    known: Option<&Known>,
    memory: Option<MemorySettings>,
    seed: u64,
    on_progress: &dyn Fn(&Progress),
) -> Result<Vec<(DriveKind, Vec<Trial>)>, TrainingError> {
    let (probe, net) = (&models.probe, &models.mixture);
    let perception = Perception {
        encoder: &models.encoder,
        noise: SensorNoise::default(),
        seed,
        known: known.map(|known| match memory {
            Some(_) => KnownStates::with_places(known, probe, input.threads),
            None => KnownStates::new(known, probe, input.threads),
        }),
    };
    let memories = memory.map(|settings| TakeMemories::new(net, probe, settings, FRAMES_PER_TIMESTAMP as u64));
    let mut all = Vec::with_capacity(input.drives);
    for number in 0..input.drives {
        let drive = input.scenario.free_drive(number as u64, FRAMES_PER_TIMESTAMP, seed)?;
        let decisive = drive.decisive_frame();
        let (first, last) = match (&memories, drive.kind()) {
            (None, _) => (decisive, decisive),
            (Some(_), DriveKind::Clear) => (0, decisive),
            (Some(_), DriveKind::Hazard) => (0, drive.frame_count() - FRAMES_PER_TIMESTAMP - 1),
        };
        let render = |frame: usize| input.scenario.free_image(&drive, frame);
        let images: Vec<_> = (first..=last).into_par_iter().map(render).collect();
        let mut memories = memories.clone();
        let mut trials = Vec::with_capacity(images.len());
        for (frame, (camera, image)) in (first..=last).zip(&images) {
            let name = if memories.is_some() { number * MOST_FRAMES + frame } else { number } as u64;
            let Some(trial) = perception.trial((camera, image), drive.kind(), name) else { continue };
            trials.push(match &mut memories {
                Some(memories) => memories.remember(net, trial, frame as u64),
                None => trial,
            });
        }
        if drive.kind() == DriveKind::Clear {
            trials.drain(..trials.len().saturating_sub(1));
        }
        all.push((drive.kind(), trials));
        on_progress(&Progress { phase: "drives", done: number + 1, total: input.drives, line: String::new() });
    }
    Ok(all)
}
