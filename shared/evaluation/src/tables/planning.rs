//! Planning table: every decision rule, by the paper's protocol and over all views; and the reliability of the hazard
//! probability (table 4).

use crate::{ByRole, EvaluationError, Progress, ROLES, Subject, role_name};
use carff_base::random::{Key, tag};
use carff_dataset::{
    PoseRole,
    drives::{DriveKind, EligibleInput, eligible_inputs},
};
use carff_decision::{Policy, Sampling};
use carff_messages::Rule;
use carff_plots::{Panel, Series};
use carff_trials::{
    ByKind, LEAST_TRIALS, MOST_REPEATS, PlanningTable, RELIABILITY_BINS, Reliability, Trial, reliability,
};
use rand::Rng;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Trials of each kind in the paper's protocol.
const ONE_IMAGE_TRIALS: usize = 30;
/// First frame number of free drives, which share no random draws with images of the dataset.
const FIRST_FREE: u64 = 1 << 40;

/// Every rule with 2, 10 and 35 samples. The keys are those of the launch report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanningResults {
    /// Threshold of the calibrated rule, chosen on the calibration poses when the checkpoint was made. Absent where
    /// none could be chosen; the calibrated rule is then left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f64>,
    /// The paper's protocol: one image of each kind, 30 trials.
    pub one_image: PlanningTable,
    /// The images of the paper's protocol.
    pub one_image_views: ByKind<OneImage>,
    /// Every eligible image of trained poses that chose no setting.
    pub all_views: PlanningTable,
    /// Every eligible image of these poses, with independent instead of stratified draws.
    pub all_views_independent: PlanningTable,
    /// Every eligible image of the calibration poses, which chose the threshold.
    pub calibration_views: PlanningTable,
    /// Every eligible image of held-out poses.
    pub unseen_views: PlanningTable,
    /// Drives from free poses, one image each. Absent where they were not rendered.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub free_drives: Option<PlanningTable>,
    /// Images behind each table of views.
    pub views: PlanningViews,
}

/// Images behind the tables of views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanningViews {
    /// Trained poses that chose no setting.
    pub all_views: ViewCounts,
    /// Calibration poses.
    pub calibration_views: ViewCounts,
    /// Held-out poses.
    pub unseen_views: ViewCounts,
}

/// An image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OneImage {
    /// Camera pose.
    pub view: usize,
    /// Branch.
    pub branch: usize,
    /// Time step of the branch.
    pub timestamp: usize,
}

/// Number of images of each kind, and of the trials of each image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewCounts {
    /// Images in which halting is correct.
    pub hazard: usize,
    /// Images in which advancing is correct.
    pub clear: usize,
    /// Trials of each hazard image.
    pub hazard_repeats: usize,
    /// Trials of each clear image.
    pub clear_repeats: usize,
}

/// Both results, or the reason why they are missing.
type Found = Result<(PlanningResults, ByRole<Reliability>), String>;

/// Computes the tables and the reliability.
pub fn planning(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<Found, EvaluationError> {
    if let Err(why) = plannable(subject) {
        return Ok(Err(why));
    }
    // Without a threshold there is no calibrated rule.
    let known = |policy: &Policy| policy.rule != Rule::Calibrated || subject.threshold.is_some();
    let policies = Policy::all(subject.threshold.unwrap_or(1.0)).into_iter().filter(known).collect();
    let protocol = Protocol { subject, policies };
    let mut results = PlanningResults { threshold: subject.threshold, ..PlanningResults::default() };
    let tell = |done, line: &str| on_progress(&Progress { phase: "planning", done, total: 5, line: line.to_owned() });
    for (done, role) in ROLES.into_iter().enumerate() {
        tell(done, role_name(role));
        if let Err(why) = protocol.views(role, &mut results)? {
            return Ok(Err(why));
        }
    }
    if !subject.free_drives.is_empty() {
        tell(4, "free_drives");
        results.free_drives = Some(protocol.free_drives());
    }
    tell(4, "reliability");
    let reliability = protocol.hazard_reliability()?;
    tell(5, "");
    Ok(Ok((results, reliability)))
}

/// Reason why there is nothing to plan, as an error.
pub fn plannable(subject: &Subject) -> Result<(), String> {
    let scenario = &subject.posed.scenario;
    if scenario.hazard_branches.is_empty() {
        return Err("the scenario has no branch in which the hazard action is right".into());
    }
    if scenario.hazard_branches.len() == scenario.branches.len() {
        return Err("every branch of the scenario is a hazard".into());
    }
    subject.planner(Sampling::Stratified).map(|_| ())
}

struct Protocol<'a> {
    subject: &'a Subject,
    policies: Vec<Policy>,
}

