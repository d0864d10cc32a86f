//! Do the probed samples name the state that comes next?

use carff_checkpoint::FieldProbe;
use carff_dataset::Equivalence;
use carff_decision::Sampling;
use carff_messages::Gaussian;
use carff_models::mixture::MixtureNet;
use serde::{Deserialize, Serialize};

/// Shares over all samples of all views of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SampleAccuracy {
    /// Samples whose named state looks the same, in the input's view, as the true next one.
    pub right: usize,
    /// Samples whose named state looks the same, in the input's view, as one that may come next: the input may be from
    /// any state that looks like its own. Where two next states are open, half of the samples at most are right, and all
    /// can be possible.
    #[serde(default)]
    pub possible: usize,
    /// Samples that name the true next state itself.
    pub right_by_name: usize,
    /// Samples that name none of the known states.
    pub unknown: usize,
    /// Samples.
    pub samples: usize,
    /// Input views.
    pub views: usize,
}

impl SampleAccuracy {
    /// Share of right samples up to visual equivalence, 0..=1; 0 for none.
    pub fn accuracy(&self) -> f64 {
        self.share(self.right)
    }

    /// Share of samples that may come next, 0..=1; 0 for none.
    pub fn possible_share(&self) -> f64 {
        self.share(self.possible)
    }

    fn share(&self, count: usize) -> f64 {
        if self.samples == 0 { 0.0 } else { count as f64 / self.samples as f64 }
    }
}

/// One input view: where it is from, and what the encoder made of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Input {
    /// State it shows.
    pub state: usize,
    /// Pose.
    pub view: usize,
    /// The posterior.
    pub posterior: Gaussian,
    /// Names the random draws.
    pub frame: u64,
}

/// Accuracy of `count` probed samples from each input whose state has a next one.
pub fn sample_accuracy(
    net: &MixtureNet,
    probe: &mut FieldProbe,
    inputs: &[Input],
    timestamps: usize,
    equivalence: &Equivalence,
    count: usize,
    seed: u64,
) -> SampleAccuracy {
    let mut table = SampleAccuracy::default();
    for input in inputs {
        if (input.state + 1).is_multiple_of(timestamps) {
            continue;
        }
        table.views += 1;
        let next = next_states(input.state, input.view, timestamps, equivalence);
        let mixture = net.forecast(&input.posterior);
        for draw in mixture.draw(count, Sampling::Stratified, seed, input.frame, 1) {
            let named = probe.probe(&draw.latent).reading.state;
            table.samples += 1;
            table.unknown += usize::from(named.is_none());
            table.right_by_name += usize::from(named == Some(input.state + 1));
            table.right += usize::from(named.is_some_and(|s| equivalence.same(input.view, s, input.state + 1)));
            table.possible +=
                usize::from(named.is_some_and(|s| next.iter().any(|&n| equivalence.same(input.view, s, n))));
        }
    }
    table
}

/// The states that may follow what is seen from a view: those after each state that looks like it there. The last of a
/// branch follows itself.
fn next_states(state: usize, view: usize, timestamps: usize, equivalence: &Equivalence) -> Vec<usize> {
    equivalence
        .alike(view, state)
        .map(|other| if (other + 1).is_multiple_of(timestamps) { other } else { other + 1 })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_dataset::Image;

    /// What may come next follows every state that looks like the input's; a last state follows itself.
    #[test]
    fn all_that_looks_alike_may_go_on() {
        // Two branches of two steps; their first steps look the same.
        let shades = [0, 50, 0, 100].map(|v| Image::filled(4, 4, [v; 3]));
        let equivalence = Equivalence::of_pictures(4, &[shades.iter().map(Some).collect()]);
        assert_eq!(next_states(0, 0, 2, &equivalence), [1, 3]);
        assert_eq!(next_states(1, 0, 2, &equivalence), [1]);
    }
}
