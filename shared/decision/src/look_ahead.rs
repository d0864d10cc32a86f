//! One step of the belief, and the autoregressive loop over steps (paper section 3.2).

use crate::{
    Draw, Feedback, ForecastInput, ImageEvidence, Mixture, ProbeCalibration, ProbeLayout, Reading, Resolved, Sampling,
    continue_samples, resolve,
};
use carff_messages::{Gaussian, LATENT_DIM};

/// Finds out which places of a scenario are taken in the scenes of latents (paper section 3.2: by the density of the
/// field, or by segmentation of rendered views).
pub trait Localiser {
    /// Writes the occupancy (0..=1) of each place of the layout for each latent: `latents.len()` rows of one value a
    /// place.
    fn occupancies(&mut self, layout: &ProbeLayout, latents: &[[f32; LATENT_DIM]], occupancies: &mut [f32]);
}

/// Probes latents: finds out which places of a scenario are taken, and reads which known state that is.
#[derive(Clone, Debug)]
pub struct SceneProbe<L> {
    localiser: L,
    layout: ProbeLayout,
    calibration: ProbeCalibration,
    states: Vec<Gaussian>,
    occupancies: Vec<f32>,
}

/// One probed latent.
#[derive(Clone, Debug, PartialEq)]
pub struct Probed {
    /// Occupancy of each place, 0..=1.
    pub occupancies: Vec<f32>,
    /// The state that the occupancies show.
    pub reading: Reading,
}

/// One step of the belief.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// The mixture over the next latent.
    pub mixture: Mixture,
    /// The latents drawn from it.
    pub draws: Vec<Draw>,
    /// The component means, probed.
    pub components: Vec<Probed>,
    /// The draws, probed.
    pub samples: Vec<Probed>,
    /// The belief over the known states.
    pub resolved: Resolved,
    /// Probability of the path followed up to this step's input, 0..=1; 1 at the first step.
    pub path_probability: f32,
}

impl<L: Localiser> SceneProbe<L> {
    /// Puts the parts together; `states` are the posteriors that represent the known states.
    pub fn new(localiser: L, layout: ProbeLayout, calibration: ProbeCalibration, states: Vec<Gaussian>) -> Self {
        Self { localiser, layout, calibration, states, occupancies: Vec::new() }
    }

    /// The places and states.
    pub fn layout(&self) -> &ProbeLayout {
        &self.layout
    }

    /// The method that finds out which places are taken: for density probing, the field.
    pub fn field(&self) -> &L {
        &self.localiser
    }

    /// The posteriors that represent the known states.
    pub fn states(&self) -> &[Gaussian] {
        &self.states
    }

    /// The posterior that represents a known state.
    pub fn state_posterior(&self, state: usize) -> Option<&Gaussian> {
        self.states.get(state)
    }

    /// Probes one latent.
    pub fn probe(&mut self, latent: &[f32; LATENT_DIM]) -> Probed {
        self.probe_all(std::slice::from_ref(latent)).remove(0)
    }

    /// Probes latents, one result each.
    pub fn probe_all(&mut self, latents: &[[f32; LATENT_DIM]]) -> Vec<Probed> {
        let places = self.layout.places().len().max(1);
        self.occupancies.resize(places * latents.len(), 0.0);
        self.localiser.occupancies(&self.layout, latents, &mut self.occupancies);
        let read = |occupancies: &[f32]| {
            let reading = self.calibration.read(&self.layout, occupancies);
            Probed { occupancies: occupancies.to_vec(), reading }
        };
        self.occupancies.chunks_exact(places).map(read).collect()
    }

