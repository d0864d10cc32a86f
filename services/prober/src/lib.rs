//! The prober stage's arithmetic: from a forecast, and the comparison of its image, to a belief over the known states.

mod frames;
mod grid;
mod images;
mod outlook;

pub use frames::Frames;
pub use grid::Grid;
pub use images::Images;
pub use outlook::Outlook;

use carff_checkpoint::{CheckpointPlanning, FieldProbe, Manifest, load_field_probe};
use carff_decision::{Feedback, ImageEvidence, mixture_and_draws};
use carff_messages::{Belief, Forecast};
use std::path::Path;

/// Loads the field and its calibration with the grid of the known states, and probes each known state once, so that the
/// first forecast is as fast as later ones.
pub fn load(checkpoint: &Path) -> anyhow::Result<(FieldProbe, Grid)> {
    let manifest = Manifest::load(checkpoint)?;
    let mut probe = load_field_probe(checkpoint, &manifest)?;
    for state in &manifest.states {
        probe.probe(&state.mean);
    }
    let grid = Grid::probe(&probe, CheckpointPlanning::load(checkpoint)?.occupancy);
    Ok((probe, grid))
}

/// Probes the mixture and the samples of a valid forecast. `image` is the evidence of the frame's image, if it was
/// compared; `feedback` is the input of the next step.
pub fn believe(
    probe: &mut FieldProbe,
    forecast: &Forecast,
    image: Option<&ImageEvidence>,
    feedback: Feedback,
) -> Belief {
    let (mixture, draws) = mixture_and_draws(forecast);
    let step = probe.step(mixture, draws, forecast.path_probability, image);
    step.to_belief(forecast, probe.layout(), probe.state_posterior(step.resolved.state), feedback)
}
