//! Images for people: training curves and filmstrips, as PNG files.
//!
//! This crate contains layout, axes and text, with a built-in font, so that an image looks the same on every machine.
//! It does not compute the displayed values.

mod canvas;
mod curves;
mod filmstrip;

pub use curves::{Marks, Panel, Series, curves};
pub use filmstrip::{StripCell, StripRow, filmstrip};

/// Maximum side of a drawn image, pixels.
pub const MAX_SIDE_PX: u32 = 8192;

/// Reason why an image could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The file could not be written.
    #[error(transparent)]
    File(#[from] carff_dataset::DatasetError),
    /// The contents do not fit into the largest image.
    #[error("an image of {width_px}x{height_px} pixels is too large, at most {MAX_SIDE_PX} a side: show less at once")]
    TooLarge {
        /// Required width, pixels.
        width_px: u32,
        /// Required height, pixels.
        height_px: u32,
    },
    /// An image's number of bytes does not match its size.
    #[error("row {row}, image {cell}: {bytes} bytes do not make an image of {width_px}x{height_px} pixels")]
    Image {
        /// Row of the filmstrip, from 0.
        row: usize,
        /// Index of the image in the row, from 0.
        cell: usize,
        /// Number of bytes.
        bytes: usize,
        /// Width, pixels.
        width_px: u32,
        /// Height, pixels.
        height_px: u32,
    },
    /// The drawing library reported an error.
    #[error("cannot draw the image: {0}")]
    Drawing(String),
}
