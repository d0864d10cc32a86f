//! Accuracy and recall against the number of samples, and frequencies of open outcomes (tables 3 and 5).

use crate::stats::draws::{
    Curve, Frequencies, OpenInput, Shown, TrialCurve, accuracy_curve, expected_recall, frequencies, met_all,
    recall_curve, right_shares,
};
use crate::{ByRole, EvaluationError, Progress, ROLES, Subject, role_name};
use carff_base::random::Key;
use carff_checkpoint::FieldProbe;
use carff_dataset::{Observability, PoseRole};
use carff_decision::{Mixture, Sampling};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_plots::{Panel, Series};
use carff_trials::Planner;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Largest number of samples.
pub const MOST_SAMPLES: usize = 50;
/// Smallest number of trials on trained poses, and on the poses of each other role. Images are repeated with fresh
/// draws.
const TRIALS: [usize; 2] = [300, 100];
/// Largest number of trials of one image.
const MOST_REPEATS: usize = 30;

/// Curves by role of the pose.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForecastTable {
    /// Curves of each role.
    pub parts: ByRole<RoleCurves>,
}

/// Curves over n = 1..=50 samples. Accuracy is over images that show the actor's place fully and leave one branch open:
/// a sample is correct when its state looks, from that pose, like a possible next state. Recall is over images that
/// leave several branches open: whether any of the samples shows the true branch.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoleCurves {
    /// Share of correct samples, drawn from the forecast of the next step.
    pub accuracy: Curve,
    /// Share of trials in which the most frequent state of the samples is correct.
    pub majority_accuracy: Curve,
    /// Share of correct samples, drawn from the encoder's posterior without a forecast: correct about the image's own
    /// state.
    pub posterior_accuracy: Curve,
    /// Independent draws from the forecast.
    pub recall: Curve,
    /// Expected recall of independent draws: the true branch has its share of the branches that the image leaves open
    /// (two branches: 1 - 0.5^n).
    pub expected_recall: Vec<f64>,
    /// Band about the expected recall that holds 95 % of measurements with this number of trials, for each n
    /// separately.
    pub expected_band: Vec<[f64; 2]>,
    /// Number of n for which the recall is in the band.
    pub within_band: usize,
    /// Stratified draws from the forecast, as in the running graph.
    pub stratified_recall: Curve,
    /// Share of trials in which stratified draws show all open branches.
    pub stratified_recall_of_all: Curve,
    /// Share of trials in which any draw from the encoder's posterior, without a forecast, shows the image's own
    /// branch.
    pub posterior_recall: Curve,
}

/// One image with sensor noise.
struct Input {
    image: usize,
    posterior: Gaussian,
    mixture: Mixture,
    /// Possible next states and possible current states, given the image.
    next: Vec<usize>,
    now: Vec<usize>,
}

/// States shown by the samples of one trial.
struct Trial<'a> {
    input: &'a Input,
    independent: Vec<Shown>,
    posterior: Vec<Shown>,
    /// By number of samples; empty where recall is not measured.
    stratified: Vec<Vec<Shown>>,
}

/// Frequencies where images leave several outcomes open. Draws are independent, from the forecast of the next step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrequencyTable {
    /// Frequencies of branches.
    pub by_branch: Vec<Frequencies>,
    /// Frequencies of an actor being present. Empty for two branches, where they equal `by_branch`.
    pub by_presence: Vec<Frequencies>,
}

/// Both tables; the second one may be a reason why it is missing.
type Tables = (ForecastTable, Result<ByRole<FrequencyTable>, String>);

