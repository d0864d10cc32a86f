//! The probability that each cell of a grid on the ground is taken.

use crate::check::{at_most, probability, within};
use crate::{Header, Invalid, message};
use iceoryx2::prelude::ZeroCopySend;
use ndarray::{ArrayView2, aview2};

/// Maximum number of cells in an [`Occupancy`].
pub const MAX_CELLS: usize = 1024;

/// Probability that each cell of a grid on the ground is taken at a step of the look-ahead: by something still, by a known
/// state, or by something that no known state explains. Cells are square. Entries beyond the cells are unused.
///
/// ```
/// use carff_messages::{Header, Message, Occupancy};
/// let mut occupancy = Occupancy::empty(Header::of_frame(7, 1_000, 42).at_step(1));
/// (occupancy.columns, occupancy.rows, occupancy.cell_m) = (4, 2, 0.5);
/// occupancy.probability[5] = 0.9;
/// assert!(occupancy.validate().is_ok());
/// // The second cell of the second row, whose middle is 0.75 m from the corner along both axes.
/// assert_eq!(occupancy.grid()[[1, 1]], 0.9);
/// assert_eq!(occupancy.middle_m([1, 1]), [0.75, 0.75]);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("carff.Occupancy.v1")]
pub struct Occupancy {
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
    pub probability: [f32; MAX_CELLS],
    /// Time from the belief to sending, nanoseconds.
    pub stage_latency_ns: u64,
}

impl Occupancy {
    /// Returns a grid without cells.
    pub fn empty(header: Header) -> Self {
        Self {
            header,
            columns: 0,
            rows: 0,
            cell_m: 1.0,
            low_corner_m: [0.0; 2],
            unknown_probability: 0.0,
            probability: [0.0; MAX_CELLS],
            stage_latency_ns: 0,
        }
    }

    /// Returns the probabilities of the cells, along x, then along y.
    pub fn cells(&self) -> &[f32] {
        &self.probability[..(self.columns as usize * self.rows as usize).min(MAX_CELLS)]
    }

    /// Returns the probabilities by row (along y) and column (along x); empty if the message has more cells than fit.
    pub fn grid(&self) -> ArrayView2<'_, f32> {
        let shape = (self.rows as usize, self.columns as usize);
        ArrayView2::from_shape(shape, self.cells()).unwrap_or_else(|_| aview2::<f32, 1>(&[]))
    }

    /// Returns the middle of a cell, given by row and column: x and y, metres, world space.
    pub fn middle_m(&self, [row, column]: [usize; 2]) -> [f64; 2] {
        let cell_m = f64::from(self.cell_m);
        let [x, y] = self.low_corner_m.map(f64::from);
        [x + (column as f64 + 0.5) * cell_m, y + (row as f64 + 0.5) * cell_m]
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        at_most("columns x rows", u64::from(self.columns) * u64::from(self.rows), MAX_CELLS as u64)?;
        within("cell_m", [&self.cell_m], 1e-3, 1e3)?;
        within("low_corner_m", &self.low_corner_m, -1e6, 1e6)?;
        within("probability", self.cells(), 0.0, 1.0)?;
        probability("unknown_probability", self.unknown_probability)
    }
}

message!(Occupancy);
