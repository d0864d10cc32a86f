//! The form of occupancy grids.

use super::{FormError, begin};
use crate::{Header, Message, Occupancy};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Probability that each cell of a grid on the ground is taken at a step of the look-ahead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OccupancyForm {
    /// Header, with the step of the look-ahead.
    pub header: Header,
    /// Number of cells along x.
    pub columns: u32,
    /// Number of cells along y.
    pub rows: u32,
    /// Side of a cell, metres.
    pub cell_m: f32,
    /// Corner of the grid with the smallest x and y, metres, world space.
    pub low_corner_m: [f32; 2],
    /// Probability that something unknown stands somewhere, 0..=1.
    pub unknown_probability: f32,
    /// Probability of each cell, 0..=1: along x, then along y.
    pub probability: Vec<f32>,
    /// Time from the belief to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl From<&Occupancy> for OccupancyForm {
    fn from(occupancy: &Occupancy) -> Self {
        Self {
            header: occupancy.header,
            columns: occupancy.columns,
            rows: occupancy.rows,
            cell_m: occupancy.cell_m,
            low_corner_m: occupancy.low_corner_m,
            unknown_probability: occupancy.unknown_probability,
            probability: occupancy.cells().to_vec(),
            stage_latency_ns: occupancy.stage_latency_ns,
        }
    }
}

impl TryFrom<&OccupancyForm> for Occupancy {
    type Error = FormError;

    fn try_from(form: &OccupancyForm) -> Result<Self, FormError> {
        let occupancy = Self {
            header: form.header,
            columns: form.columns,
            rows: form.rows,
            cell_m: form.cell_m,
            low_corner_m: form.low_corner_m,
            unknown_probability: form.unknown_probability,
            probability: begin("probability", &form.probability, 0.0)?,
            stage_latency_ns: form.stage_latency_ns,
        };
        occupancy.validate()?;
        Ok(occupancy)
    }
}