/// Computes both tables, or returns the reason why they are missing.
pub fn forecast(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<Tables, String> {
    let Planner { net, probe, .. } = subject.planner(Sampling::Stratified)?;
    if subject.posed.scenario.timestamps < 2 {
        return Err("the scenario has a single time step: there is nothing to forecast".into());
    }
    let mut table = ForecastTable::default();
    let mut of_roles = ByRole::default();
    for (done, role) in ROLES.into_iter().enumerate() {
        on_progress(&Progress {
            phase: "recall",
            done,
            total: ROLES.len(),
            line: format!("{} poses", role_name(role)),
        });
        let mut inputs = inputs(subject, role);
        if inputs.is_empty() {
            continue;
        }
        let posteriors: Vec<Gaussian> = inputs.iter().map(|i| i.posterior).collect();
        for (input, forecast) in inputs.iter_mut().zip(net.forecast_all(&posteriors)) {
            input.mixture = forecast;
        }
        let least = TRIALS[usize::from(role != PoseRole::Rest)];
        let (open, sure): (Vec<&Input>, Vec<&Input>) =
            inputs.iter().partition(|i| branches(subject, i.next.iter().copied()).count_ones() > 1);
        let full = |i: &&Input| subject.posed.labels[i.image].observability == Observability::Full;
        let sure: Vec<&Input> = sure.into_iter().filter(full).collect();
        let open = trials(subject, probe, &open, least, true);
        let sure = trials(subject, probe, &sure, least, false);
        table.parts.set(role, curves(subject, &open, &sure));
        let found = frequency_table(subject, &open);
        if !found.by_branch.is_empty() {
            of_roles.set(role, found);
        }
    }
    on_progress(&Progress { phase: "recall", done: ROLES.len(), total: ROLES.len(), line: String::new() });
    let none = || "no image leaves more than one branch open".to_owned();
    Ok((table, if of_roles.is_empty() { Err(none()) } else { Ok(of_roles) }))
}

/// The branches of states, as bits.
fn branches(subject: &Subject, states: impl IntoIterator<Item = usize>) -> u64 {
    states.into_iter().fold(0, |bits, s| bits | 1 << subject.posed.scenario.branch_of(s))
}

/// All images of one role that have a next step, each with fresh sensor noise.
fn inputs(subject: &Subject, role: PoseRole) -> Vec<Input> {
    let posed = &subject.posed;
    let mut inputs = Vec::new();
    for image in posed.with_roles(&[role]) {
        let label = posed.labels[image];
        if posed.scenario.next_state(label.state) == label.state {
            continue;
        }
        let now = posed.equivalent_states(label.view, label.state);
        let mut next: Vec<usize> = now.iter().map(|&s| posed.scenario.next_state(s)).collect();
        next.sort_unstable();
        next.dedup();
        let posterior = subject.encoder.encode(&subject.noisy_input(image));
        let mixture = Mixture { weights: Vec::new(), components: Vec::new() };
        inputs.extend(posterior.into_iter().map(|posterior| Input {
            image,
            posterior,
            mixture: mixture.clone(),
            next: next.clone(),
            now: now.clone(),
        }));
    }
    inputs
}

/// Draws and probes for each input, repeated until there are `least` trials.
fn trials<'a>(
    subject: &Subject,
    probe: &FieldProbe,
    inputs: &[&'a Input],
    least: usize,
    with_stratified: bool,
) -> Vec<Trial<'a>> {
    let repeats = least.div_ceil(inputs.len().max(1)).clamp(1, MOST_REPEATS);
    let all: Vec<(&Input, u64)> =
        inputs.iter().flat_map(|&i| (0..repeats).map(move |r| (i, (i.image * MOST_REPEATS + r) as u64))).collect();
    let seed = subject.options.seed;
    let run = |probe: &mut FieldProbe, (input, frame): (&'a Input, u64)| {
        let mut show = |latents: &[[f32; LATENT_DIM]]| -> Vec<Shown> {
            probe.probe_all(latents).iter().map(|p| Shown::of(&p.reading)).collect()
        };
        let draw = |n, sampling| input.mixture.draw(n, sampling, seed, frame, 1);
        let independent: Vec<_> = draw(MOST_SAMPLES, Sampling::Independent).into_iter().map(|d| d.latent).collect();
        let posterior: Vec<_> = (0..MOST_SAMPLES)
            .map(|sample| {
                let key = Key { sample: sample as u32, ..Key::named("post", seed, frame) };
                input.posterior.at(&carff_base::random::gaussians(key))
            })
            .collect();
        // Draw i of a component is the same latent for every n, so it is probed once.
        let mut stratified = Vec::new();
        if with_stratified {
            let sets: Vec<_> = (1..=MOST_SAMPLES).map(|n| draw(n, Sampling::Stratified)).collect();
            let mut distinct = BTreeMap::new();
            for set in &sets {
                for (i, d) in set.iter().enumerate() {
                    distinct.entry((i, d.component)).or_insert(d.latent);
                }
            }
            let latents: Vec<_> = distinct.values().copied().collect();
            let shown: BTreeMap<_, _> = distinct.into_keys().zip(show(&latents)).collect();
            let look_up = |(i, d): (usize, &carff_decision::Draw)| shown[&(i, d.component)];
            stratified = sets.iter().map(|set| set.iter().enumerate().map(look_up).collect()).collect();
        }
        Trial { input, independent: show(&independent), posterior: show(&posterior), stratified }
    };
    all.into_par_iter().map_init(|| probe.clone(), run).collect()
}