impl Protocol<'_> {
    /// Table of the eligible images of one role, and for trained poses the paper's protocol.
    fn views(&self, role: PoseRole, results: &mut PlanningResults) -> Result<Result<(), String>, EvaluationError> {
        let posed = &self.subject.posed;
        let inputs = match eligible_inputs(&posed.dataset, &posed.split.views(role)) {
            Ok(inputs) => inputs,
            Err(error) => return Ok(Err(error.to_string())),
        };
        let [hazard, clear] = [DriveKind::Hazard, DriveKind::Clear]
            .map(|kind| inputs.iter().copied().filter(|i| i.kind == kind).collect::<Vec<EligibleInput>>());
        let repeats = |of: &[EligibleInput]| {
            let wanted = LEAST_TRIALS.div_ceil(of.len().max(1));
            if role == PoseRole::Rest { wanted } else { wanted.min(MOST_REPEATS) }
        };
        let counts = ViewCounts {
            hazard: hazard.len(),
            clear: clear.len(),
            hazard_repeats: repeats(&hazard),
            clear_repeats: repeats(&clear),
        };
        let mut taken = self.take(&hazard, counts.hazard_repeats)?;
        taken.extend(self.take(&clear, counts.clear_repeats)?);
        let table = self.decide(&taken, Sampling::Stratified);
        match role {
            PoseRole::Rest => {
                results.all_views_independent = self.decide(&taken, Sampling::Independent);
                (results.all_views, results.views.all_views) = (table, counts);
                self.one_image([&hazard, &clear], results)?;
            }
            PoseRole::Calibration => (results.calibration_views, results.views.calibration_views) = (table, counts),
            PoseRole::Unseen => (results.unseen_views, results.views.unseen_views) = (table, counts),
        }
        Ok(Ok(()))
    }

    /// The paper's protocol.
    fn one_image(&self, of_kinds: [&[EligibleInput]; 2], results: &mut PlanningResults) -> Result<(), EvaluationError> {
        let mut taken = Vec::new();
        for of_kind in of_kinds {
            let Some(chosen) = one_of(of_kind, self.subject.options.seed) else { continue };
            taken.extend(self.take(&[chosen], ONE_IMAGE_TRIALS)?);
            let (view, branch, timestamp) = (chosen.view, chosen.branch, chosen.timestamp);
            *results.one_image_views.entry(chosen.kind) = Some(OneImage { view, branch, timestamp });
        }
        results.one_image = self.decide(&taken, Sampling::Stratified);
        Ok(())
    }

    fn free_drives(&self) -> PlanningTable {
        let perception = self.subject.perception();
        let drives = self.subject.free_drives.iter().enumerate();
        let taken: Vec<Trial> = drives
            .filter_map(|(i, d)| perception.trial((&d.camera, &d.image), d.kind, FIRST_FREE + i as u64))
            .collect();
        self.decide(&taken, Sampling::Stratified)
    }

    fn take(&self, inputs: &[EligibleInput], repeats: usize) -> Result<Vec<Trial>, EvaluationError> {
        Ok(self.subject.perception().trials(&self.subject.posed.dataset, inputs, repeats)?)
    }

    fn decide(&self, trials: &[Trial], sampling: Sampling) -> PlanningTable {
        self.subject.planner(sampling).map(|planner| planner.table(trials, &self.policies).0).unwrap_or_default()
    }

    /// Reliability of the hazard probabilities (10 stratified samples) of every image that has a next step, against
    /// whether its branch has a hazard. Each image is taken once. Branches are equally frequent in a dataset.
    fn hazard_reliability(&self) -> Result<ByRole<Reliability>, EvaluationError> {
        let posed = &self.subject.posed;
        let Ok(planner) = self.subject.planner(Sampling::Stratified) else { return Ok(ByRole::default()) };
        let scenario = &posed.scenario;
        let mut found = ByRole::default();
        for role in ROLES {
            let inputs: Vec<EligibleInput> = posed
                .with_roles(&[role])
                .into_iter()
                .map(|i| posed.labels[i])
                .filter(|label| scenario.next_state(label.state) != label.state)
                .map(|label| {
                    let branch = scenario.branch_of(label.state);
                    let kind = if scenario.is_hazard(branch) { DriveKind::Hazard } else { DriveKind::Clear };
                    let timestamp = scenario.timestamp_of(label.state);
                    EligibleInput { view: label.view, branch, timestamp, kind }
                })
                .collect();
            let (_, outcomes) = planner.table(&self.take(&inputs, 1)?, &[]);
            let forecasts: Vec<(f64, bool)> =
                outcomes.iter().map(|o| (f64::from(o.hazard_probability), o.kind == DriveKind::Hazard)).collect();
            found.set(role, reliability(&forecasts, RELIABILITY_BINS));
        }
        Ok(found)
    }
}

/// One of the inputs, drawn by seed.
fn one_of(inputs: &[EligibleInput], seed: u64) -> Option<EligibleInput> {
    let mut rng = carff_base::random::stream(Key { seed, frame: tag("one imag"), step: 0, sample: 0 });
    (!inputs.is_empty()).then(|| inputs[rng.random_range(0..inputs.len())])
}

/// Draws `reliability.png`.
pub fn draw(reliability: &ByRole<Reliability>, out: &Path) -> Result<(), EvaluationError> {
    let panel = |role: PoseRole| -> Option<Panel> {
        let (name, found) = (role_name(role), reliability.get(role)?);
        let bins = || found.bins.iter();
        Some(Panel {
            title: format!(
                "{name} poses: {} images, expected calibration error {:.3}",
                found.trials, found.expected_calibration_error
            ),
            x_label: "hazard probability".into(),
            y_label: "share with a hazard".into(),
            series: vec![
                Series {
                    name: "found, with 95 % interval".into(),
                    points: bins().map(|b| (b.forecast, b.happened)).collect(),
                    band: bins().map(|b| (b.forecast, b.interval[0], b.interval[1])).collect(),
                    ..Series::default()
                },
                Series { name: "ideal".into(), points: vec![(0.0, 0.0), (1.0, 1.0)], ..Series::default() },
            ],
            ..Panel::default()
        })
    };
    let panels: Vec<Panel> = [PoseRole::Rest, PoseRole::Unseen].into_iter().filter_map(panel).collect();
    Ok(carff_plots::curves(&out.join("reliability.png"), "Reliability of the hazard probability", &panels)?)
}
