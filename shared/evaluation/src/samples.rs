//! Do the probed samples name the state that comes next?

use carff_belief::Probe;
use carff_dataset::Equivalence;
use carff_models::{
    LatentGaussian,
    mixture::{MixtureNet, Sampling},
};
use serde::{Deserialize, Serialize};

/// Shares over all samples of all views of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SampleAccuracy {
    /// Samples whose named state looks the same, in the input's view, as the true next one.
    pub right: usize,
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
        if self.samples == 0 { 0.0 } else { self.right as f64 / self.samples as f64 }
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
    pub posterior: LatentGaussian,
    /// Names the random draws.
    pub frame: u64,
}

/// Accuracy of `count` probed samples from each input whose state has a next one.
pub fn sample_accuracy(
    net: &MixtureNet,
    probe: &mut Probe,
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
        let mixture = net.forecast(&input.posterior);
        for draw in mixture.draw(count, Sampling::Stratified, seed, input.frame, 1) {
            let named = probe.probe(&draw.latent).reading.state;
            table.samples += 1;
            table.unknown += usize::from(named.is_none());
            table.right_by_name += usize::from(named == Some(input.state + 1));
            table.right += usize::from(named.is_some_and(|s| equivalence.same(input.view, s, input.state + 1)));
        }
    }
    table
}
