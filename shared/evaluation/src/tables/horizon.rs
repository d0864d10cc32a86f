//! What a longer look-ahead is worth: the hazard probability and the decisions of several horizons on the same images.

use crate::trials::views::{TrialView, free_views, log_loss_of, taken};
use crate::{Progress, Subject};
use carff_dataset::ScenarioInfo;
use carff_decision::{Evidence, Feedback, Policy, Sampling};
use carff_messages::Rule;
use carff_scenes::FreePose;
use carff_trials::{Planner, SAMPLES};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Horizons of the table.
const HORIZONS: [u32; 4] = [1, 2, 4, 8];
/// Inputs of further steps.
const FEEDBACKS: [(&str, Feedback); 2] = [("state", Feedback::State), ("latent", Feedback::Latent)];

/// Figures of one horizon. The right decision of an image is that of the exact posterior: to halt if the probability
/// that the hazard comes at any later time reaches the threshold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HorizonFigures {
    /// Number of steps looked ahead.
    pub horizon: u32,
    /// Mean of -ln of the probability given to what is true: the hazard comes at any later time, or not.
    pub log_loss: f64,
    /// The same of an observer that knows scenario and pose, and looks as far ahead.
    pub exact_log_loss: f64,
    /// Mean squared difference between hazard probability and truth, 0..=1.
    pub brier: f64,
    /// Images whose hazard comes that are answered with an advance.
    pub unsafe_advances: usize,
    /// Images that exclude a hazard at any time and are answered with a halt.
    pub needless_halts: usize,
    /// Decisions that differ from those of horizon 1.
    pub changed: usize,
    /// Changed decisions that are right now.
    pub improved: usize,
}

/// Figures by feedback (`state`, `latent`), each in the order of the horizons.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HorizonTable {
    /// Threshold of the calibrated rule.
    pub threshold: f64,
    /// Free poses, which are what is independent.
    pub poses: usize,
    /// Images: one of each branch at each pose.
    pub images: usize,
    /// Images whose hazard comes.
    pub hazard_images: usize,
    /// Images that exclude a hazard at any time.
    pub excluding_images: usize,
    /// Figures by feedback.
    pub feedback: BTreeMap<String, Vec<HorizonFigures>>,
}

/// Computes the table on free poses, or returns the reason why there is none.
pub fn horizon(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<HorizonTable, String> {
    super::planning::plannable(subject)?;
    let threshold = subject.threshold.ok_or("the checkpoint has no threshold")?;
    let scenario = &subject.posed.scenario;
    let views = free_views(&subject.free_poses, scenario);
    if views.is_empty() {
        return Err("the dataset has no scenario file, so there are no free poses".into());
    }
    let trials = taken(&subject.perception(), &views);
    let planner = subject.planner(Sampling::Stratified)?;
    let policy = Policy::new(Rule::Calibrated, threshold);
    let mut table = HorizonTable {
        threshold,
        poses: subject.free_poses.len(),
        images: views.len(),
        hazard_images: views.iter().filter(|view| view.hazard).count(),
        excluding_images: views.iter().filter(|view| view.exact <= 0.0).count(),
        feedback: BTreeMap::new(),
    };
    for (done, (name, feedback)) in FEEDBACKS.into_iter().enumerate() {
        on_progress(&Progress { phase: "horizon", done, total: FEEDBACKS.len(), line: name.to_owned() });
        let answers = HORIZONS.map(|horizon| Planner { horizon, feedback, ..planner }.evidence(&trials, SAMPLES));
        let exact = HORIZONS.map(|horizon| exact_within(&subject.free_poses, scenario, horizon));
        let rows = HORIZONS.into_iter().zip(answers.iter().zip(&exact));
        let figures = rows.map(|(horizon, (own, exact))| {
            let answers = Answers { first: &answers[0], own, exact };
            answers.figures(&views, &policy, threshold, horizon)
        });
        table.feedback.insert(name.to_owned(), figures.collect());
    }
    Ok(table)
}

/// Answers to all views.
struct Answers<'a> {
    /// Answers of horizon 1.
    first: &'a [Evidence],
    /// Answers of the horizon itself.
    own: &'a [Evidence],
    /// Hazard probabilities of an observer that knows scenario and pose.
    exact: &'a [f64],
}

