//! The form of comparisons.

use super::{FormError, begin};
use crate::{Header, Message, UnknownBox, Unknowns};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The prober's comparison of an image with the known states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct UnknownsForm {
    /// Header, at step 0.
    pub header: Header,
    /// Probability that something unknown stands on the lanes, 0..=1.
    pub probability: f32,
    /// Smallest residual of a known state, in units in which 1 is the limit of the explained.
    pub residual: f32,
    /// Deviation of a pixel from the rendered image, of 1.
    pub noise: f32,
    /// Gain of the image against the field, by channel.
    pub gain: [f32; 3],
    /// Offset of the image against the field, by channel, of 1.
    pub offset: [f32; 3],
    /// Share of the view's variation that the place explains, at most 1.
    pub explained: f32,
    /// For each known state, how much better it explains the image than something unknown does.
    pub ratios: Vec<f32>,
    /// For each place, what the image shows of it: -1 for free, 1 for taken, 0 for nothing. Empty without a memory.
    pub places: Vec<f32>,
    /// Boxes, the most probable first.
    pub boxes: Vec<UnknownBox>,
    /// Time from the arrival of the frame to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl From<&Unknowns> for UnknownsForm {
    fn from(unknowns: &Unknowns) -> Self {
        Self {
            header: unknowns.header,
            probability: unknowns.probability,
            residual: unknowns.residual,
            noise: unknowns.noise,
            gain: unknowns.gain,
            offset: unknowns.offset,
            explained: unknowns.explained,
            ratios: unknowns.ratios().to_vec(),
            places: unknowns.places().to_vec(),
            boxes: unknowns.boxes().to_vec(),
            stage_latency_ns: unknowns.stage_latency_ns,
        }
    }
}

impl TryFrom<&UnknownsForm> for Unknowns {
    type Error = FormError;

    fn try_from(form: &UnknownsForm) -> Result<Self, FormError> {
        let unknowns = Self {
            header: form.header,
            box_count: form.boxes.len() as u64,
            state_count: form.ratios.len() as u32,
            place_count: form.places.len() as u32,
            probability: form.probability,
            residual: form.residual,
            noise: form.noise,
            gain: form.gain,
            offset: form.offset,
            explained: form.explained,
            ratios: begin("ratios", &form.ratios, 1.0)?,
            places: begin("places", &form.places, 0.0)?,
            boxes: begin("boxes", &form.boxes, UnknownBox::default())?,
            stage_latency_ns: form.stage_latency_ns,
        };
        unknowns.validate()?;
        Ok(unknowns)
    }
}
