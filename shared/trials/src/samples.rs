//! State accuracy of probed samples of the next step.

use carff_checkpoint::{FieldProbe, Forecasts};
use carff_dataset::{Equivalence, ScenarioInfo};
use carff_decision::Sampling;
use carff_messages::Gaussian;
use serde::{Deserialize, Serialize};

/// Counts over all samples of all views of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SampleAccuracy {
    /// Samples whose state looks the same, from the input's view, as the true next state.
    pub right: usize,
    /// Samples whose state looks the same, from the input's view, as a possible next state: one that follows any state
    /// that looks like the input's. Where two next states are possible, at most half of the samples can be right, and
    /// all can be possible.
    pub possible: usize,
    /// Samples with exactly the true next state.
    pub right_by_name: usize,
    /// Samples that match no known state.
    pub unknown: usize,
    /// Samples.
    pub samples: usize,
    /// Input views.
    pub views: usize,
}

impl SampleAccuracy {
    /// Share of correct samples up to visual equivalence, 0..=1; 0 for no samples.
    pub fn accuracy(&self) -> f64 {
        self.share(self.right)
    }

    /// Share of samples that show a possible next state, 0..=1; 0 for no samples.
    pub fn possible_share(&self) -> f64 {
        self.share(self.possible)
    }

    fn share(&self, count: usize) -> f64 {
        if self.samples == 0 { 0.0 } else { count as f64 / self.samples as f64 }
    }
}

/// One input view and its posterior.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleInput {
    /// State that it shows.
    pub state: usize,
    /// Camera pose.
    pub view: usize,
    /// The posterior.
    pub posterior: Gaussian,
    /// Names the random draws.
    pub frame: u64,
}

/// Forecast and dataset behind a table of probed samples.
#[derive(Clone, Copy)]
pub struct SampleTrials<'a> {
    /// Posterior to mixture.
    pub net: &'a dyn Forecasts,
    /// Scenario of the inputs.
    pub scenario: &'a ScenarioInfo,
    /// Visual equivalence of its states.
    pub equivalence: &'a Equivalence,
    /// Samples of each input.
    pub samples: usize,
    /// Seed of the draws.
    pub seed: u64,
}

impl SampleTrials<'_> {
    /// Accuracy of probed samples from each input whose state has a next one.
    pub fn accuracy(&self, probe: &mut FieldProbe, inputs: &[SampleInput]) -> SampleAccuracy {
        let mut table = SampleAccuracy::default();
        for input in inputs {
            let true_next = self.scenario.next_state(input.state);
            if true_next == input.state {
                continue;
            }
            table.views += 1;
            let possible = possible_next_states(self.scenario, self.equivalence, input.state, input.view);
            let mixture = self.net.forecast(&input.posterior);
            for draw in mixture.draw(self.samples, Sampling::Stratified, self.seed, input.frame, 1) {
                let named = probe.probe(&draw.latent).reading.state;
                let looks_like = |state: usize| named.is_some_and(|s| self.equivalence.same(input.view, s, state));
                table.samples += 1;
                table.unknown += usize::from(named.is_none());
                table.right_by_name += usize::from(named == Some(true_next));
                table.right += usize::from(looks_like(true_next));
                table.possible += usize::from(possible.iter().any(|&state| looks_like(state)));
            }
        }
        table
    }
}

/// Next states of all states that look the same as `state` from a view.
fn possible_next_states(scenario: &ScenarioInfo, equivalence: &Equivalence, state: usize, view: usize) -> Vec<usize> {
    equivalence.alike(view, state).map(|other| scenario.next_state(other)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_dataset::Image;

    /// The possible next states follow every equivalent state; a last state follows itself.
    #[test]
    fn all_equivalent_states_may_continue() {
        // Two branches of two steps; their first steps look the same.
        let shades = [0, 50, 0, 100].map(|v| Image::filled(4, 4, [v; 3]));
        let equivalence = Equivalence::of_images(4, &[shades.iter().map(Some).collect()]);
        let scenario = ScenarioInfo {
            name: "test".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["one".into(), "other".into()],
            timestamps: 2,
            step_s: None,
            bev_view: None,
            states: Vec::new(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        assert_eq!(possible_next_states(&scenario, &equivalence, 0, 0), [1, 3]);
        assert_eq!(possible_next_states(&scenario, &equivalence, 1, 0), [1]);
    }
}
