//! What does not fit what the model knows: the condition of an image, and things that no known state explains.

use crate::check::{at_most, finite, finite_f64, probability, within};
use crate::{Header, ImageCondition, Invalid, MAX_PLACES, MAX_STATES, fields, message};
use iceoryx2::prelude::ZeroCopySend;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Maximum number of boxes in [`Unknowns`].
pub const MAX_UNKNOWNS: usize = 8;

/// The encoder's check of one image: whether the camera is in order. An image in any other
/// condition has no posterior, and the controller publishes the safe action with the condition as its reason.
///
/// ```
/// use carff_messages::{Header, ImageCheck, ImageCondition, Message};
/// let check = ImageCheck {
///     condition: ImageCondition::Black.code(),
///     ..ImageCheck::of_frame(Header::of_frame(7, 1_000, 42))
/// };
/// assert!(check.validate().is_ok() && !check.is_usable());
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.ImageCheck.v1")]
pub struct ImageCheck {
    /// Header, at step 0.
    pub header: Header,
    /// Code of an [`ImageCondition`]; in JSON, its name.
    #[serde(with = "fields::condition")]
    #[schemars(with = "String")]
    pub condition: u32,
    /// Mean luminance, 0..=1.
    pub luminance: f32,
    /// Contrast of fine detail against that of trained images; 1 is the median of these.
    pub sharpness: f32,
    /// Mean absolute difference to the image before, of 255; 0 for the first image.
    pub change: f32,
    /// Share of the image that is dark and without detail, 0..=1.
    pub covered: f32,
    /// Time for which the image repeats, seconds.
    pub repeats_s: f32,
}

impl ImageCheck {
    /// Returns the check of a usable image without measurements.
    pub fn of_frame(header: Header) -> Self {
        Self {
            header,
            condition: ImageCondition::Usable.code(),
            luminance: 0.0,
            sharpness: 0.0,
            change: 0.0,
            covered: 0.0,
            repeats_s: 0.0,
        }
    }

    /// Returns the condition.
    pub fn condition(&self) -> Result<ImageCondition, Invalid> {
        ImageCondition::try_from(self.condition)
    }

    /// Reports whether a decision may rest on the image.
    pub fn is_usable(&self) -> bool {
        self.condition == ImageCondition::Usable.code()
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        ImageCondition::try_from(self.condition)?;
        within("luminance and covered", [&self.luminance, &self.covered], 0.0, 1.0)?;
        within("sharpness, change and repeats_s", [&self.sharpness, &self.change, &self.repeats_s], 0.0, 1e9)
    }
}

message!(ImageCheck);

/// A box in which something stands that no known state explains.
///
/// ```
/// use carff_messages::UnknownBox;
/// let unknown = UnknownBox { center: [-4.0, 1.5, 0.6], half_size: [0.5, 0.5, 0.6], probability: 0.9, place: -1 };
/// let low_corner_m = [0, 1, 2].map(|axis| unknown.center[axis] - unknown.half_size[axis]);
/// assert_eq!(low_corner_m, [-4.5, 1.0, 0.0]);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.UnknownBox.v1")]
pub struct UnknownBox {
    /// Centre of the box, metres, world space. A camera sees one side: the depth is assumed equal to the width.
    pub center: [f64; 3],
    /// Half of the extent along x, y and z, metres.
    pub half_size: [f64; 3],
    /// Probability that the box holds something unknown, 0..=1.
    pub probability: f32,
    /// Index of the probed place that the box touches; -1 for elsewhere on the lanes.
    pub place: i32,
}

/// The prober's comparison of an image with the known states, rendered from the camera's own pose. Entries beyond the
/// counts are unused.
///
/// ```
/// use carff_messages::{Header, Message, UnknownBox, Unknowns};
/// let mut unknowns = Unknowns::of_frame(Header::of_frame(7, 1_000, 42));
/// unknowns.boxes[0] = UnknownBox { half_size: [1.0; 3], probability: 0.9, place: -1, ..UnknownBox::default() };
/// (unknowns.box_count, unknowns.probability) = (1, 0.9);
/// assert!(unknowns.validate().is_ok());
/// assert_eq!(unknowns.boxes().len(), 1);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("carff.Unknowns.v4")]
pub struct Unknowns {
    /// Header, at step 0.
    pub header: Header,
    /// Number of used boxes, at most 8.
    pub box_count: u64,
    /// Number of states of the scenario, at most 64.
    pub state_count: u32,
    /// Number of probed places that were looked at, at most 48; 0 without a memory.
    pub place_count: u32,
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
    /// Share of the view's variation that the place explains, at most 1; 0 or below for a view of another place, or
    /// from another pose.
    pub explained: f32,
    /// For each known state, how much better it explains the image than something unknown does; 0 for a view of another
    /// place.
    pub ratios: [f32; MAX_STATES],
    /// For each place, what the image shows of it: -1 for free, 1 for taken, 0 for nothing; -2..=2.
    pub places: [f32; MAX_PLACES],
    /// Boxes, the most probable first.
    pub boxes: [UnknownBox; MAX_UNKNOWNS],
    /// Time from the arrival of the frame to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl Unknowns {
    /// Returns a comparison without residual.
    pub fn of_frame(header: Header) -> Self {
        Self {
            header,
            box_count: 0,
            state_count: 0,
            place_count: 0,
            probability: 0.0,
            residual: 0.0,
            noise: 0.0,
            gain: [1.0; 3],
            offset: [0.0; 3],
            explained: 1.0,
            ratios: [1.0; MAX_STATES],
            places: [0.0; MAX_PLACES],
            boxes: [UnknownBox::default(); MAX_UNKNOWNS],
            stage_latency_ns: 0,
        }
    }

    /// Returns the used boxes.
    pub fn boxes(&self) -> &[UnknownBox] {
        &self.boxes[..(self.box_count as usize).min(MAX_UNKNOWNS)]
    }

    /// Returns what the image shows of each place.
    pub fn places(&self) -> &[f32] {
        &self.places[..(self.place_count as usize).min(MAX_PLACES)]
    }

    /// Returns the ratios of the scenario's states.
    pub fn ratios(&self) -> &[f32] {
        &self.ratios[..(self.state_count as usize).min(MAX_STATES)]
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        at_most("state_count", self.state_count.into(), MAX_STATES as u64)?;
        within("ratios", self.ratios(), 0.0, f32::MAX)?;
        at_most("place_count", self.place_count.into(), MAX_PLACES as u64)?;
        within("places", self.places(), -2.0, 2.0)?;
        at_most("box_count", self.box_count, MAX_UNKNOWNS as u64)?;
        probability("probability", self.probability)?;
        finite("residual, noise and explained", [&self.residual, &self.noise, &self.explained])?;
        finite("gain and offset", self.gain.iter().chain(&self.offset))?;
        for unknown in self.boxes() {
            finite_f64("boxes", unknown.center.iter().chain(&unknown.half_size))?;
            probability("boxes.probability", unknown.probability)?;
            crate::check::in_range("boxes.place", unknown.place.into(), -1, MAX_PLACES as i64 - 1)?;
        }
        Ok(())
    }
}

message!(Unknowns);
