//! Messages about latents: the posterior, the forecast with its samples, and the belief.

use crate::check::{at_most, distribution, equals, in_range, probability, within};
use crate::{
    ForecastSource, Header, Invalid, LATENT_DIM, MAX_ABS_LATENT, MAX_COMPONENTS, MAX_HORIZON, MAX_PLACES, MAX_SAMPLES,
    MAX_STATES, message,
};
use iceoryx2::prelude::ZeroCopySend;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Maximum absolute log-variance of a valid message: a standard deviation of e^-15 or e^15.
const MAX_ABS_LOG_VARIANCE: f32 = 30.0;

/// A diagonal Gaussian over the scene latent: q(z | I) = N(mean, diag exp(log-variance)) (paper section 3.1).
///
/// ```
/// use carff_messages::Gaussian;
/// let posterior = Gaussian { mean: [1.0; 8], log_variance: [4.0_f32.ln(); 8] };
/// // One deviation above the mean: the deviation is 2.
/// assert_eq!(posterior.at(&[1.0; 8]), [3.0; 8]);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.Gaussian.v1")]
pub struct Gaussian {
    /// Mean of the latent, -1e4..=1e4.
    pub mean: [f32; LATENT_DIM],
    /// Natural logarithm of the variance.
    pub log_variance: [f32; LATENT_DIM],
}

impl Gaussian {
    /// Returns mean 0 and variance 1.
    pub const fn standard() -> Self {
        Self { mean: [0.0; LATENT_DIM], log_variance: [0.0; LATENT_DIM] }
    }

    /// Returns mean + exp(log-variance / 2) * `unit`, for a draw `unit` from the standard normal distribution.
    pub fn at(&self, unit: &[f32; LATENT_DIM]) -> [f32; LATENT_DIM] {
        std::array::from_fn(|i| self.mean[i] + (0.5 * self.log_variance[i]).exp() * unit[i])
    }

    fn check(&self) -> Result<(), Invalid> {
        within("gaussian.mean", &self.mean, -MAX_ABS_LATENT, MAX_ABS_LATENT)?;
        within("gaussian.log_variance", &self.log_variance, -MAX_ABS_LOG_VARIANCE, MAX_ABS_LOG_VARIANCE)
    }
}

/// The encoder's answer to a frame: the posterior over the scene latent.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.Posterior.v2")]
pub struct Posterior {
    /// Header, at step 0.
    pub header: Header,
    /// The latent's distribution.
    pub gaussian: Gaussian,
    /// Number of the first frame of the take: the frame's, or a later one if the camera was not usable in between.
    pub take_start: u64,
    /// Time from the arrival of the frame to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl Posterior {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        at_most("take_start", self.take_start, self.header.frame_id)?;
        self.gaussian.check()
    }
}

message!(Posterior);

