//! The forecaster stage's arithmetic: from a posterior, observed or fed back, to a mixture and its samples.

use carff_checkpoint::Manifest;
use carff_decision::{Sampling, path_probability, set_mixture_and_draws};
use carff_inference::MixtureNet;
use carff_messages::{Belief, Forecast, ForecastSource, Gaussian, Header, Posterior};
use std::path::Path;

/// The forecaster's model and settings.
#[derive(Debug)]
pub struct Forecaster {
    net: MixtureNet,
    samples: usize,
    sampling: Sampling,
    horizon: u32,
}

impl Forecaster {
    /// Loads the mixture density network.
    pub fn load(checkpoint: &Path, samples: usize, sampling: Sampling, horizon: u32) -> anyhow::Result<Self> {
        let manifest = Manifest::load(checkpoint)?;
        Ok(Self { net: MixtureNet::load(checkpoint, &manifest)?, samples, sampling, horizon })
    }

    /// Sets the number of samples from now on, and the horizon of frames that start from now on.
    pub fn set_quality(&mut self, samples: usize, horizon: u32) {
        (self.samples, self.horizon) = (samples, horizon);
    }

    /// Returns the forecast from an observed posterior: step 1.
    pub fn from_observation(&self, posterior: &Posterior) -> Forecast {
        let mut forecast = Forecast::empty(posterior.header.at_step(1), ForecastSource::Observed, self.horizon);
        forecast.encoder_ns = posterior.stage_latency_ns;
        self.fill(&mut forecast, &posterior.gaussian);
        forecast
    }

    /// Returns the forecast from a belief's resolved state: the next step. `None` if the belief was the frame's last.
    pub fn from_feedback(&self, belief: &Belief) -> Option<Forecast> {
        if belief.is_final() || belief.header.step >= belief.horizon {
            return None;
        }
        let state = usize::try_from(belief.resolved_state).ok()?;
        let header: Header = belief.header.at_step(belief.header.step + 1);
        let mut forecast = Forecast::empty(header, ForecastSource::Probed, belief.horizon);
        forecast.encoder_ns = belief.encoder_ns;
        forecast.resolved_state = belief.resolved_state;
        forecast.path_probability = path_probability(belief.path_probability, belief.state_probability[state]);
        self.fill(&mut forecast, &belief.resolved);
        Some(forecast)
    }

    fn fill(&self, forecast: &mut Forecast, input: &Gaussian) {
        let mixture = self.net.forecast(input);
        let Header { seed, frame_id, step, .. } = forecast.header;
        let draws = mixture.draw(self.samples, self.sampling, seed, frame_id, step);
        set_mixture_and_draws(forecast, &mixture, &draws);
    }
}
