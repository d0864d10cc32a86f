//! Watches: whole drives whose camera pans, with the exact posteriors of observers with and without a memory.

use crate::Progress;
use carff_dataset::{ScenarioInfo, drives::DriveKind};
use carff_decision::{ImageEvidence, Mixture};
use carff_networks::mixture::MixtureNet;
use carff_scenes::{FRAMES_PER_TIMESTAMP, Scenario, ScenarioError};
use carff_trials::Perception;
use rayon::prelude::*;

/// Largest number of frames of a watch; it names random draws.
const MOST_FRAMES: u64 = 1000;

/// One drive.
#[derive(Clone, Debug)]
pub struct Watch {
    /// Number of the drive.
    pub number: u64,
    /// True in a hazard branch.
    pub hazard: bool,
    /// Its frames, in order.
    pub frames: Vec<WatchedFrame>,
}

/// One frame of a watch.
#[derive(Clone, Debug)]
pub struct WatchedFrame {
    /// Time step.
    pub timestamp: usize,
    /// Frame number, which names random draws.
    pub frame: u64,
    /// Forecast of this frame's image.
    pub forecast: Mixture,
    /// Evidence of the image for the known states, where it was compared with them.
    pub image: Option<ImageEvidence>,
    /// Hazard probability of an observer that knows scenario and pose, from this image, with equally probable states.
    pub exact: f64,
    /// The same from all images of the drive so far.
    pub exact_with_memory: f64,
}

/// Count, seed and truth of the watches to make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WatchPlan {
    /// Number of drives, from number 0 on.
    pub count: usize,
    /// Seed of the drives.
    pub seed: u64,
    /// True if the exact probabilities are computed, which takes most of the time; else they are 0.
    pub exact: bool,
}

/// Renders and encodes watches.
pub fn watches(
    scenario: &Scenario,
    perception: &Perception,
    net: &MixtureNet,
    plan: WatchPlan,
    on_progress: &dyn Fn(&Progress),
) -> Result<Vec<Watch>, ScenarioError> {
    let WatchPlan { count, seed, exact } = plan;
    let info = scenario.info();
    let mut all = Vec::with_capacity(count);
    for number in 0..count as u64 {
        let drive = scenario.watch(number, FRAMES_PER_TIMESTAMP, seed)?;
        let alike = |frame| if exact { scenario.alike(&drive, frame) } else { Vec::new() };
        let render = |frame: usize| (scenario.free_image(&drive, frame), alike(frame));
        let taken: Vec<_> = (0..drive.frame_count()).into_par_iter().map(render).collect();
        let alike = taken.iter().enumerate().map(|(k, (_, alike))| (drive.timestamp_of(k), alike.as_slice()));
        let posteriors = exact_posteriors(info, &alike.collect::<Vec<_>>());
        let mut frames = Vec::with_capacity(taken.len());
        for (k, (((camera, image), _), (exact, exact_with_memory))) in taken.iter().zip(posteriors).enumerate() {
            let (frame, timestamp) = (number * MOST_FRAMES + k as u64, drive.timestamp_of(k));
            let Some(trial) = perception.trial((camera, image), DriveKind::Clear, frame) else { continue };
            let forecast = net.forecast(&trial.posterior);
            frames.push(WatchedFrame { timestamp, frame, forecast, image: trial.image, exact, exact_with_memory });
        }
        all.push(Watch { number, hazard: info.is_hazard(drive.branch()), frames });
        on_progress(&Progress { phase: "watches", done: all.len(), total: count, line: String::new() });
    }
    Ok(all)
}

/// Hazard probabilities without and with memory, from the time step of each frame and the states that look like it.
fn exact_posteriors(info: &ScenarioInfo, frames: &[(usize, &[usize])]) -> Vec<(f64, f64)> {
    let states = info.state_count();
    let hazard = |belief: &[f64]| -> f64 {
        let of = |(state, p): (usize, &f64)| if info.is_hazard(info.branch_of(state)) { *p } else { 0.0 };
        belief.iter().enumerate().map(of).sum()
    };
    let mut belief = vec![1.0 / states.max(1) as f64; states];
    let mut step = frames.first().map_or(0, |(timestamp, _)| *timestamp);
    let mut all = Vec::with_capacity(frames.len());
    for &(timestamp, alike) in frames {
        for _ in step..timestamp {
            let mut moved = vec![0.0; states];
            (0..states).for_each(|state| moved[info.next_state(state)] += belief[state]);
            belief = moved;
        }
        step = timestamp;
        let now: Vec<f64> =
            (0..states).map(|s| if alike.contains(&s) { 1.0 / alike.len() as f64 } else { 0.0 }).collect();
        let kept: f64 = alike.iter().map(|&state| belief[state]).sum();
        // An image that contradicts the drive so far starts anew.
        belief = if kept > 0.0 {
            (0..states).map(|s| if alike.contains(&s) { belief[s] / kept } else { 0.0 }).collect()
        } else {
            now.clone()
        };
        all.push((hazard(&now), hazard(&belief)));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_dataset::StateInfo;

    /// Two branches of three time steps: a hazard that was in sight stays certain when it is hidden, and a view by itself
    /// does not.
    #[test]
    fn exact_memory_keeps_what_was_seen() {
        let info = ScenarioInfo {
            name: "small".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["hazard".into(), "clear".into()],
            timestamps: 3,
            step_s: None,
            bev_view: None,
            states: (0..6).map(|s| StateInfo { branch: s / 3, timestamp: s % 3, boxes: Vec::new() }).collect(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        let frames: [(usize, &[usize]); 4] = [(0, &[0, 3]), (0, &[0]), (1, &[1, 4]), (2, &[2, 5])];
        let found = exact_posteriors(&info, &frames);
        assert_eq!(found, [(0.5, 0.5), (1.0, 1.0), (0.5, 1.0), (0.5, 1.0)]);
    }
}
