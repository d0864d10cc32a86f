//! The prober stage's arithmetic: from a forecast to a belief over the known states.

use carff_checkpoint::{FieldProbe, Manifest, load_field_probe};
use carff_decision::mixture_and_draws;
use carff_messages::{Belief, Forecast};
use std::path::Path;

/// Loads the field and its calibration, and probes each known state once, so that the first forecast is as fast as
/// later ones.
pub fn load(checkpoint: &Path) -> anyhow::Result<FieldProbe> {
    let manifest = Manifest::load(checkpoint)?;
    let mut probe = load_field_probe(checkpoint, &manifest)?;
    for state in &manifest.states {
        probe.probe(&state.mean);
    }
    Ok(probe)
}

/// Probes the mixture and the samples of a valid forecast.
pub fn believe(probe: &mut FieldProbe, forecast: &Forecast) -> Belief {
    let (mixture, draws) = mixture_and_draws(forecast);
    let step = probe.step(mixture, draws, forecast.path_probability);
    step.to_belief(forecast, probe.layout(), probe.state_posterior(step.resolved.state))
}
