//! The prober stage's arithmetic: from a forecast to a belief over the known states.

use carff_belief::{Probe, Probed, Step};
use carff_checkpoint::Manifest;
use carff_latent::{Draw, LatentGaussian, Mixture};
use carff_messages::{Belief, Forecast, Gaussian, MAX_PLACES, ProbeResult};
use std::path::Path;

/// Loads the field and its calibration, and probes once.
pub fn load(checkpoint: &Path) -> anyhow::Result<Probe> {
    let manifest = Manifest::load(checkpoint)?;
    let mut probe = Probe::load(checkpoint, &manifest)?;
    for state in &manifest.states {
        probe.probe(&state.mean);
    }
    Ok(probe)
}

/// Probes the mixture and the samples of a forecast that has been validated.
pub fn believe(probe: &mut Probe, forecast: &Forecast) -> Belief {
    let components = forecast.component_count as usize;
    let gaussian = |g: &Gaussian| LatentGaussian { mean: g.mean, log_variance: g.log_variance };
    let mixture = Mixture {
        weights: forecast.weights[..components].to_vec(),
        components: forecast.components[..components].iter().map(gaussian).collect(),
    };
    let draws = forecast
        .samples()
        .iter()
        .zip(&forecast.sample_component)
        .map(|(latent, component)| Draw { latent: *latent, component: usize::from(*component) })
        .collect();
    let step = probe.step(mixture, draws, forecast.path_probability);
    let mut belief = Belief::empty(forecast.header, forecast.horizon);
    belief.encoder_ns = forecast.encoder_ns;
    belief.forecaster_ns = forecast.stage_latency_ns;
    fill(&mut belief, probe, &step);
    belief
}

fn fill(belief: &mut Belief, probe: &Probe, step: &Step) {
    belief.state_count = probe.prober().state_count() as u32;
    belief.place_count = probe.prober().places().len() as u32;
    belief.component_count = step.components.len() as u32;
    belief.sample_count = step.samples.len() as u32;
    for (to, from) in belief.state_probability.iter_mut().zip(&step.resolved.state_probabilities) {
        *to = *from;
    }
    belief.hazard_probability = step.resolved.hazard_probability;
    belief.path_probability = step.path_probability;
    for (i, weight) in step.mixture.weights.iter().enumerate() {
        belief.component_weights[i] = *weight;
    }
    for (to, from) in belief.components.iter_mut().zip(&step.components) {
        *to = result(from);
    }
    for (to, from) in belief.samples.iter_mut().zip(&step.samples) {
        *to = result(from);
    }
    for (to, from) in belief.sample_component.iter_mut().zip(&step.draws) {
        *to = from.component as u8;
    }
    match probe.state_posterior(step.resolved.state) {
        Some(posterior) => {
            belief.resolved_state = step.resolved.state as i32;
            belief.resolved = Gaussian { mean: posterior.mean, log_variance: posterior.log_variance };
        }
        // Nothing to look ahead from: this is the frame's last step.
        None => belief.is_final = 1,
    }
}

fn result(probed: &Probed) -> ProbeResult {
    let mut densities = [0.0; MAX_PLACES];
    for (to, from) in densities.iter_mut().zip(&probed.occupancies) {
        *to = *from;
    }
    ProbeResult {
        state: probed.reading.state.map_or(-1, |s| s as i32),
        confidence: probed.reading.confidence.clamp(0.0, 1.0),
        hazard_likelihood: probed.reading.hazard_likelihood,
        densities,
    }
}