/// A mixture over the latent at the next step, with latents drawn from it. Entries beyond the counts are unused.
///
/// ```
/// use carff_messages::{Forecast, ForecastSource, Gaussian, Header, Message};
/// let header = Header::of_frame(7, 1_000, 42).at_step(1);
/// let mut forecast = Forecast::empty(header, ForecastSource::Observed, 2);
/// assert!(forecast.validate().is_err(), "it has no components yet");
/// (forecast.component_count, forecast.sample_count) = (2, 2);
/// forecast.weights[..2].copy_from_slice(&[0.75, 0.25]);
/// forecast.components[1] = Gaussian { mean: [1.0; 8], ..Gaussian::standard() };
/// forecast.samples[1] = [0.9; 8];
/// forecast.sample_component[1] = 1;
/// assert!(forecast.validate().is_ok());
/// assert_eq!(forecast.samples(), [[0.0; 8], [0.9; 8]]);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("carff.Forecast.v4")]
pub struct Forecast {
    /// Header, at step 1 or more.
    pub header: Header,
    /// Code of a [`ForecastSource`].
    pub source: u32,
    /// Number of used components, 1..=8.
    pub component_count: u32,
    /// Number of drawn samples, 1..=64.
    pub sample_count: u32,
    /// Number of steps in the look-ahead of this frame, 1..=8.
    pub horizon: u32,
    /// The state that the previous step resolved to; -1 at step 1, and where the previous step's samples are the input.
    pub resolved_state: i32,
    /// Probability of the path up to the input, 0..=1; 1 at step 1.
    pub path_probability: f32,
    /// Number of images that the forecast rests on; 1 without a memory.
    pub images: u64,
    /// Number of states of the scenario, at most 64; 0 without a memory.
    pub state_count: u32,
    /// Hazard probability of the next state by what earlier images showed of the places, without the encoder, 0..=1.
    pub hazard_by_places: f32,
    /// Weights of the present states by the images so far, without this frame's comparison; they sum to 1.
    pub state_weights: [f32; MAX_STATES],
    /// Mixture weights.
    pub weights: [f32; MAX_COMPONENTS],
    /// Mixture components.
    pub components: [Gaussian; MAX_COMPONENTS],
    /// Drawn latents, -1e4..=1e4.
    pub samples: [[f32; LATENT_DIM]; MAX_SAMPLES],
    /// Component that each sample was drawn from.
    pub sample_component: [u8; MAX_SAMPLES],
    /// Duration of the encoding of this frame, nanoseconds.
    pub encoder_ns: u64,
    /// Time from the arrival of the input to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl Forecast {
    /// Returns a forecast without components and samples, to be filled in.
    pub fn empty(header: Header, source: ForecastSource, horizon: u32) -> Self {
        Self {
            header,
            source: source.code(),
            component_count: 0,
            sample_count: 0,
            horizon,
            resolved_state: -1,
            path_probability: 1.0,
            images: 1,
            state_count: 0,
            hazard_by_places: 0.0,
            state_weights: [0.0; MAX_STATES],
            weights: [0.0; MAX_COMPONENTS],
            components: [Gaussian::standard(); MAX_COMPONENTS],
            samples: [[0.0; LATENT_DIM]; MAX_SAMPLES],
            sample_component: [0; MAX_SAMPLES],
            encoder_ns: 0,
            stage_latency_ns: 0,
        }
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        ForecastSource::try_from(self.source)?;
        in_range("horizon", self.horizon.into(), 1, MAX_HORIZON.into())?;
        in_range("header.step", self.header.step.into(), 1, self.horizon.into())?;
        in_range("component_count", self.component_count.into(), 1, MAX_COMPONENTS as i64)?;
        in_range("sample_count", self.sample_count.into(), 1, MAX_SAMPLES as i64)?;
        in_range("resolved_state", self.resolved_state.into(), -1, MAX_STATES as i64 - 1)?;
        probability("path_probability", self.path_probability)?;
        let (components, samples) = (self.component_count as usize, self.sample_count as usize);
        distribution("weights", &self.weights[..components])?;
        at_most("state_count", self.state_count.into(), MAX_STATES as u64)?;
        probability("hazard_by_places", self.hazard_by_places)?;
        if self.state_count > 0 {
            distribution("state_weights", self.state_weights())?;
        }
        for component in &self.components[..components] {
            component.check()?;
        }
        for sample in &self.samples[..samples] {
            within("samples", sample, -MAX_ABS_LATENT, MAX_ABS_LATENT)?;
        }
        for &component in &self.sample_component[..samples] {
            at_most("sample_component", component.into(), components as u64 - 1)?;
        }
        Ok(())
    }

    /// Returns the weights of the present states; empty without a memory.
    pub fn state_weights(&self) -> &[f32] {
        &self.state_weights[..(self.state_count as usize).min(MAX_STATES)]
    }

    /// Returns the used samples.
    pub fn samples(&self) -> &[[f32; LATENT_DIM]] {
        &self.samples[..(self.sample_count as usize).min(MAX_SAMPLES)]
    }
}

message!(Forecast);

