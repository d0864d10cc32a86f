//! Tables 3 and 5: what samples show against their number, and how often, where the picture leaves several outcomes open.

use crate::subject::{ROLES, Subject};
use crate::{FrequencyTable, ResultsError};
use carff_checkpoint::FieldProbe;
use carff_dataset::{Observability, PoseRole};
use carff_decision::{Mixture, Sampling};
use carff_evaluation::draws::{
    Curve, OpenInput, Shown, TrialCurve, accuracy_curve, expected_recall, frequencies, met_all, recall_curve,
    right_shares,
};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_plots::{Panel, Series};
use carff_random::Key;
use carff_training::run::Progress;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Largest number of samples.
pub const MOST_SAMPLES: usize = 50;
/// Least trials on trained poses, and on each other part; a picture is tried as often as it takes, with fresh draws.
const TRIALS: [usize; 2] = [300, 100];
/// Most trials of one picture.
const MOST_REPEATS: usize = 30;

/// Curves by part of the poses: `trained`, `calibration`, `unseen`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ForecastTable {
    /// By part.
    pub parts: BTreeMap<String, RoleCurves>,
}

/// Curves over n = 1..=50 samples. Accuracy is over pictures that show the actor's place fully and leave one branch open:
/// a sample is right when the state it shows looks, from that pose, like one that can come next. Recall is over pictures
/// that leave several branches open: whether any of the samples shows the branch that came.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RoleCurves {
    /// Share of right samples, drawn from the forecast of the next step.
    pub accuracy: Curve,
    /// Whether the state that most samples show is right.
    pub majority_accuracy: Curve,
    /// Share of right samples, drawn from the encoder's posterior alone: right about the picture's own state.
    pub posterior_accuracy: Curve,
    /// Independent draws from the forecast.
    pub recall: Curve,
    /// What is to be expected of them: the branch that came has its share of what the picture leaves open (two branches:
    /// 1 - 0.5^n).
    pub expected_recall: Vec<f64>,
    /// Band about it in which 95 % of measurements with so many trials lie, at each n by itself.
    pub expected_band: Vec<[f64; 2]>,
    /// How many of the n lie in the band.
    pub within_band: usize,
    /// Stratified draws from the forecast, as the running graph takes them.
    pub stratified_recall: Curve,
    /// Stratified draws: whether all open branches are shown.
    pub stratified_recall_of_all: Curve,
    /// Draws from the encoder's posterior alone: whether any shows the picture's own branch.
    pub posterior_recall: Curve,
}

/// One picture, taken with sensor noise.
struct Input {
    picture: usize,
    posterior: Gaussian,
    mixture: Mixture,
    /// States that can come next, and those that are there, for all that the picture tells.
    next: Vec<usize>,
    now: Vec<usize>,
}

/// What the samples of one trial show.
struct Trial<'a> {
    input: &'a Input,
    independent: Vec<Shown>,
    posterior: Vec<Shown>,
    /// By number of samples; empty where recall is not asked.
    stratified: Vec<Vec<Shown>>,
}

/// Both tables, or why there is none.
type Tables = (ForecastTable, Result<BTreeMap<String, FrequencyTable>, String>);

