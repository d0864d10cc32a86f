//! Views: images with a hazard or without, from poses that give both, and their six kinds.

use crate::PosedImages;
use carff_base::geometry::PinholeCamera;
use carff_base::statistics::wilson_interval_of_share;
use carff_dataset::{Image, Observability, PoseRole, ScenarioInfo, drives::DriveKind};
use carff_scenes::FreePose;
use carff_trials::{Perception, Trial, trial_frame};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Names of the kinds by branch (hazard, clear) and visibility of the actor or its place.
const KINDS: [[&str; 3]; 2] =
    [["hazard_visible", "hazard_partial", "hazard_hidden"], ["clear_visible", "clear_partial", "clear_hidden"]];
/// First frame number of free views, which share no random draws with images of the dataset or free drives.
const FIRST_FREE: u64 = 1 << 41;
/// Probabilities are clamped to this and its complement in the log loss.
pub const SUREST: f64 = 1e-3;

/// One image of a part of the trials.
#[derive(Clone, Debug)]
pub struct TrialView<'a> {
    /// The image, without sensor noise.
    pub image: &'a Image,
    /// The camera.
    pub camera: &'a PinholeCamera,
    /// Pose of the camera; views from one pose are not independent.
    pub pose: usize,
    /// Name of the kind.
    pub kind: &'static str,
    /// True in a hazard branch.
    pub hazard: bool,
    /// Probability of a hazard, given the image, the pose and the scenario, with equally probable states.
    pub exact: f64,
    /// Frame number, which names the view's random draws.
    pub frame: u64,
}

/// Answer of an observer to one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// Probability of a hazard, 0..=1.
    pub hazard_probability: f64,
    /// True to halt, false to advance.
    pub halt: bool,
}

impl Answer {
    /// Halts when the probability reaches the threshold.
    pub fn at(hazard_probability: f64, threshold: f64) -> Self {
        Self { hazard_probability, halt: hazard_probability >= threshold }
    }
}

/// Figures of one kind of trial. Each image is one trial.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrialFigures {
    /// Images.
    pub images: usize,
    /// Poses of these images: what is independent.
    pub poses: usize,
    /// Trials that were answered with halt.
    pub halts: usize,
    /// Trials.
    pub trials: usize,
    /// 95 % Wilson interval of the share of halts that counts poses instead of images, `[low, high]`.
    pub halt_interval: [f64; 2],
    /// Mean of -ln of the probability given to what is true (hazard or none), clamped to 0.001..=0.999.
    pub log_loss: f64,
    /// Mean squared difference between hazard probability and truth, 0..=1.
    pub brier: f64,
}

/// Figures by kind: `hazard_visible`, `hazard_partial`, `hazard_hidden`, `clear_visible`, `clear_partial`,
/// `clear_hidden`. A kind without an image is absent.
pub type ByTrialKind = BTreeMap<String, TrialFigures>;

/// Names of the six kinds, in the order of tables.
pub fn kind_names() -> impl Iterator<Item = &'static str> {
    KINDS.into_iter().flatten()
}

fn kind_name(hazard: bool, observability: Observability) -> &'static str {
    let visibility = match observability {
        Observability::Full => 0,
        Observability::Partial => 1,
        Observability::None => 2,
    };
    KINDS[usize::from(!hazard)][visibility]
}

/// Share of hazard branches among the states that can be an input: those before the last time step.
fn exact_probability(scenario: &ScenarioInfo, alike: impl Iterator<Item = usize>) -> f64 {
    let inputs = alike.filter(|&state| scenario.timestamp_of(state) + 1 < scenario.timestamps);
    let (mut hazards, mut all) = (0_usize, 0_usize);
    for state in inputs {
        all += 1;
        hazards += usize::from(scenario.is_hazard(scenario.branch_of(state)));
    }
    hazards as f64 / all.max(1) as f64
}

/// Views of the dataset's poses of one role, at all time steps but the last.
pub fn views_of_role(posed: &PosedImages, role: PoseRole) -> Vec<TrialView<'_>> {
    let scenario = &posed.scenario;
    let all = posed.with_roles(&[role]).into_iter();
    all.filter(|&i| scenario.timestamp_of(posed.labels[i].state) + 1 < scenario.timestamps)
        .map(|i| {
            let label = posed.labels[i];
            let hazard = scenario.is_hazard(scenario.branch_of(label.state));
            TrialView {
                image: &posed.images[i],
                camera: &posed.dataset.frames()[i].camera,
                pose: label.view,
                kind: kind_name(hazard, label.observability),
                hazard,
                exact: exact_probability(scenario, posed.equivalent_states(label.view, label.state).into_iter()),
                frame: trial_frame(i, 0),
            }
        })
        .collect()
}