/// The result of probing one latent.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("carff.ProbeResult.v2")]
pub struct ProbeResult {
    /// Index of the state; -1 for none of the known ones.
    pub state: i32,
    /// Confidence of the state, 0..=1.
    pub confidence: f32,
    /// Probability that the scene of this latent contains the hazard, 0..=1.
    pub hazard_likelihood: f32,
    /// Occupancy of each place, 0..=1.
    pub occupancies: [f32; MAX_PLACES],
}

impl ProbeResult {
    /// Returns the known state that the scene of this latent shows, if any.
    pub fn state(&self) -> Option<usize> {
        usize::try_from(self.state).ok()
    }

    /// Result of a probe without a match.
    pub const NONE: Self = Self { state: -1, confidence: 0.0, hazard_likelihood: 0.0, occupancies: [0.0; MAX_PLACES] };

    fn check(&self, states: u32, places: u32) -> Result<(), Invalid> {
        in_range("probe.state", self.state.into(), -1, i64::from(states) - 1)?;
        probability("probe.confidence", self.confidence)?;
        probability("probe.hazard_likelihood", self.hazard_likelihood)?;
        within("probe.occupancies", &self.occupancies[..places as usize], 0.0, 1.0)
    }
}

/// The prober's answer to a forecast: a belief over the known states. Entries beyond the counts are unused.
///
/// ```
/// use carff_messages::{Belief, Header, Message, ProbeResult};
/// let mut belief = Belief::empty(Header::of_frame(7, 1_000, 42).at_step(1), 2);
/// (belief.state_count, belief.place_count) = (2, 1);
/// (belief.component_count, belief.sample_count) = (1, 2);
/// belief.component_weights[0] = 1.0;
/// belief.state_probability[..2].copy_from_slice(&[0.5, 0.5]);
/// belief.samples[0] = ProbeResult { state: 0, confidence: 0.99, hazard_likelihood: 1.0, ..ProbeResult::NONE };
/// belief.samples[0].occupancies[0] = 0.97;
/// belief.hazard_probability = 0.5;
/// assert!(belief.validate().is_ok());
/// assert!(!belief.is_final());
/// assert_eq!(belief.samples().iter().map(ProbeResult::state).collect::<Vec<_>>(), [Some(0), None]);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("carff.Belief.v5")]
pub struct Belief {
    /// Header, at the step of the forecast.
    pub header: Header,
    /// Number of steps in the look-ahead of this frame, 1..=8.
    pub horizon: u32,
    /// Number of states of the scenario, 1..=64.
    pub state_count: u32,
    /// Number of probed places, 1..=48.
    pub place_count: u32,
    /// Number of mixture components, 1..=8.
    pub component_count: u32,
    /// Number of samples, 1..=64.
    pub sample_count: u32,
    /// 1 for the frame's last step (also if the look-ahead ended early), else 0.
    pub is_final: u32,
    /// Probability of each known state. Together with the unknown's they sum to 1.
    pub state_probability: [f32; MAX_STATES],
    /// Probability of the hazard at this step, given the path, 0..=1.
    pub hazard_probability: f32,
    /// Probability of the path up to this step's input, 0..=1.
    pub path_probability: f32,
    /// Mixture weights.
    pub component_weights: [f32; MAX_COMPONENTS],
    /// Result for each component's mean.
    pub components: [ProbeResult; MAX_COMPONENTS],
    /// Result for each sample.
    pub samples: [ProbeResult; MAX_SAMPLES],
    /// Component that each sample was drawn from.
    pub sample_component: [u8; MAX_SAMPLES],
    /// The most probable state; -1 for none of the known ones.
    pub resolved_state: i32,
    /// Probability that something is there which no known state explains, 0..=1; 0 if the image was not compared.
    pub unknown_probability: f32,
    /// That state's stored posterior: the next step's input where no sample is fed back.
    pub resolved: Gaussian,
    /// Inputs of the next step, one a sample, where the samples themselves are fed back.
    pub fed_back: [Gaussian; MAX_SAMPLES],
    /// Number of these inputs, 0..=64.
    pub fed_back_count: u64,
    /// Duration of the encoding of this frame, nanoseconds.
    pub encoder_ns: u64,
    /// Duration of the forecast of this step, nanoseconds.
    pub forecaster_ns: u64,
    /// Time from the arrival of the forecast to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl Belief {
    /// Returns a belief without results, to be filled in.
    pub fn empty(header: Header, horizon: u32) -> Self {
        Self {
            header,
            horizon,
            state_count: 0,
            place_count: 0,
            component_count: 0,
            sample_count: 0,
            is_final: u32::from(header.step == horizon),
            state_probability: [0.0; MAX_STATES],
            hazard_probability: 0.0,
            path_probability: 1.0,
            component_weights: [0.0; MAX_COMPONENTS],
            components: [ProbeResult::NONE; MAX_COMPONENTS],
            samples: [ProbeResult::NONE; MAX_SAMPLES],
            sample_component: [0; MAX_SAMPLES],
            resolved_state: -1,
            unknown_probability: 0.0,
            resolved: Gaussian::standard(),
            fed_back: [Gaussian::standard(); MAX_SAMPLES],
            fed_back_count: 0,
            encoder_ns: 0,
            forecaster_ns: 0,
            stage_latency_ns: 0,
        }
    }

