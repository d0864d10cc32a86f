//! Trials of six kinds from poses that give hazard and clear images alike, and baselines on the same images.

use crate::trials::{
    baselines::{ReadOut, nearest_neighbour},
    views::{Answer, ByTrialKind, TrialView, figures, free_views, taken, views_of_role},
};
use crate::{Progress, Subject};
use carff_dataset::PoseRole;
use carff_decision::{CalibrationTrial, Evidence, Policy, Sampling, choose_threshold};
use carff_messages::Rule;
use carff_trials::{SAMPLES, Trial};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Figures by part of the trials: `rest` (trained poses), `unseen` (held-out poses), `free` (poses of no dataset).
pub type ByPart = BTreeMap<String, ByTrialKind>;

/// A baseline on the images of the trials.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Description for the page.
    pub about: String,
    /// Figures by part.
    pub trials: ByPart,
}

/// Trials and baselines by name.
pub type TrialsAndBaselines = (ByPart, BTreeMap<String, Baseline>);

/// Parts of the dataset's poses, with their roles.
const PARTS: [(&str, PoseRole); 2] = [("rest", PoseRole::Rest), ("unseen", PoseRole::Unseen)];

/// Names of the baselines and what they are, in the order of the page.
const BASELINES: [(&str, &str); 6] = [
    ("always_halt", "always halts"),
    ("always_advance", "always advances"),
    ("nearest_neighbour", "nearest image of trained poses by 16 x 16 thumbnail; for trained poses, of other poses"),
    ("read_out", "encoder, linear read-out and threshold: no forecast, no field, no loop"),
    ("paper", "this system with the paper's rule, n = 10"),
    ("exact", "exact posterior of an observer that knows scenario and pose: the ceiling"),
];

/// Computes the trials of a scenario with hazards, or returns the reason why there are none.
pub fn trials(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<TrialsAndBaselines, String> {
    super::planning::plannable(subject)?;
    let threshold = subject.threshold.ok_or("the checkpoint has no threshold")?;
    let planner = subject.planner(Sampling::Stratified)?;
    let posed = &subject.posed;
    let mut parts: Vec<(&str, Vec<TrialView>)> =
        PARTS.into_iter().map(|(name, role)| (name, views_of_role(posed, role))).collect();
    parts.push(("free", free_views(&subject.free_poses, &posed.scenario)));
    parts.retain(|(_, views)| !views.is_empty());
    let read_out = ReadOut::fit(posed, &subject.posteriors);
    let read_out_threshold = read_out_threshold(subject, &read_out).unwrap_or(threshold);
    let (mut own, mut baselines) = (ByPart::new(), BTreeMap::<String, Baseline>::new());
    let total = parts.len();
    for (done, (part, views)) in parts.into_iter().enumerate() {
        on_progress(&Progress { phase: "trials", done, total, line: part.to_owned() });
        let taken = taken(&subject.perception(), &views);
        let evidence = planner.evidence(&taken, SAMPLES);
        let by_rule = |rule| by_rule(&evidence, Policy::new(rule, threshold));
        own.insert(part.to_owned(), figures(&views, &by_rule(Rule::Calibrated)));
        let constant = |p: f64| views.iter().map(|_| Answer::at(p, 0.5)).collect::<Vec<_>>();
        let at = |threshold: f64, p: Vec<f64>| p.into_iter().map(|p| Answer::at(p, threshold)).collect::<Vec<_>>();
        let exact = views.iter().map(|view| view.exact).collect();
        let of_posterior = |trial: &Trial| read_out.hazard_probability(&trial.posterior);
        let answers = [
            constant(1.0),
            constant(0.0),
            at(0.5, nearest_neighbour(posed, &views, part == "rest")),
            at(read_out_threshold, taken.iter().map(of_posterior).collect()),
            by_rule(Rule::Paper),
            at(threshold, exact),
        ];
        for ((name, about), answers) in BASELINES.into_iter().zip(answers) {
            let baseline = baselines.entry(name.to_owned()).or_default();
            about.clone_into(&mut baseline.about);
            baseline.trials.insert(part.to_owned(), figures(&views, &answers));
        }
    }
    Ok((own, baselines))
}

fn by_rule(evidence: &[Evidence], policy: Policy) -> Vec<Answer> {
    let answer = |evidence: &Evidence| Answer {
        hazard_probability: evidence.hazard_or_unknown_probability(),
        halt: policy.decide(evidence).halt,
    };
    evidence.iter().map(answer).collect()
}

/// Threshold of the read-out, chosen like that of the calibrated rule on the calibration poses.
fn read_out_threshold(subject: &Subject, read_out: &ReadOut) -> Option<f64> {
    let views = views_of_role(&subject.posed, PoseRole::Calibration);
    let taken = taken(&subject.perception(), &views);
    let trials: Vec<CalibrationTrial> = views
        .iter()
        .zip(&taken)
        .filter(|(view, _)| matches!(view.kind, "hazard_hidden" | "clear_visible"))
        .map(|(view, trial)| CalibrationTrial {
            hazard_probability: read_out.hazard_probability(&trial.posterior),
            halt_is_right: view.hazard,
        })
        .collect();
    choose_threshold(&trials)
}