fn curves(subject: &Subject, open: &[Trial], sure: &[Trial]) -> RoleCurves {
    let posed = &subject.posed;
    let scenario = &posed.scenario;
    let label = |t: &Trial| posed.labels[t.input.image];
    let looks_like_any = |t: &Trial, shown: Shown, states: &[usize]| {
        let view = label(t).view;
        shown.any(|s| states.iter().any(|&other| posed.equivalence.same(view, s, other)))
    };
    let of = |trials: &[Trial], values: &dyn Fn(&Trial) -> Vec<f64>| -> Vec<TrialCurve> {
        trials.iter().map(|t| TrialCurve { image: t.input.image, values: values(t) }).collect()
    };
    let next_right =
        |t: &Trial| t.independent.iter().map(|s| looks_like_any(t, *s, &t.input.next)).collect::<Vec<bool>>();
    let true_branch = |t: &Trial| scenario.branch_of(label(t).state);
    let shows = |s: Shown, branch: usize| u64::from(s.any(|state| scenario.branch_of(state) == branch));
    let of_set = |t: &Trial, met: &dyn Fn(&[Shown]) -> bool| t.stratified.iter().map(|s| f64::from(met(s))).collect();
    let shown_branches = |set: &[Shown]| branches(subject, set.iter().flat_map(|s| s.states()));

    let recall = recall_curve(&of(open, &|t| met_all(t.independent.iter().map(|s| shows(*s, true_branch(t))), 1)));
    let shares: Vec<f64> = open
        .iter()
        .map(|t| {
            let of_branch = t.input.now.iter().filter(|s| scenario.branch_of(**s) == true_branch(t)).count();
            of_branch as f64 / t.input.now.len() as f64
        })
        .collect();
    let (expected_recall, expected_band): (Vec<f64>, Vec<[f64; 2]>) =
        (1..=recall.mean.len()).map(|n| expected_recall(n, &shares)).unzip();
    let within = recall.mean.iter().zip(&expected_band).filter(|(m, [low, high])| (*low..=*high).contains(m)).count();
    RoleCurves {
        accuracy: accuracy_curve(&of(sure, &|t| right_shares(next_right(t)))),
        majority_accuracy: recall_curve(&of(sure, &|t| {
            (1..=t.independent.len())
                .map(|n| f64::from(looks_like_any(t, most_shown(&t.independent[..n]), &t.input.next)))
                .collect()
        })),
        posterior_accuracy: accuracy_curve(&of(sure, &|t| {
            right_shares(t.posterior.iter().map(|s| looks_like_any(t, *s, &t.input.now)))
        })),
        recall,
        expected_recall,
        expected_band,
        within_band: within,
        stratified_recall: recall_curve(&of(open, &|t| {
            of_set(t, &|set| set.iter().any(|s| shows(*s, true_branch(t)) == 1))
        })),
        stratified_recall_of_all: recall_curve(&of(open, &|t| {
            let wanted = branches(subject, t.input.next.iter().copied());
            of_set(t, &|set| shown_branches(set) & wanted == wanted)
        })),
        posterior_recall: recall_curve(&of(open, &|t| {
            met_all(t.posterior.iter().map(|s| shows(*s, true_branch(t))), 1)
        })),
    }
}

/// The most frequent answer of the samples; among equally frequent answers, the first one.
fn most_shown(samples: &[Shown]) -> Shown {
    let count = |s: &Shown| samples.iter().filter(|other| *other == s).count();
    samples.iter().rev().max_by_key(|s| count(s)).copied().unwrap_or(Shown::NOTHING)
}

