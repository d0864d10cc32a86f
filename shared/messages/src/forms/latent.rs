//! The forms of posteriors, forecasts and beliefs.

use super::{FormError, array, begin, code_of, index, name_of, signed};
use crate::{
    Belief, Forecast, ForecastSource, Gaussian, Header, LATENT_DIM, MAX_COMPONENTS, MAX_PLACES, MAX_SAMPLES, Message,
    ProbeResult,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A component of a mixture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ComponentForm {
    /// Weight of the component.
    pub weight: f32,
    /// Distribution of the component.
    pub gaussian: Gaussian,
}

/// A latent drawn from a mixture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DrawForm {
    /// Component that the latent was drawn from.
    pub component: u8,
    /// The drawn latent.
    pub latent: Vec<f32>,
}

/// A mixture over the latent at the next step, with latents drawn from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ForecastForm {
    /// Header, at step 1 or more.
    pub header: Header,
    /// Source of the forecast: `observed` or `probed`.
    pub source: String,
    /// Number of steps in the look-ahead of this frame.
    pub horizon: u32,
    /// The state that the previous step resolved to, if any.
    pub resolved_state: Option<u32>,
    /// Probability of the path up to the input.
    pub path_probability: f32,
    /// Number of images that the forecast rests on; 1 without a memory.
    pub images: u64,
    /// Weights of the present states; empty without a memory.
    pub state_weights: Vec<f32>,
    /// Hazard probability of the next state by what earlier images showed of the places, without the encoder.
    pub hazard_by_places: f32,
    /// The mixture.
    pub components: Vec<ComponentForm>,
    /// The drawn latents.
    pub samples: Vec<DrawForm>,
    /// Duration of the encoding of this frame, nanoseconds.
    pub encoder_ns: u64,
    /// Time from the arrival of the input to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl From<&Forecast> for ForecastForm {
    fn from(f: &Forecast) -> Self {
        let components = (f.component_count as usize).min(MAX_COMPONENTS);
        Self {
            header: f.header,
            source: name_of!(ForecastSource, f.source),
            horizon: f.horizon,
            resolved_state: index(f.resolved_state),
            path_probability: f.path_probability,
            images: f.images,
            state_weights: f.state_weights().to_vec(),
            hazard_by_places: f.hazard_by_places,
            components: f.weights[..components]
                .iter()
                .zip(&f.components)
                .map(|(&weight, &gaussian)| ComponentForm { weight, gaussian })
                .collect(),
            samples: f
                .samples()
                .iter()
                .zip(f.sample_component)
                .map(|(latent, component)| DrawForm { component, latent: latent.to_vec() })
                .collect(),
            encoder_ns: f.encoder_ns,
            stage_latency_ns: f.stage_latency_ns,
        }
    }
}

impl TryFrom<&ForecastForm> for Forecast {
    type Error = FormError;

    fn try_from(form: &ForecastForm) -> Result<Self, FormError> {
        let weights: Vec<f32> = form.components.iter().map(|c| c.weight).collect();
        let components: Vec<Gaussian> = form.components.iter().map(|c| c.gaussian).collect();
        let latents = form
            .samples
            .iter()
            .map(|s| array::<f32, LATENT_DIM>("samples.latent", &s.latent))
            .collect::<Result<Vec<_>, _>>()?;
        let drawn_from: Vec<u8> = form.samples.iter().map(|s| s.component).collect();
        let forecast = Self {
            header: form.header,
            source: code_of!(ForecastSource, "source", form.source)?,
            component_count: components.len() as u32,
            sample_count: latents.len() as u32,
            horizon: form.horizon,
            resolved_state: signed(form.resolved_state),
            path_probability: form.path_probability,
            images: form.images,
            state_count: form.state_weights.len() as u32,
            hazard_by_places: form.hazard_by_places,
            state_weights: begin("state_weights", &form.state_weights, 0.0)?,
            weights: begin("components", &weights, 0.0)?,
            components: begin("components", &components, Gaussian::standard())?,
            samples: begin("samples", &latents, [0.0; LATENT_DIM])?,
            sample_component: begin("samples", &drawn_from, 0)?,
            encoder_ns: form.encoder_ns,
            stage_latency_ns: form.stage_latency_ns,
        };
        forecast.validate()?;
        Ok(forecast)
    }
}

/// The result of probing one latent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ProbeForm {
    /// Component that the latent was drawn from; for a component, its own index.
    pub component: u8,
    /// The component's weight; `null` for a sample.
    pub weight: Option<f32>,
    /// The state that the latent shows, if it is a known one.
    pub state: Option<u32>,
    /// Confidence of the state.
    pub confidence: f32,
    /// Probability that the scene contains the hazard.
    pub hazard_likelihood: f32,
    /// Occupancy of each place, 0..=1. Old recordings call this field `densities`.
    #[serde(alias = "densities")]
    pub occupancies: Vec<f32>,
}

impl ProbeForm {
    fn of(result: &ProbeResult, component: u8, weight: Option<f32>, places: usize) -> Self {
        Self {
            component,
            weight,
            state: index(result.state),
            confidence: result.confidence,
            hazard_likelihood: result.hazard_likelihood,
            occupancies: result.occupancies[..places].to_vec(),
        }
    }