pub fn forecast(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<Tables, String> {
    let probe = subject.probe.as_ref().map_err(Clone::clone)?;
    let mixture = subject.mixture.as_ref().map_err(Clone::clone)?;
    if subject.manifest.scenario.timestamps < 2 {
        return Err("the scenario has a single time step: there is nothing to forecast".into());
    }
    let mut table = ForecastTable::default();
    let mut of_parts = BTreeMap::new();
    for (part, (role, name)) in ROLES.into_iter().enumerate() {
        on_progress(&Progress { stage: "recall", done: part, total: ROLES.len(), line: format!("{name} poses") });
        let mut inputs = inputs(subject, role);
        if inputs.is_empty() {
            continue;
        }
        let posteriors: Vec<Gaussian> = inputs.iter().map(|i| i.posterior).collect();
        for (input, forecast) in inputs.iter_mut().zip(mixture.forecast_all(&posteriors)) {
            input.mixture = forecast;
        }
        let least = TRIALS[usize::from(role != PoseRole::Rest)];
        let (open, sure): (Vec<&Input>, Vec<&Input>) =
            inputs.iter().partition(|i| branches(subject, &i.next).count_ones() > 1);
        let full = |i: &&Input| subject.pictures.labels[i.picture].observability == Observability::Full;
        let sure: Vec<&Input> = sure.into_iter().filter(full).collect();
        let open = trials(subject, probe, &open, least, true);
        let sure = trials(subject, probe, &sure, least, false);
        table.parts.insert(name.to_owned(), curves(subject, &open, &sure));
        let found = frequency_table(subject, &open);
        if !found.by_branch.is_empty() {
            of_parts.insert(name.to_owned(), found);
        }
    }
    on_progress(&Progress { stage: "recall", done: ROLES.len(), total: ROLES.len(), line: String::new() });
    let none = || "no picture leaves more than one branch open".to_owned();
    Ok((table, if of_parts.is_empty() { Err(none()) } else { Ok(of_parts) }))
}

/// The branches of states, as bits.
fn branches(subject: &Subject, states: &[usize]) -> u64 {
    states.iter().fold(0, |bits, s| bits | 1 << (s / subject.manifest.scenario.timestamps.max(1)))
}

/// All pictures of one part of the poses that have a next step, each with fresh sensor noise.
fn inputs(subject: &Subject, role: PoseRole) -> Vec<Input> {
    let pictures = &subject.pictures;
    let mut inputs = Vec::new();
    for picture in pictures.with_roles(&[role]) {
        let label = pictures.labels[picture];
        if pictures.next_state(label.state) == label.state {
            continue;
        }
        let now = pictures.alike(label.view, label.state);
        let mut next: Vec<usize> = now.iter().map(|&s| pictures.next_state(s)).collect();
        next.sort_unstable();
        next.dedup();
        let posterior = subject.encoder.encode(&subject.noisy_input(picture));
        let mixture = Mixture { weights: Vec::new(), components: Vec::new() };
        inputs.extend(posterior.into_iter().map(|posterior| Input {
            picture,
            posterior,
            mixture: mixture.clone(),
            next: next.clone(),
            now: now.clone(),
        }));
    }
    inputs
}

/// Draws and probes for each input, as often as it takes to make `least` trials.
fn trials<'a>(
    subject: &Subject,
    probe: &FieldProbe,
    inputs: &[&'a Input],
    least: usize,
    with_stratified: bool,
) -> Vec<Trial<'a>> {
    let repeats = least.div_ceil(inputs.len().max(1)).clamp(1, MOST_REPEATS);
    let all: Vec<(&Input, u64)> =
        inputs.iter().flat_map(|&i| (0..repeats).map(move |r| (i, (i.picture * MOST_REPEATS + r) as u64))).collect();
    let seed = subject.options.seed;
    let run = |probe: &mut FieldProbe, (input, frame): (&'a Input, u64)| {
        let mut show = |latents: &[[f32; LATENT_DIM]]| -> Vec<Shown> {
            probe.probe_all(latents).iter().map(|p| Shown::of(&p.reading)).collect()
        };
        let draw = |n, sampling| input.mixture.draw(n, sampling, seed, frame, 1);
        let independent: Vec<_> = draw(MOST_SAMPLES, Sampling::Independent).into_iter().map(|d| d.latent).collect();
        let posterior: Vec<_> = (0..MOST_SAMPLES)
            .map(|sample| {
                let key = Key { seed, frame, step: 0x706f_7374, sample: sample as u32 };
                input.posterior.at(&carff_random::gaussians(key))
            })
            .collect();
        // Draw i of a component is one latent whatever n is: each is probed once.
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
    let pictures = &subject.pictures;
    let steps = subject.manifest.scenario.timestamps.max(1);
    let label = |t: &Trial| pictures.labels[t.input.picture];
    let looks_like_any = |t: &Trial, shown: Shown, states: &[usize]| {
        let view = label(t).view;
        shown.any(|s| states.iter().any(|&other| pictures.equivalence.same(view, s, other)))
    };
    let of = |trials: &[Trial], values: &dyn Fn(&Trial) -> Vec<f64>| -> Vec<TrialCurve> {
        trials.iter().map(|t| TrialCurve { picture: t.input.picture, values: values(t) }).collect()
    };
    let next_right =
        |t: &Trial| t.independent.iter().map(|s| looks_like_any(t, *s, &t.input.next)).collect::<Vec<bool>>();
    let true_branch = |t: &Trial| label(t).state / steps;
    let shows = |s: Shown, branch: usize| u64::from(s.any(|state| state / steps == branch));
    let of_set = |t: &Trial, met: &dyn Fn(&[Shown]) -> bool| t.stratified.iter().map(|s| f64::from(met(s))).collect();
    let shown_branches = |set: &[Shown]| branches(subject, &set.iter().flat_map(|s| s.states()).collect::<Vec<_>>());

    let recall = recall_curve(&of(open, &|t| met_all(t.independent.iter().map(|s| shows(*s, true_branch(t))), 1)));
    let shares: Vec<f64> = open
        .iter()
        .map(|t| {
            let of_branch = t.input.now.iter().filter(|s| **s / steps == true_branch(t)).count();
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
            let wanted = branches(subject, &t.input.next);
            of_set(t, &|set| shown_branches(set) & wanted == wanted)
        })),
        posterior_recall: recall_curve(&of(open, &|t| {
            met_all(t.posterior.iter().map(|s| shows(*s, true_branch(t))), 1)
        })),
    }
}