    /// Returns the results of the used components.
    pub fn components(&self) -> &[ProbeResult] {
        &self.components[..(self.component_count as usize).min(MAX_COMPONENTS)]
    }

    /// Returns true for the frame's last step.
    pub fn is_final(&self) -> bool {
        self.is_final == 1
    }

    /// Returns the inputs of the next step, where the samples themselves are fed back.
    pub fn fed_back(&self) -> &[Gaussian] {
        &self.fed_back[..(self.fed_back_count as usize).min(MAX_SAMPLES)]
    }

    /// Returns the results of the used samples.
    pub fn samples(&self) -> &[ProbeResult] {
        &self.samples[..(self.sample_count as usize).min(MAX_SAMPLES)]
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        in_range("horizon", self.horizon.into(), 1, MAX_HORIZON.into())?;
        in_range("header.step", self.header.step.into(), 1, self.horizon.into())?;
        in_range("state_count", self.state_count.into(), 1, MAX_STATES as i64)?;
        in_range("place_count", self.place_count.into(), 1, MAX_PLACES as i64)?;
        in_range("component_count", self.component_count.into(), 1, MAX_COMPONENTS as i64)?;
        in_range("sample_count", self.sample_count.into(), 1, MAX_SAMPLES as i64)?;
        at_most("is_final", self.is_final.into(), 1)?;
        if self.header.step == self.horizon {
            equals("is_final", self.is_final.into(), 1)?;
        }
        let states = &self.state_probability[..self.state_count as usize];
        within("state_probability", states, 0.0, 1.0)?;
        probability("unknown_probability", self.unknown_probability)?;
        let sum: f32 = states.iter().sum::<f32>() + self.unknown_probability;
        within("sum of state_probability and unknown_probability", [&sum], 0.0, 1.001)?;
        probability("hazard_probability", self.hazard_probability)?;
        probability("path_probability", self.path_probability)?;
        let (components, samples) = (self.component_count as usize, self.sample_count as usize);
        distribution("component_weights", &self.component_weights[..components])?;
        for result in &self.components[..components] {
            result.check(self.state_count, self.place_count)?;
        }
        for result in &self.samples[..samples] {
            result.check(self.state_count, self.place_count)?;
        }
        for &component in &self.sample_component[..samples] {
            at_most("sample_component", component.into(), components as u64 - 1)?;
        }
        in_range("resolved_state", self.resolved_state.into(), -1, i64::from(self.state_count) - 1)?;
        at_most("fed_back_count", self.fed_back_count, MAX_SAMPLES as u64)?;
        for input in self.fed_back() {
            input.check()?;
        }
        self.resolved.check()
    }
}

message!(Belief);
