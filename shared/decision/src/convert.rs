//! Conversions between a step of the belief and the messages that carry it.

use crate::{Draw, Feedback, Look, Mixture, Motion, ProbeLayout, Probed, Reading, Resolved, Step};
use carff_messages::{
    Action, Belief, EgoMotion, Forecast, Gaussian, LATENT_DIM, LookGain, MAX_ABS_LATENT, MAX_COMPONENTS, MAX_PLACES,
    ProbeResult,
};

/// Returns the mixture and the draws of a valid forecast.
pub fn mixture_and_draws(forecast: &Forecast) -> (Mixture, Vec<Draw>) {
    let components = (forecast.component_count as usize).min(MAX_COMPONENTS);
    let mixture = Mixture {
        weights: forecast.weights[..components].to_vec(),
        components: forecast.components[..components].to_vec(),
    };
    let draws = forecast
        .samples()
        .iter()
        .zip(&forecast.sample_component)
        .map(|(latent, component)| Draw { latent: *latent, component: usize::from(*component) })
        .collect();
    (mixture, draws)
}

/// Writes a mixture and its draws into a forecast, with latents beyond [`MAX_ABS_LATENT`] set to it.
pub fn set_mixture_and_draws(forecast: &mut Forecast, mixture: &Mixture, draws: &[Draw]) {
    forecast.component_count = mixture.components.len() as u32;
    forecast.sample_count = draws.len() as u32;
    for (i, (weight, component)) in mixture.weights.iter().zip(&mixture.components).enumerate() {
        forecast.weights[i] = *weight;
        forecast.components[i] = Gaussian { mean: limited(component.mean), ..*component };
    }
    for (i, draw) in draws.iter().enumerate() {
        forecast.samples[i] = limited(draw.latent);
        forecast.sample_component[i] = draw.component as u8;
    }
}

/// Returns a latent that a message may carry.
fn limited(latent: [f32; LATENT_DIM]) -> [f32; LATENT_DIM] {
    latent.map(|v| v.clamp(-MAX_ABS_LATENT, MAX_ABS_LATENT))
}

impl From<&EgoMotion> for Motion {
    fn from(message: &EgoMotion) -> Self {
        let EgoMotion { speed_mps, to_conflict_m, through_conflict_m, along_conflict_m, .. } = *message;
        Self { speed_mps, to_conflict_m, through_conflict_m, along_conflict_m }
    }
}

impl From<&LookGain> for Look {
    fn from(message: &LookGain) -> Self {
        Self { gain_bits: message.gain_bits.into(), clear_m: message.clear_m.into() }
    }
}

/// The look that an action rests on.
impl From<&Action> for Look {
    fn from(message: &Action) -> Self {
        Self { gain_bits: message.look_gain_bits.into(), clear_m: message.clear_m.into() }
    }
}

impl Step {
    /// Returns the belief message of this step, which answers `forecast`. `posterior` represents the resolved state;
    /// where states are fed back, a belief without one is the frame's last.
    pub fn to_belief(
        &self,
        forecast: &Forecast,
        layout: &ProbeLayout,
        posterior: Option<&Gaussian>,
        feedback: Feedback,
    ) -> Belief {
        let mut belief = Belief::empty(forecast.header, forecast.horizon);
        belief.encoder_ns = forecast.encoder_ns;
        belief.forecaster_ns = forecast.stage_latency_ns;
        belief.state_count = layout.state_count() as u32;
        belief.place_count = layout.places().len() as u32;
        belief.component_count = self.components.len() as u32;
        belief.sample_count = self.samples.len() as u32;
        copy(&mut belief.state_probability, &self.resolved.state_probabilities, |p| *p);
        belief.unknown_probability = self.resolved.unknown_probability;
        belief.hazard_probability = self.resolved.hazard_probability;
        belief.path_probability = self.path_probability;
        copy(&mut belief.component_weights, &self.mixture.weights, |w| *w);
        copy(&mut belief.components, &self.components, |probed| probed.into());
        copy(&mut belief.samples, &self.samples, |probed| probed.into());
        copy(&mut belief.sample_component, &self.draws, |draw| draw.component as u8);
        if let Some(posterior) = posterior {
            belief.resolved_state = self.resolved.state as i32;
            belief.resolved = *posterior;
        }
        match feedback {
            Feedback::State if posterior.is_none() => belief.is_final = 1,
            Feedback::Latent if !belief.is_final() => {
                let inputs = self.fed_back();
                belief.fed_back_count = inputs.len() as u64;
                copy(&mut belief.fed_back, &inputs, |input| *input);
            }
            _ => {}
        }
        belief
    }

    /// Returns the step that a valid forecast and the belief that answers it describe. Messages only carry the best
    /// state of each sample, so that [`Reading::state_probabilities`] is empty. A belief that resolved no state has
    /// `usize::MAX` as its resolved state.
    pub fn of_messages(forecast: &Forecast, belief: &Belief) -> Self {
        let (mixture, draws) = mixture_and_draws(forecast);
        let places = (belief.place_count as usize).min(MAX_PLACES);
        let probed = |result: &ProbeResult| Probed::of_message(result, places);
        Self {
            mixture,
            draws,
            components: belief.components().iter().map(probed).collect(),
            samples: belief.samples().iter().map(probed).collect(),
            resolved: Resolved {
                state_probabilities: belief
                    .state_probability
                    .iter()
                    .take(belief.state_count as usize)
                    .copied()
                    .collect(),
                unknown_probability: belief.unknown_probability,
                hazard_probability: belief.hazard_probability,
                state: usize::try_from(belief.resolved_state).unwrap_or(usize::MAX),
            },
            path_probability: belief.path_probability,
        }
    }
}

/// Copies as many entries as fit.
fn copy<T, S>(to: &mut [T], from: &[S], convert: impl Fn(&S) -> T) {
    for (to, from) in to.iter_mut().zip(from) {
        *to = convert(from);
    }
}

impl From<&Probed> for ProbeResult {
    fn from(probed: &Probed) -> Self {
        let mut result = Self {
            state: probed.reading.state.map_or(-1, |s| s as i32),
            confidence: probed.reading.confidence.clamp(0.0, 1.0),
            hazard_likelihood: probed.reading.hazard_likelihood,
            ..Self::NONE
        };
        copy(&mut result.occupancies, &probed.occupancies, |o| *o);
        result
    }
}

impl Probed {
    fn of_message(result: &ProbeResult, places: usize) -> Self {
        Self {
            occupancies: result.occupancies[..places].to_vec(),
            reading: Reading {
                state: result.state(),
                confidence: result.confidence,
                hazard_likelihood: result.hazard_likelihood,
                state_probabilities: Vec::new(),
            },
        }
    }
}
