//! Table 4: every decision rule, by the paper's protocol and the honest one; and whether the hazard probability means what
//! it says.

use crate::ResultsError;
use crate::subject::Subject;
use carff_dataset::{
    PoseRole,
    drives::{DriveKind, EligibleInput, eligible_inputs},
};
use carff_decision::{Policy, Sampling};
use carff_evaluation::{PlanningTable, Trial, planning_table, trial, trials};
use carff_messages::Rule;
use carff_metrics::{Reliability, reliability};
use carff_plots::{Panel, Series};
use carff_random::Key;
use carff_training::run::Progress;
use rand::Rng;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Trials of each kind in the paper's protocol.
const ONE_IMAGE_TRIALS: usize = 30;
/// Least trials of each kind over all views.
const TRIALS: usize = 300;
/// Most times that one picture of another part of the poses is taken: pictures that differ in sensor noise alone are no
/// new cases.
const MOST_REPEATS: usize = 5;
/// Free drives are numbered from here, so that they share no random draws with pictures of the data set.
const FIRST_FREE: u64 = 1 << 40;
/// Bins of the reliability diagram.
const BINS: usize = 10;

/// Every rule at n = 2, 10 and 35: success by rule, number of samples, and kind of trial. The keys are those of the
/// launch report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlanningResults {
    /// Threshold of the calibrated rule, chosen on the calibration poses when the checkpoint was made; absent where none
    /// could be chosen: that rule is then left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f64>,
    /// The paper's protocol: one picture of each kind, 30 trials.
    pub one_image: PlanningTable,
    /// Which pictures those were, by kind.
    pub one_image_views: BTreeMap<String, OneImage>,
    /// Every eligible picture of trained poses that chose no threshold.
    pub all_views: PlanningTable,
    /// The same with independent draws in place of stratified ones.
    pub all_views_independent: PlanningTable,
    /// Every eligible picture of calibration poses: these chose the threshold.
    pub calibration_views: PlanningTable,
    /// Every eligible picture of poses never trained on.
    pub unseen_views: PlanningTable,
    /// Drives from poses that no training saw, one picture each; absent where nobody rendered them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub free_drives: Option<PlanningTable>,
    /// Pictures behind each table of views.
    pub views: BTreeMap<String, ViewCounts>,
}

/// A picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OneImage {
    /// Camera pose.
    pub view: usize,
    /// Course of events.
    pub branch: usize,
    /// Step of it.
    pub timestamp: usize,
}

/// Pictures of each kind, and how often each was taken with fresh sensor noise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ViewCounts {
    /// Pictures in which to halt is right.
    pub hazard: usize,
    /// Pictures in which to advance is right.
    pub clear: usize,
    /// Times that each hazard picture was taken.
    pub hazard_repeats: usize,
    /// Times that each clear picture was taken.
    pub clear_repeats: usize,
}

/// The table and the reliability by part of the poses, or why there are none.
type Found = Result<(PlanningResults, BTreeMap<String, Reliability>), String>;