fn frequency_table(subject: &Subject, open: &[Trial]) -> FrequencyTable {
    let scenario = &subject.posed.scenario;
    let present = |state: usize| scenario.states.get(state).is_some_and(|s| s.boxes.iter().any(|b| b.dynamic));
    let count = |outcomes: usize, outcome: &dyn Fn(usize) -> usize| -> Vec<OpenInput> {
        let mut by_image = BTreeMap::<usize, OpenInput>::new();
        for trial in open {
            let input = by_image.entry(trial.input.image).or_insert_with(|| {
                let mut expected = vec![0.0; outcomes];
                for &state in &trial.input.now {
                    let next = scenario.next_state(state);
                    expected[outcome(next)] += 1.0 / trial.input.now.len() as f64;
                }
                OpenInput { expected, drawn: vec![0.0; outcomes], samples: 0 }
            });
            for shown in &trial.independent {
                let states: Vec<usize> = shown.states().collect();
                for &state in &states {
                    input.drawn[outcome(state)] += 1.0 / states.len() as f64;
                }
                input.samples += 1;
            }
        }
        by_image.into_values().collect()
    };
    let presence = ["actor present", "no actor"].map(str::to_owned);
    FrequencyTable {
        by_branch: frequencies(&count(scenario.branches.len(), &|s| scenario.branch_of(s)), &scenario.branches),
        by_presence: if scenario.branches.len() > 2 {
            frequencies(&count(2, &|s| usize::from(!present(s))), &presence)
        } else {
            Vec::new()
        },
    }
}

/// Draws `recall.png`.
pub fn draw(table: &ForecastTable, out: &Path) -> Result<(), EvaluationError> {
    let points = |values: &[f64]| values.iter().enumerate().map(|(i, v)| ((i + 1) as f64, 100.0 * v)).collect();
    let band = |band: &[[f64; 2]]| {
        band.iter().enumerate().map(|(i, [low, high])| ((i + 1) as f64, 100.0 * low, 100.0 * high)).collect()
    };
    let line = |name: &str, curve: &Curve| Series {
        name: name.to_owned(),
        points: points(&curve.mean),
        band: band(&curve.band),
        ..Series::default()
    };
    let mut panels = Vec::new();
    for (name, curves) in table.parts.iter().filter(|(name, _)| *name != role_name(PoseRole::Calibration)) {
        let panel = |title: String, y_label: &str, series: Vec<Series>| Panel {
            title,
            x_label: "samples n".into(),
            y_label: y_label.into(),
            series: series.into_iter().filter(|s| !s.points.is_empty()).collect(),
            ..Panel::default()
        };
        panels.push(panel(
            format!("Accuracy, {name} poses, band: 80 % of the images"),
            "correct samples, %",
            vec![
                line("forecast of the next step", &curves.accuracy),
                line("posterior only, own step", &curves.posterior_accuracy),
                Series { band: Vec::new(), ..line("forecast, most frequent state", &curves.majority_accuracy) },
            ],
        ));
        panels.push(panel(
            format!("Recall, {name} poses, bands: 95 %"),
            "trials that show the true branch, %",
            vec![
                line("independent draws", &curves.recall),
                Series {
                    name: "expected".into(),
                    points: points(&curves.expected_recall),
                    band: band(&curves.expected_band),
                    ..Series::default()
                },
                line("stratified draws", &curves.stratified_recall),
                line("posterior only, own step", &curves.posterior_recall),
            ],
        ));
    }
    Ok(carff_plots::curves(&out.join("recall.png"), "Accuracy and recall against the number of samples", &panels)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The most frequent answer wins; among equals the first; without samples nothing is shown.
    #[test]
    fn the_most_shown_wins() {
        let shown = |s: usize| Shown::from_states([s]);
        assert_eq!(most_shown(&[shown(1), shown(2), shown(2)]), shown(2));
        assert_eq!(most_shown(&[shown(3), shown(1), shown(1), shown(3)]), shown(3));
        assert_eq!(most_shown(&[]), Shown::NOTHING);
    }
}