    /// Probes a mixture's component means and draws, and resolves the state; `image` weighs the result, if the frame's
    /// image was compared with the known states.
    pub fn step(
        &mut self,
        mixture: Mixture,
        draws: Vec<Draw>,
        path_probability: f32,
        image: Option<&ImageEvidence>,
    ) -> Step {
        let latents: Vec<[f32; LATENT_DIM]> =
            mixture.components.iter().map(|c| c.mean).chain(draws.iter().map(|d| d.latent)).collect();
        let mut components = self.probe_all(&latents);
        let samples = components.split_off(mixture.components.len());
        let readings = |probed: &[Probed]| probed.iter().map(|p| p.reading.clone()).collect::<Vec<_>>();
        let of: Vec<usize> = draws.iter().map(|d| d.component).collect();
        let mut resolved = resolve(&self.layout, &mixture.weights, &readings(&components), &readings(&samples), &of);
        if let Some(image) = image {
            resolved.weigh(&self.layout, image);
        }
        Step { mixture, draws, components, samples, resolved, path_probability }
    }
}

impl Step {
    /// Returns the samples as inputs of the next step: each latent, with the variance of the component that it was drawn
    /// from.
    pub fn fed_back(&self) -> Vec<Gaussian> {
        let input = |draw: &Draw| Gaussian {
            mean: draw.latent,
            log_variance: self.mixture.components[draw.component].log_variance,
        };
        self.draws.iter().map(input).collect()
    }
}

/// Returns the probability of the path that follows a state, from that of the path to its step, 0..=1. The path follows
/// the scene of the state, so states that probing cannot distinguish from it count too. `probabilities` has one entry a
/// state.
pub fn path_probability(before: f32, layout: &ProbeLayout, probabilities: &[f32], state: usize) -> f32 {
    let scene: f32 = layout.alike(state).iter().filter_map(|&alike| probabilities.get(alike)).sum();
    (before * scene).clamp(0.0, 1.0)
}

/// The depth and breadth of a look-ahead, and the names of its random streams.
///
/// ```
/// use carff_decision::{Feedback, Plan, Sampling};
/// let (sampling, feedback) = (Sampling::Stratified, Feedback::State);
/// let plan = Plan { samples: 10, sampling, feedback, horizon: 2, seed: 1, frame: 0 };
/// assert_eq!(plan.horizon, 2);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// Latents drawn at each step.
    pub samples: usize,
    /// The way in which they are spread over the components.
    pub sampling: Sampling,
    /// Input of each further step.
    pub feedback: Feedback,
    /// Number of steps.
    pub horizon: u32,
    /// The run's seed.
    pub seed: u64,
    /// The frame's number.
    pub frame: u64,
}

/// Looks ahead from one posterior: each step feeds the next. `forecast` receives the input and its origin; `image` weighs
/// every step, as in [`SceneProbe::step`].
pub fn look_ahead<L: Localiser>(
    mut forecast: impl FnMut(&Gaussian, ForecastInput) -> Mixture,
    probe: &mut SceneProbe<L>,
    posterior: &Gaussian,
    image: Option<&ImageEvidence>,
    plan: Plan,
) -> Vec<Step> {
    let Plan { samples, sampling, feedback, horizon, seed, frame } = plan;
    let drawn = |mixture: Mixture, step| {
        let draws = mixture.draw(samples, sampling, seed, frame, step);
        (mixture, draws)
    };
    let mut steps: Vec<Step> = Vec::with_capacity(horizon as usize);
    let mut next = Some((drawn(forecast(posterior, ForecastInput::Image), 1), 1.0)).filter(|_| horizon > 0);
    while let Some(((mixture, draws), path)) = next {
        let step = probe.step(mixture, draws, path, image);
        let number = steps.len() as u32 + 2;
        next = match feedback {
            _ if number > horizon => None,
            Feedback::State => {
                let state = step.resolved.state;
                let path = path_probability(path, &probe.layout, &step.resolved.state_probabilities, state);
                let input = probe.state_posterior(state);
                input.map(|input| (drawn(forecast(input, ForecastInput::State(state)), number), path))
            }
            Feedback::Latent => {
                let inputs = step.fed_back();
                let forecasts: Vec<Mixture> =
                    inputs.iter().map(|input| forecast(input, ForecastInput::Sample)).collect();
                Some((continue_samples(&forecasts, samples, sampling, seed, frame, number), path))
            }
        };
        steps.push(step);
    }
    steps
}