impl Answers<'_> {
    fn figures(&self, views: &[TrialView], policy: &Policy, threshold: f64, horizon: u32) -> HorizonFigures {
        let mut figures = HorizonFigures { horizon, ..HorizonFigures::default() };
        let answers = self.first.iter().zip(self.own).zip(self.exact);
        for (view, ((first, own), &exact)) in views.iter().zip(answers) {
            let p = own.hazard_or_unknown_probability();
            let [halts, halted] = [own, first].map(|evidence| policy.decide(evidence).halt);
            let right = view.exact >= threshold;
            figures.log_loss += log_loss_of(p, view.hazard);
            figures.exact_log_loss += log_loss_of(exact, view.hazard);
            figures.brier += (p - f64::from(u8::from(view.hazard))).powi(2);
            figures.unsafe_advances += usize::from(view.hazard && !halts);
            figures.needless_halts += usize::from(view.exact <= 0.0 && halts);
            figures.changed += usize::from(halts != halted);
            figures.improved += usize::from(halts != halted && halts == right);
        }
        let n = views.len().max(1) as f64;
        for mean in [&mut figures.log_loss, &mut figures.exact_log_loss, &mut figures.brier] {
            *mean /= n;
        }
        figures
    }
}

/// Exact probability of each view that a hazard is met within `horizon` steps.
fn exact_within(poses: &[FreePose], scenario: &ScenarioInfo, horizon: u32) -> Vec<f64> {
    let last = scenario.timestamps.saturating_sub(1);
    let meets = |state: usize| {
        let end = (scenario.timestamp_of(state) + horizon as usize).min(last);
        scenario.is_hazard_at(scenario.branch_of(state), end)
    };
    let of_view = |alike: &[usize]| {
        let inputs: Vec<usize> = alike.iter().copied().filter(|&s| scenario.timestamp_of(s) < last).collect();
        inputs.iter().filter(|&&state| meets(state)).count() as f64 / inputs.len().max(1) as f64
    };
    poses.iter().flat_map(|pose| &pose.views).map(|view| of_view(&view.alike)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::PinholeCamera;
    use carff_dataset::Image;
    use carff_decision::SampleEvidence;

    fn evidence(hazard_probability: f32) -> Evidence {
        let mut evidence = Evidence::NONE;
        let sample = SampleEvidence { is_known: true, hazard_likelihood: hazard_probability };
        evidence.add_step(1, hazard_probability, 1.0, [sample]);
        evidence
    }

    /// A longer look-ahead that finds the hazard changes the decision and improves it; one that invents a hazard
    /// changes it only.
    #[test]
    fn changes_are_judged_by_the_exact_posterior() {
        let image = Image::filled(2, 2, [0; 3]);
        let camera = PinholeCamera::look_at([1.0; 3], [0.0; 3], [0.0, 0.0, 1.0], 2, 2, 60.0);
        let view = |hazard, exact| TrialView {
            image: &image,
            camera: &camera,
            pose: 0,
            kind: "hazard_visible",
            hazard,
            exact,
            frame: 0,
        };
        let views = [view(true, 0.5), view(false, 0.5), view(false, 0.0)];
        let first = [0.0; 3].map(evidence);
        let own = [0.5, 0.5, 0.5].map(evidence);
        let answers = Answers { first: &first, own: &own, exact: &[0.5, 0.5, 0.0] };
        let figures = answers.figures(&views, &Policy::new(Rule::Calibrated, 0.1), 0.1, 2);
        assert_eq!((figures.unsafe_advances, figures.needless_halts), (0, 1));
        assert_eq!((figures.changed, figures.improved), (3, 2));
        assert!((figures.brier - 0.25).abs() < 1e-9);
        let before = Answers { first: &first, own: &first, exact: &[0.0; 3] };
        let figures = before.figures(&views, &Policy::new(Rule::Calibrated, 0.1), 0.1, 1);
        assert_eq!((figures.unsafe_advances, figures.needless_halts, figures.changed), (1, 0, 0));
    }
}
