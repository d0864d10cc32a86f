//! Localisation by density probing and by segmentation of rendered views (paper section 3.2), on the same samples.

use crate::segmentation::{SegmentedField, Segmenter, occupants, view_camera};
use crate::{ByRole, Progress, ROLES, Subject, role_name};
use carff_decision::{Localiser, Sampling, SceneProbe};
use carff_messages::LATENT_DIM;
use carff_trials::SAMPLES;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Figures of both methods on the poses of each role.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalisationTable {
    /// Rendered views that the segmentation network was trained on.
    pub trained_views: usize,
    /// Figures of each role.
    pub parts: ByRole<LocalisationFigures>,
}

/// Both methods on the samples of the next step's forecast.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalisationFigures {
    /// Images.
    pub images: usize,
    /// Samples.
    pub samples: usize,
    /// Samples for which both methods name the same state, or both name none.
    pub agree: usize,
    /// Density probing.
    pub density: MethodFigures,
    /// Segmentation of the view from above.
    pub segmentation: MethodFigures,
}

/// One method on these samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MethodFigures {
    /// Samples that show a possible next state.
    pub possible: usize,
    /// Samples that show no known state.
    pub unknown: usize,
    /// Samples whose state is possible by the other method, and not by this one.
    pub only_this_fails: usize,
    /// Time for a sample on one thread, milliseconds.
    pub ms_per_sample: f64,
}

/// Computes the table, or returns the reason why there is none.
pub fn localisation(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<LocalisationTable, String> {
    let planner = subject.planner(Sampling::Stratified)?;
    let layout = planner.probe.layout().clone();
    let (camera, seed) = (view_camera(&subject.posed.dataset, planner.probe.field()), subject.options.seed);
    let size_px = [camera.width_px, camera.height_px];
    let network = Segmenter::fit(&subject.masked_views, occupants(&layout).len() + 1, size_px, seed)
        .ok_or("there are no views with masks: the dataset has no scenario file")?;
    let field: &carff_field::Field = planner.probe.field();
    let mut segmentation = SegmentedField::new(field.clone(), camera, network, &layout, 1)
        .into_probe(layout, planner.probe.states().to_vec(), seed)
        .ok_or("the known states have no places")?;
    let mut density = planner.probe.clone();
    let mut table = LocalisationTable { trained_views: subject.masked_views.len(), parts: ByRole::default() };
    let (posed, scenario) = (&subject.posed, &subject.posed.scenario);
    for (done, role) in ROLES.into_iter().enumerate() {
        let line = format!("{} poses", role_name(role));
        on_progress(&Progress { phase: "localisation", done, total: ROLES.len(), line });
        let mut figures = LocalisationFigures::default();
        let mut took_s = [0.0; 2];
        for image in posed.with_roles(&[role]) {
            let label = posed.labels[image];
            if scenario.next_state(label.state) == label.state {
                continue;
            }
            let now = posed.equivalent_states(label.view, label.state);
            let next: Vec<usize> = now.iter().map(|&state| scenario.next_state(state)).collect();
            let forecast = planner.net.forecast(&subject.posteriors[image]);
            let draws = forecast.draw(SAMPLES, Sampling::Stratified, seed, image as u64, 1);
            let latents: Vec<[f32; LATENT_DIM]> = draws.iter().map(|draw| draw.latent).collect();
            let shown =
                [states(&mut density, &latents, &mut took_s[0]), states(&mut segmentation, &latents, &mut took_s[1])];
            // A state that looks the same as a possible one from the input's view is possible too.
            let possible = |state: Option<usize>| {
                state.is_some_and(|state| posed.equivalent_states(label.view, state).iter().any(|s| next.contains(s)))
            };
            figures.images += 1;
            figures.samples += latents.len();
            for (by_density, by_segmentation) in shown[0].iter().copied().zip(shown[1].iter().copied()) {
                figures.agree += usize::from(by_density == by_segmentation);
                let right = [by_density, by_segmentation].map(possible);
                figures.density.add(by_density, right[0], right[1]);
                figures.segmentation.add(by_segmentation, right[1], right[0]);
            }
        }
        if figures.samples > 0 {
            let ms = took_s.map(|s: f64| 1e3 * s / figures.samples as f64);
            (figures.density.ms_per_sample, figures.segmentation.ms_per_sample) = (ms[0], ms[1]);
            table.parts.set(role, figures);
        }
    }
    Ok(table)
}

/// States of latents by one method; adds the time that it took.
fn states<L: Localiser>(
    probe: &mut SceneProbe<L>,
    latents: &[[f32; LATENT_DIM]],
    took_s: &mut f64,
) -> Vec<Option<usize>> {
    let started = Instant::now();
    let probed = probe.probe_all(latents);
    *took_s += started.elapsed().as_secs_f64();
    probed.into_iter().map(|probed| probed.reading.state).collect()
}

impl MethodFigures {
    fn add(&mut self, state: Option<usize>, possible: bool, possible_by_other: bool) {
        self.possible += usize::from(possible);
        self.unknown += usize::from(state.is_none());
        self.only_this_fails += usize::from(!possible && possible_by_other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sample is a failure of a method only where the other one names a possible state.
    #[test]
    fn failures_are_against_the_other_method() {
        let mut figures = MethodFigures::default();
        figures.add(Some(1), true, false);
        figures.add(None, false, true);
        figures.add(Some(2), false, false);
        let expected = MethodFigures { possible: 1, unknown: 1, only_this_fails: 1, ms_per_sample: 0.0 };
        assert_eq!(figures, expected);
    }
}
