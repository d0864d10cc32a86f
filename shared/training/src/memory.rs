//! The numbers of the memory, learned on drives.

use crate::TrainingError;
use carff_base::random::tag;
use carff_checkpoint::{CheckpointPlanning, PlanningMemory};
use carff_dataset::sensor::SensorNoise;
use carff_decision::{Memory, MemorySettings};
use carff_evaluation::{KnownStates, Models, Perception, Progress, Watch, WatchPlan, watches};
use carff_scenes::Scenario;
use carff_unknown::Known;
use rayon::prelude::*;
use std::path::Path;

/// Part of the seed of these drives, so that they share no draws with training, limits or evaluation.
const MEMORY: u64 = tag("remember");
/// Candidates of the numbers.
const REPEATED_SHARES: [f64; 6] = [0.0, 0.1, 0.2, 0.3, 0.5, 0.7];
const DISTRUSTS: [f64; 7] = [0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7];
const PLACE_STRENGTHS: [f64; 8] = [0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0];
/// Probabilities are clamped to this and its complement in the log loss.
const SUREST: f64 = 1e-3;

/// Input of the learning.
#[derive(Clone, Copy)]
pub struct MemoryInput<'a> {
    /// Folder of the checkpoint; `planning.json` is written into it.
    pub checkpoint: &'a Path,
    /// The scenario that the checkpoint was trained on.
    pub scenario: &'a Scenario,
    /// Drives.
    pub drives: usize,
    /// Threads that render.
    pub threads: usize,
}

/// The learned numbers, with the mean log loss of the hazard probability a frame.
#[derive(Clone, Copy, Debug)]
pub struct LearnedMemory {
    /// The numbers.
    pub settings: MemorySettings,
    /// Log loss with memory.
    pub log_loss: f64,
    /// Log loss of each image by itself.
    pub without_memory: f64,
}

/// Chooses the numbers with the smallest log loss of the hazard probability over all frames of drives whose camera
/// pans, and writes them into the checkpoint.
///
/// # Errors
///
/// The checkpoint has no forecaster or field, or the scenario has no such drive.
pub fn learn_memory(input: MemoryInput, on_progress: &dyn Fn(&Progress)) -> Result<LearnedMemory, TrainingError> {
    let models = Models::load(input.checkpoint)?;
    let seed = models.manifest.seed ^ MEMORY;
    let noise = SensorNoise::default();
    let known = Known::load(input.checkpoint)?;
    let known = known.as_ref().map(|known| KnownStates::with_places(known, &models.probe, input.threads));
    let perception = Perception { encoder: &models.encoder, noise, seed, known };
    let plan = WatchPlan { count: input.drives, seed, exact: false };
    let drives = watches(input.scenario, &perception, &models.mixture, plan, on_progress);
    let drives = drives?;
    let (states, net) = (models.probe.states(), &models.mixture);
    let memory = |settings| Memory::new(models.probe.layout(), states.to_vec(), |state| net.forecast(state), settings);
    let hazards = models.probe.layout().hazard_states();
    let of = |settings| mean_log_loss(&memory(settings), hazards, &drives);
    // Without limits of the known, no image is compared, and no strength changes anything.
    let strengths = if perception.known.is_some() { &PLACE_STRENGTHS[..] } else { &PLACE_STRENGTHS[..1] };
    let candidates = strengths.iter().flat_map(|&place_strength| {
        let of_share =
            move |repeated_share| DISTRUSTS.map(|distrust| MemorySettings { repeated_share, distrust, place_strength });
        REPEATED_SHARES.into_iter().flat_map(of_share)
    });
    let scored: Vec<(MemorySettings, f64)> = candidates.map(|settings| (settings, of(settings))).collect();
    let best = scored.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
    let (settings, log_loss) = best.ok_or_else(|| {
        TrainingError::Insufficient("there are no drives to learn from: give more with --drives".into())
    })?;
    let old = CheckpointPlanning::load(input.checkpoint)?;
    let planning =
        CheckpointPlanning { memory: Some(PlanningMemory { settings, hazard_threshold: None, bound: None }), ..old };
    planning.save(input.checkpoint)?;
    let alone = memory(MemorySettings { place_strength: 0.0, ..settings });
    let without_memory = drives.par_iter().map(|drive| log_loss_of(&alone, hazards, drive, true)).sum::<f64>();
    let frames: usize = drives.iter().map(|drive| drive.frames.len()).sum();
    Ok(LearnedMemory { settings, log_loss, without_memory: without_memory / frames.max(1) as f64 })
}

/// Mean log loss a frame.
fn mean_log_loss(memory: &Memory, hazards: &[bool], drives: &[Watch]) -> f64 {
    let sum: f64 = drives.par_iter().map(|drive| log_loss_of(memory, hazards, drive, false)).sum();
    sum / drives.iter().map(|drive| drive.frames.len()).sum::<usize>().max(1) as f64
}

/// Sum of the log losses of a drive's frames. `forgets` clears the memory before each image.
fn log_loss_of(memory: &Memory, hazards: &[bool], drive: &Watch, forgets: bool) -> f64 {
    let mut memory = memory.clone();
    memory.clear();
    let mut step = drive.frames.first().map_or(0, |frame| frame.timestamp);
    let mut sum = 0.0;
    for frame in &drive.frames {
        (step..frame.timestamp).for_each(|_| memory.advance());
        step = frame.timestamp;
        if forgets {
            memory.clear();
        }
        memory.see(&frame.forecast);
        if let Some(image) = &frame.image {
            memory.compare(image.places());
        }
        let hazard: f64 = memory.next().iter().zip(hazards).filter(|(_, h)| **h).map(|(w, _)| w).sum();
        let p = hazard.clamp(SUREST, 1.0 - SUREST);
        sum -= (if drive.hazard { p } else { 1.0 - p }).ln();
    }
    sum
}
