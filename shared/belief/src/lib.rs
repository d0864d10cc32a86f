//! The belief's arithmetic: draw, probe, resolve, look further ahead.
//!
//! The forecaster and the prober stages compute with this, and so does every evaluation: what a report says of a belief
//! is what the running graph would have published, bit for bit.

use carff_checkpoint::{CheckpointError, Manifest};
use carff_field::{Field, PreparedPoints};
use carff_latent::{Draw, LATENT_DIM, LatentGaussian, Mixture, Sampling};
use carff_planning::{Decision, Evidence, Rule, decide};
use carff_probing::{Calibration, Prober, Reading, Resolved, resolve};
use std::path::Path;

/// Probes hypotheses for what stands in them.
#[derive(Clone, Debug)]
pub struct Probe {
    field: Field,
    prober: Prober,
    calibration: Calibration,
    states: Vec<LatentGaussian>,
    points: PreparedPoints,
    densities: Vec<f32>,
}

/// One probed hypothesis.
#[derive(Clone, Debug, PartialEq)]
pub struct Probed {
    /// Occupancy of each place, 0..=1.
    pub occupancies: Vec<f32>,
    /// What they stand for.
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
    /// Probability of the path followed up to this step's input; 1 at the first step.
    pub path_probability: f32,
}

impl Probe {
    /// Reads field and calibration from a checkpoint.
    pub fn load(dir: &Path, manifest: &Manifest) -> Result<Self, CheckpointError> {
        let (prober, calibration) = carff_checkpoint::load_probing(dir, manifest)?;
        Ok(Self::new(carff_checkpoint::load_field(dir, manifest)?, prober, calibration, manifest.states.clone()))
    }

    /// Puts the parts together; `states` are the posteriors that stand for the known states.
    pub fn new(field: Field, prober: Prober, calibration: Calibration, states: Vec<LatentGaussian>) -> Self {
        let points = field.prepare(prober.points());
        Self { field, prober, calibration, states, points, densities: Vec::new() }
    }

    /// The places and states.
    pub fn prober(&self) -> &Prober {
        &self.prober
    }

    /// The field.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The posteriors that stand for the known states.
    pub fn states(&self) -> &[LatentGaussian] {
        &self.states
    }

    /// The posterior that stands for a known state.
    pub fn state_posterior(&self, state: usize) -> Option<&LatentGaussian> {
        self.states.get(state)
    }

    /// Probes one hypothesis.
    pub fn probe(&mut self, latent: &[f32; LATENT_DIM]) -> Probed {
        self.probe_all(std::slice::from_ref(latent)).remove(0)
    }

    /// Probes hypotheses, one result each.
    pub fn probe_all(&mut self, latents: &[[f32; LATENT_DIM]]) -> Vec<Probed> {
        let points = self.points.len().max(1);
        self.densities.resize(points * latents.len(), 0.0);
        self.field.density_prepared(&self.points, latents, &mut self.densities);
        let read = |densities: &[f32]| {
            let mut occupancies = vec![0.0; self.prober.places().len()];
            self.prober.occupancies(densities, &mut occupancies);
            let reading = self.calibration.read(&self.prober, &occupancies);
            Probed { occupancies, reading }
        };
        self.densities.chunks_exact(points).map(read).collect()
    }

    /// Probes a mixture's component means and draws, and resolves the state.
    pub fn step(&mut self, mixture: Mixture, draws: Vec<Draw>, path_probability: f32) -> Step {
        let latents: Vec<[f32; LATENT_DIM]> =
            mixture.components.iter().map(|c| c.mean).chain(draws.iter().map(|d| d.latent)).collect();
        let mut components = self.probe_all(&latents);
        let samples = components.split_off(mixture.components.len());
        let readings = |probed: &[Probed]| probed.iter().map(|p| p.reading.clone()).collect::<Vec<_>>();
        let of: Vec<usize> = draws.iter().map(|d| d.component).collect();
        let resolved = resolve(&self.prober, &mixture.weights, &readings(&components), &readings(&samples), &of);
        Step { mixture, draws, components, samples, resolved, path_probability }
    }
}

/// How far and how finely to look ahead, and with which random numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// Latents drawn a step.
    pub samples: usize,
    /// How they are spread over the components.
    pub sampling: Sampling,
    /// Steps.
    pub horizon: u32,
    /// The run's seed.
    pub seed: u64,
    /// The frame's number.
    pub frame: u64,
}

/// Looks ahead from one posterior: each step's resolved state feeds the next. `forecast` is given the input, and the
/// known state that it stands for (`None` at the first step).
pub fn look_ahead(
    mut forecast: impl FnMut(&LatentGaussian, Option<usize>) -> Mixture,
    probe: &mut Probe,
    posterior: &LatentGaussian,
    plan: Plan,
) -> Vec<Step> {
    let mut steps = Vec::with_capacity(plan.horizon as usize);
    let mut input = (*posterior, None);
    let mut path_probability = 1.0;
    for k in 1..=plan.horizon {
        let mixture = forecast(&input.0, input.1);
        let draws = mixture.draw(plan.samples, plan.sampling, plan.seed, plan.frame, k);
        let step = probe.step(mixture, draws, path_probability);
        path_probability = next_path_probability(&step.resolved, path_probability);
        let state = step.resolved.state;
        steps.push(step);
        match probe.state_posterior(state) {
            Some(next) => input = (*next, Some(state)),
            None => break,
        }
    }
    steps
}

/// Probability of the path that follows the resolved state.
pub fn next_path_probability(resolved: &Resolved, path_probability: f32) -> f32 {
    let p = resolved.state_probabilities.get(resolved.state).copied().unwrap_or(0.0);
    (path_probability * p).clamp(0.0, 1.0)
}

/// Lower bound of the probability that a hazard is met at any step of the path followed: the largest of the steps'
/// hazard probabilities, each times the probability of getting there.
pub fn hazard_probability(steps: impl IntoIterator<Item = (f32, f32)>) -> f32 {
    steps.into_iter().map(|(hazard, path)| hazard * path).fold(0.0, f32::max)
}

/// What a rule decides from the steps of one frame. Samples count at the first step, which rests on what was seen.
pub fn decision(rule: Rule, steps: &[Step]) -> Decision {
    let Some(first) = steps.first() else { return Decision { halt: true, confidence: 0.0 } };
    let states: Vec<Option<usize>> = first.samples.iter().map(|s| s.reading.state).collect();
    let shows_hazard: Vec<bool> = first.samples.iter().map(|s| s.reading.hazard_likelihood > 0.5).collect();
    let hazard = hazard_probability(steps.iter().map(|s| (s.resolved.hazard_probability, s.path_probability)));
    decide(rule, &Evidence { states: &states, shows_hazard: &shows_hazard, hazard_probability: f64::from(hazard) })
}
