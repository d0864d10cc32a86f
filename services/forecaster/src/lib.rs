//! The forecaster stage's arithmetic: from a posterior, observed or fed back, to a mixture and its samples.

mod history;

use carff_checkpoint::{CheckpointPlanning, Manifest};
use carff_config::GraphConfig;
use carff_decision::{
    Draw, ImageEvidence, Memory, Mixture, ProbeLayout, Remembered, Sampling, TakeMemory, continue_samples,
    path_probability, set_mixture_and_draws,
};
use carff_inference::MixtureNet;
use carff_messages::{Belief, Forecast, ForecastSource, Gaussian, Header, MAX_STATES, Posterior, Unknowns};
use history::TakeHistory;
use std::path::Path;

/// The forecaster's model and settings.
#[derive(Debug)]
pub struct Forecaster {
    net: MixtureNet,
    layout: ProbeLayout,
    samples: usize,
    sampling: Sampling,
    horizon: u32,
    /// Belief over the frames of a take; `None` if each image counts by itself.
    memory: Option<TakeHistory>,
    /// Content of the memory at the last image.
    remembered: Option<Remembered>,
}

impl Forecaster {
    /// Loads the mixture density network, and the memory where the graph file asks for it and the checkpoint has learned
    /// it.
    pub fn load(checkpoint: &Path, graph: &GraphConfig) -> anyhow::Result<Self> {
        let manifest = Manifest::load(checkpoint)?;
        let net = MixtureNet::load(checkpoint, &manifest)?;
        let layout = ProbeLayout::new(manifest.places.clone(), manifest.scenario.hazard_states())?;
        let run = &graph.run;
        let learned = if graph.remembers() { CheckpointPlanning::load(checkpoint)?.memory } else { None };
        let memory = learned.zip(graph.step_length(manifest.step_s)).map(|(learned, step)| {
            let forecast = |state: &Gaussian| net.forecast(state);
            let memory = Memory::new(&layout, manifest.states.clone(), forecast, learned.settings);
            TakeHistory::new(TakeMemory::new(memory, step))
        });
        Ok(Self {
            net,
            layout,
            samples: run.samples as usize,
            sampling: run.sampling,
            horizon: run.horizon,
            memory,
            remembered: None,
        })
    }

    /// Sets the number of samples from now on, and the horizon of frames that start from now on.
    pub fn set_quality(&mut self, samples: usize, horizon: u32) {
        (self.samples, self.horizon) = (samples, horizon);
    }

    /// Takes the comparison of an image, which the memory counts for later images.
    pub fn compare(&mut self, unknowns: &Unknowns) {
        if let Some(memory) = &mut self.memory {
            memory.compare(unknowns.header.frame_id, ImageEvidence::from(unknowns).places().to_vec());
        }
    }

    /// Takes an image into the memory. Called for each posterior in order, also for those that are too old for a
    /// forecast: a restarted forecaster gets the last ones from shared memory.
    pub fn remember(&mut self, posterior: &Posterior) {
        let Some(memory) = &mut self.memory else { return };
        let remembered = memory.see(posterior.into(), self.net.forecast(&posterior.gaussian));
        if remembered.images == 1 {
            tracing::debug!(take_start = posterior.take_start, "the memory starts anew");
        }
        self.remembered = Some(remembered);
    }

    /// Returns the forecast from the last remembered posterior: step 1.
    pub fn from_observation(&self, posterior: &Posterior) -> Forecast {
        let mut forecast = Forecast::empty(posterior.header.at_step(1), ForecastSource::Observed, self.horizon);
        forecast.encoder_ns = posterior.stage_latency_ns;
        self.set_states(&mut forecast);
        match &self.remembered {
            Some(Remembered { forecast: mixture, images, .. }) => {
                forecast.images = *images;
                self.fill(&mut forecast, mixture);
            }
            None => self.fill(&mut forecast, &self.net.forecast(&posterior.gaussian)),
        }
        forecast
    }

    /// Returns the forecast from what a belief feeds back, its samples or its resolved state: the next step. `None` if the
    /// belief was the frame's last.
    pub fn from_feedback(&self, belief: &Belief) -> Option<Forecast> {
        if belief.is_final() || belief.header.step >= belief.horizon {
            return None;
        }
        let header: Header = belief.header.at_step(belief.header.step + 1);
        let mut forecast = Forecast::empty(header, ForecastSource::Probed, belief.horizon);
        forecast.encoder_ns = belief.encoder_ns;
        self.set_states(&mut forecast);
        if belief.fed_back().is_empty() {
            let state = usize::try_from(belief.resolved_state).ok()?;
            forecast.resolved_state = belief.resolved_state;
            forecast.path_probability =
                path_probability(belief.path_probability, &self.layout, &belief.state_probability, state);
            self.fill(&mut forecast, &self.net.forecast(&belief.resolved));
        } else {
            forecast.path_probability = belief.path_probability;
            let (mixture, draws) = self.continued(belief.fed_back(), header);
            set_mixture_and_draws(&mut forecast, &mixture, &draws);
        }
        Some(forecast)
    }

    fn continued(&self, inputs: &[Gaussian], header: Header) -> (Mixture, Vec<Draw>) {
        let forecasts: Vec<Mixture> = inputs.iter().map(|input| self.net.forecast(input)).collect();
        let Header { seed, frame_id, step, .. } = header;
        continue_samples(&forecasts, self.samples, self.sampling, seed, frame_id, step)
    }

    /// Sets the weights of the present states, which all steps of the frame share.
    fn set_states(&self, forecast: &mut Forecast) {
        let frame = forecast.header.frame_id;
        if let Some(Remembered { states, .. }) = self.remembered.as_ref().filter(|last| last.frame == frame) {
            forecast.state_count = states.weights.len().min(MAX_STATES) as u32;
            forecast.hazard_by_places = states.hazard_by_places;
            forecast.state_weights.iter_mut().zip(&states.weights).for_each(|(to, weight)| *to = *weight);
        }
    }

    fn fill(&self, forecast: &mut Forecast, mixture: &Mixture) {
        let Header { seed, frame_id, step, .. } = forecast.header;
        let draws = mixture.draw(self.samples, self.sampling, seed, frame_id, step);
        set_mixture_and_draws(forecast, mixture, &draws);
    }
}