/// What most samples show; of equally frequent answers the one that came first.
fn most_shown(samples: &[Shown]) -> Shown {
    let count = |s: &Shown| samples.iter().filter(|other| *other == s).count();
    samples.iter().rev().max_by_key(|s| count(s)).copied().unwrap_or(Shown::NOTHING)
}

fn frequency_table(subject: &Subject, open: &[Trial]) -> FrequencyTable {
    let scenario = &subject.manifest.scenario;
    let steps = scenario.timestamps.max(1);
    let infos = &subject.pictures.scenario.states;
    let present = |state: usize| infos.get(state).is_some_and(|s| s.boxes.iter().any(|b| b.dynamic));
    let count = |outcomes: usize, outcome: &dyn Fn(usize) -> usize| -> Vec<OpenInput> {
        let mut by_picture = BTreeMap::<usize, OpenInput>::new();
        for trial in open {
            let input = by_picture.entry(trial.input.picture).or_insert_with(|| {
                let mut expected = vec![0.0; outcomes];
                for &state in &trial.input.now {
                    let next = subject.pictures.next_state(state);
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
        by_picture.into_values().collect()
    };
    let presence = ["somebody there", "nobody there"].map(str::to_owned);
    FrequencyTable {
        by_branch: frequencies(&count(scenario.branches.len(), &|s| s / steps), &scenario.branches),
        by_presence: if scenario.branches.len() > 2 {
            frequencies(&count(2, &|s| usize::from(!present(s))), &presence)
        } else {
            Vec::new()
        },
    }
}

/// Draws `recall.png`.
pub fn draw(table: &ForecastTable, out: &Path) -> Result<(), ResultsError> {
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
    for (name, curves) in ["trained", "unseen"].into_iter().filter_map(|name| table.parts.get_key_value(name)) {
        let panel = |title: String, y_label: &str, series: Vec<Series>| Panel {
            title,
            x_label: "samples n".into(),
            y_label: y_label.into(),
            series: series.into_iter().filter(|s| !s.points.is_empty()).collect(),
            ..Panel::default()
        };
        panels.push(panel(
            format!("Accuracy, {name} poses, band: 80 % of the pictures"),
            "right samples, %",
            vec![
                line("forecast of the next step", &curves.accuracy),
                line("posterior alone, own step", &curves.posterior_accuracy),
                Series { band: Vec::new(), ..line("forecast, what most samples show", &curves.majority_accuracy) },
            ],
        ));
        panels.push(panel(
            format!("Recall, {name} poses, bands: 95 %"),
            "trials that show what came, %",
            vec![
                line("independent draws", &curves.recall),
                Series {
                    name: "expected of them".into(),
                    points: points(&curves.expected_recall),
                    band: band(&curves.expected_band),
                    ..Series::default()
                },
                line("stratified draws", &curves.stratified_recall),
                line("posterior alone, own step", &curves.posterior_recall),
            ],
        ));
    }
    Ok(carff_plots::curves(&out.join("recall.png"), "Accuracy and recall against the number of samples", &panels)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What most samples show wins; of equals the first; without samples nothing is shown.
    #[test]
    fn the_most_shown_wins() {
        let shown = |s: usize| Shown::from_states([s]);
        assert_eq!(most_shown(&[shown(1), shown(2), shown(2)]), shown(2));
        assert_eq!(most_shown(&[shown(3), shown(1), shown(1), shown(3)]), shown(3));
        assert_eq!(most_shown(&[]), Shown::NOTHING);
    }
}
