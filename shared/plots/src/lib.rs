//! Images for people: training curves and filmstrips, as PNG files.
//!
//! What lives here: layout, axes, text, with a font that is part of the program, so that an image looks the same on
//! every machine. What never does: computing what is shown.

mod canvas;
mod curves;
mod filmstrip;

pub use curves::{Marks, Panel, Series, curves};
pub use filmstrip::{StripCell, StripRow, filmstrip};

/// Longest side of an image that is drawn, pixels.
pub const MAX_SIDE_PX: u32 = 8192;

/// Why an image could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The file could not be written.
    #[error(transparent)]
    File(#[from] carff_dataset::DatasetError),
    /// More was given than fits.
    #[error("an image of {width_px}x{height_px} pixels is too large, at most {MAX_SIDE_PX} a side: show less at once")]
    TooLarge {
        /// Width it would have, pixels.
        width_px: u32,
        /// Height it would have, pixels.
        height_px: u32,
    },
    /// An image's bytes are not those of its size.
    #[error("row {row}, image {cell}: {bytes} bytes do not make an image of {width_px}x{height_px} pixels")]
    Image {
        /// Row of the filmstrip, from 0.
        row: usize,
        /// Image in it, from 0.
        cell: usize,
        /// Bytes given.
        bytes: usize,
        /// Width, pixels.
        width_px: u32,
        /// Height, pixels.
        height_px: u32,
    },
    /// The drawing library refused.
    #[error("cannot draw the image: {0}")]
    Drawing(String),
}