    fn result(&self) -> Result<ProbeResult, FormError> {
        Ok(ProbeResult {
            state: signed(self.state),
            confidence: self.confidence,
            hazard_likelihood: self.hazard_likelihood,
            occupancies: begin("occupancies", &self.occupancies, 0.0)?,
        })
    }
}

/// The prober's answer to a forecast.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BeliefForm {
    /// Header, at the step of the forecast.
    pub header: Header,
    /// Number of steps in the look-ahead of this frame.
    pub horizon: u32,
    /// True for the frame's last step.
    pub is_final: bool,
    /// Number of probed places.
    pub place_count: u32,
    /// Probability of each known state; together with the unknown's they sum to 1.
    pub state_probability: Vec<f32>,
    /// Probability of something that no known state explains, 0..=1; recordings before it have 0.
    #[serde(default)]
    pub unknown_probability: f32,
    /// Probability of the hazard at this step.
    pub hazard_probability: f32,
    /// Probability of the path up to this step's input.
    pub path_probability: f32,
    /// Result for each component's mean.
    pub components: Vec<ProbeForm>,
    /// Result for each sample.
    pub samples: Vec<ProbeForm>,
    /// The most probable state, if it is a known one.
    pub resolved_state: Option<u32>,
    /// That state's stored posterior: the next step's input where no sample is fed back.
    pub resolved: Gaussian,
    /// Inputs of the next step, one a sample, where the samples themselves are fed back; recordings before it have none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fed_back: Vec<Gaussian>,
    /// Duration of the encoding of this frame, nanoseconds.
    pub encoder_ns: u64,
    /// Duration of the forecast of this step, nanoseconds.
    pub forecaster_ns: u64,
    /// Time from the arrival of the forecast to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl From<&Belief> for BeliefForm {
    fn from(b: &Belief) -> Self {
        let places = (b.place_count as usize).min(MAX_PLACES);
        let components = (b.component_count as usize).min(MAX_COMPONENTS);
        Self {
            header: b.header,
            horizon: b.horizon,
            is_final: b.is_final(),
            place_count: b.place_count,
            state_probability: b.state_probability.iter().take(b.state_count as usize).copied().collect(),
            unknown_probability: b.unknown_probability,
            hazard_probability: b.hazard_probability,
            path_probability: b.path_probability,
            components: b.components[..components]
                .iter()
                .zip(b.component_weights)
                .enumerate()
                .map(|(i, (result, weight))| ProbeForm::of(result, i as u8, Some(weight), places))
                .collect(),
            samples: b
                .samples()
                .iter()
                .zip(b.sample_component)
                .map(|(result, component)| ProbeForm::of(result, component, None, places))
                .collect(),
            resolved_state: index(b.resolved_state),
            resolved: b.resolved,
            fed_back: b.fed_back().to_vec(),
            encoder_ns: b.encoder_ns,
            forecaster_ns: b.forecaster_ns,
            stage_latency_ns: b.stage_latency_ns,
        }
    }
}

impl TryFrom<&BeliefForm> for Belief {
    type Error = FormError;

    fn try_from(form: &BeliefForm) -> Result<Self, FormError> {
        let results = |forms: &[ProbeForm]| forms.iter().map(ProbeForm::result).collect::<Result<Vec<_>, _>>();
        let (components, samples) = (results(&form.components)?, results(&form.samples)?);
        let weights: Vec<f32> = form.components.iter().map(|c| c.weight.unwrap_or(0.0)).collect();
        let drawn_from: Vec<u8> = form.samples.iter().map(|s| s.component).collect();
        let mut belief = Self::empty(form.header, form.horizon);
        belief.is_final = form.is_final.into();
        belief.state_count = form.state_probability.len() as u32;
        belief.place_count = form.place_count;
        belief.component_count = components.len() as u32;
        belief.sample_count = samples.len() as u32;
        belief.state_probability = begin("state_probability", &form.state_probability, 0.0)?;
        belief.unknown_probability = form.unknown_probability;
        belief.hazard_probability = form.hazard_probability;
        belief.path_probability = form.path_probability;
        belief.component_weights = begin::<_, MAX_COMPONENTS>("components", &weights, 0.0)?;
        belief.components = begin("components", &components, ProbeResult::NONE)?;
        belief.samples = begin::<_, MAX_SAMPLES>("samples", &samples, ProbeResult::NONE)?;
        belief.sample_component = begin("samples", &drawn_from, 0)?;
        belief.resolved_state = signed(form.resolved_state);
        belief.resolved = form.resolved;
        belief.fed_back = begin("fed_back", &form.fed_back, Gaussian::standard())?;
        belief.fed_back_count = form.fed_back.len() as u64;
        belief.encoder_ns = form.encoder_ns;
        belief.forecaster_ns = form.forecaster_ns;
        belief.stage_latency_ns = form.stage_latency_ns;
        belief.validate()?;
        Ok(belief)
    }
}