/// Views of free poses.
pub fn free_views<'a>(poses: &'a [FreePose], scenario: &ScenarioInfo) -> Vec<TrialView<'a>> {
    let branches = scenario.branches.len();
    let of_pose = |(pose, free): (usize, &'a FreePose)| {
        free.views.iter().enumerate().map(move |(branch, view)| {
            let hazard = scenario.is_hazard(branch);
            let observability = view.observability.unwrap_or(Observability::Full);
            TrialView {
                image: &view.image,
                camera: &free.camera,
                pose,
                kind: kind_name(hazard, observability),
                hazard,
                exact: exact_probability(scenario, view.alike.iter().copied()),
                frame: FIRST_FREE + (pose * branches + branch) as u64,
            }
        })
    };
    poses.iter().enumerate().flat_map(of_pose).collect()
}

/// Trials of views.
pub fn taken(perception: &Perception, views: &[TrialView]) -> Vec<Trial> {
    let kind = |hazard| if hazard { DriveKind::Hazard } else { DriveKind::Clear };
    views.iter().filter_map(|view| perception.trial((view.camera, view.image), kind(view.hazard), view.frame)).collect()
}

/// Returns -ln of the probability given to what is true; `p` is the hazard probability, clamped to 0.001..=0.999.
pub fn log_loss_of(p: f64, hazard: bool) -> f64 {
    let p = p.clamp(SUREST, 1.0 - SUREST);
    -if hazard { p.ln() } else { (1.0 - p).ln() }
}

/// Figures of the answers to looks, in the same order.
pub fn figures(views: &[TrialView], answers: &[Answer]) -> ByTrialKind {
    let mut poses: BTreeMap<&str, BTreeSet<usize>> = BTreeMap::new();
    let mut table = ByTrialKind::new();
    for (view, answer) in views.iter().zip(answers) {
        let figures = table.entry(view.kind.to_owned()).or_default();
        poses.entry(view.kind).or_default().insert(view.pose);
        let truth = f64::from(u8::from(view.hazard));
        figures.images += 1;
        figures.trials += 1;
        figures.halts += usize::from(answer.halt);
        figures.log_loss += log_loss_of(answer.hazard_probability, view.hazard);
        figures.brier += (answer.hazard_probability - truth).powi(2);
    }
    for (kind, figures) in &mut table {
        let n = figures.trials as f64;
        figures.poses = poses.get(kind.as_str()).map_or(0, BTreeSet::len);
        figures.halt_interval = wilson_interval_of_share(figures.halts as f64 / n, figures.poses as f64);
        figures.log_loss /= n;
        figures.brier /= n;
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two poses with two images each: halts are counted by image, the interval by pose; log loss and Brier score are
    /// the closed forms.
    #[test]
    fn figures_of_a_known_case() {
        let image = Image::filled(2, 2, [0; 3]);
        let camera = PinholeCamera::look_at([1.0; 3], [0.0; 3], [0.0, 0.0, 1.0], 2, 2, 60.0);
        let view = |pose, hazard| TrialView {
            image: &image,
            camera: &camera,
            pose,
            kind: kind_name(hazard, Observability::None),
            hazard,
            exact: 0.5,
            frame: 0,
        };
        let views = [view(0, true), view(0, true), view(1, true), view(1, true), view(1, false)];
        let answers = [0.5, 0.5, 1.0, 0.0, 0.25].map(|p| Answer::at(p, 0.4));
        let table = figures(&views, &answers);
        let hazard = table["hazard_hidden"];
        assert_eq!((hazard.images, hazard.poses, hazard.halts, hazard.trials), (4, 2, 3, 4));
        assert_eq!(hazard.halt_interval, wilson_interval_of_share(0.75, 2.0));
        let expected = -(2.0 * 0.5_f64.ln() + 0.999_f64.ln() + 0.001_f64.ln()) / 4.0;
        assert!((hazard.log_loss - expected).abs() < 1e-12);
        assert!((hazard.brier - (0.25 + 0.25 + 0.0 + 1.0) / 4.0).abs() < 1e-12);
        let clear = table["clear_hidden"];
        assert_eq!((clear.halts, clear.poses), (0, 1));
        assert!((clear.brier - 0.0625).abs() < 1e-12 && table.len() == 2);
    }
}