pub fn planning(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<Found, ResultsError> {
    let scenario = &subject.pictures.scenario;
    if scenario.hazard_branches.is_empty() {
        return Ok(Err("the scenario names no branch in which the hazard action is right".into()));
    }
    if scenario.hazard_branches.len() == scenario.branches.len() {
        return Ok(Err("every branch of the scenario is a hazard".into()));
    }
    if let Some(why) = subject.probe.as_ref().err().or(subject.mixture.as_ref().err()) {
        return Ok(Err(why.clone()));
    }
    let policy = |rule| match (rule, subject.threshold) {
        (Rule::Calibrated, None) => None,
        (rule, threshold) => Some(Policy { rule, threshold: threshold.unwrap_or(1.0) }),
    };
    let rules: Vec<Policy> = Rule::ALL.into_iter().filter_map(policy).collect();
    let mut results = PlanningResults { threshold: subject.threshold, ..PlanningResults::default() };
    let tell = |done, line: &str| on_progress(&Progress { stage: "planning", done, total: 5, line: line.to_owned() });
    let parts = [PoseRole::Rest, PoseRole::Calibration, PoseRole::Unseen];
    for (i, (role, name)) in parts.into_iter().zip(["all_views", "calibration_views", "unseen_views"]).enumerate() {
        tell(i, name);
        let inputs = match eligible_inputs(&subject.pictures.dataset, &subject.pictures.split.views(role)) {
            Ok(inputs) => inputs,
            Err(error) => return Ok(Err(error.to_string())),
        };
        let [hazard, clear] = [DriveKind::Hazard, DriveKind::Clear]
            .map(|kind| inputs.iter().copied().filter(|i| i.kind == kind).collect::<Vec<EligibleInput>>());
        let repeats = |of: &[EligibleInput]| {
            let wanted = TRIALS.div_ceil(of.len().max(1));
            if role == PoseRole::Rest { wanted } else { wanted.min(MOST_REPEATS) }
        };
        let [hazard_repeats, clear_repeats] = [repeats(&hazard), repeats(&clear)];
        let mut taken = take(subject, &hazard, hazard_repeats)?;
        taken.extend(take(subject, &clear, clear_repeats)?);
        let table = decide(subject, &taken, &rules, Sampling::Stratified);
        let counts = ViewCounts { hazard: hazard.len(), clear: clear.len(), hazard_repeats, clear_repeats };
        results.views.insert(name.to_owned(), counts);
        match role {
            PoseRole::Rest => {
                results.all_views_independent = decide(subject, &taken, &rules, Sampling::Independent);
                results.all_views = table;
                tell(3, "one_image");
                let mut taken = Vec::new();
                for of_kind in [&hazard, &clear] {
                    let Some(chosen) = one_of(of_kind, subject.options.seed) else { continue };
                    taken.extend(take(subject, &[chosen], ONE_IMAGE_TRIALS)?);
                    let (view, branch, timestamp) = (chosen.view, chosen.branch, chosen.timestamp);
                    let image = OneImage { view, branch, timestamp };
                    results.one_image_views.insert(chosen.kind.name().to_owned(), image);
                }
                results.one_image = decide(subject, &taken, &rules, Sampling::Stratified);
            }
            PoseRole::Calibration => results.calibration_views = table,
            PoseRole::Unseen => results.unseen_views = table,
        }
    }
    if !subject.free_drives.is_empty() {
        tell(4, "free_drives");
        let (seed, noise) = (subject.options.seed, subject.noise());
        let taken: Vec<Trial> = subject
            .free_drives
            .iter()
            .enumerate()
            .filter_map(|(i, (image, kind))| trial(&subject.encoder, image, *kind, &noise, seed, FIRST_FREE + i as u64))
            .collect();
        results.free_drives = Some(decide(subject, &taken, &rules, Sampling::Stratified));
    }
    tell(4, "reliability");
    let reliability = hazard_reliability(subject)?;
    tell(5, "");
    Ok(Ok((results, reliability)))
}

/// One of the inputs, drawn by seed.
fn one_of(inputs: &[EligibleInput], seed: u64) -> Option<EligibleInput> {
    let mut rng = carff_random::stream(Key { seed, frame: 0x6f6e_6520_696d_6167, step: 0, sample: 0 });
    (!inputs.is_empty()).then(|| inputs[rng.random_range(0..inputs.len())])
}

fn take(subject: &Subject, inputs: &[EligibleInput], repeats: usize) -> Result<Vec<Trial>, ResultsError> {
    let (dataset, seed) = (&subject.pictures.dataset, subject.options.seed);
    Ok(trials(&subject.encoder, dataset, inputs, repeats, &subject.noise(), seed)?)
}

fn decide(subject: &Subject, trials: &[Trial], rules: &[Policy], sampling: Sampling) -> PlanningTable {
    match (&subject.mixture, &subject.probe) {
        (Ok(net), Ok(probe)) => planning_table(net, probe, trials, rules, sampling, subject.horizon()).0,
        _ => PlanningTable::new(),
    }
}

/// Hazard probabilities (n = 10, stratified) of every picture that has a next step, whatever it shows, against whether
/// its branch is one with a hazard. Each picture is taken once. Branches are equally frequent in a data set.
fn hazard_reliability(subject: &Subject) -> Result<BTreeMap<String, Reliability>, ResultsError> {
    let (Ok(net), Ok(probe)) = (&subject.mixture, &subject.probe) else { return Ok(BTreeMap::new()) };
    let scenario = &subject.pictures.scenario;
    let mut found = BTreeMap::new();
    for (role, name) in crate::subject::ROLES {
        let inputs: Vec<EligibleInput> = subject
            .pictures
            .with_roles(&[role])
            .into_iter()
            .map(|i| subject.pictures.labels[i])
            .filter(|label| (label.state % scenario.timestamps) + 1 < scenario.timestamps)
            .map(|label| {
                let (branch, timestamp) = (label.state / scenario.timestamps, label.state % scenario.timestamps);
                let kind = if scenario.is_hazard(branch) { DriveKind::Hazard } else { DriveKind::Clear };
                EligibleInput { view: label.view, branch, timestamp, kind }
            })
            .collect();
        let trials = take(subject, &inputs, 1)?;
        let (_, outcomes) = planning_table(net, probe, &trials, &[], Sampling::Stratified, subject.horizon());
        let forecasts: Vec<(f64, bool)> =
            outcomes.iter().map(|o| (f64::from(o.hazard_probability), o.kind == DriveKind::Hazard)).collect();
        found.insert(name.to_owned(), reliability(&forecasts, BINS));
    }
    Ok(found)
}

/// Draws `reliability.png`.
pub fn draw(reliability: &BTreeMap<String, Reliability>, out: &Path) -> Result<(), ResultsError> {
    let panel = |name: &str| -> Option<Panel> {
        let found = reliability.get(name)?;
        let bins = || found.bins.iter();
        Some(Panel {
            title: format!(
                "{name} poses: {} pictures, expected calibration error {:.3}",
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
                Series { name: "as it should be".into(), points: vec![(0.0, 0.0), (1.0, 1.0)], ..Series::default() },
            ],
            ..Panel::default()
        })
    };
    let panels: Vec<Panel> = ["trained", "unseen"].into_iter().filter_map(panel).collect();
    Ok(carff_plots::curves(&out.join("reliability.png"), "Does the hazard probability mean what it says?", &panels)?)
}
