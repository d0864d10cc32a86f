//! Charts, filmstrips, contact sheets and boards as images: layout, axes and text.
//!
//! The font is part of the program, so that an image looks the same on every machine.
//!
//! ```
//! use carff_plots::{Panel, Series, curves};
//! let loss = Series { name: "loss".into(), points: vec![(1.0, 4.0), (2.0, 2.5)], ..Series::default() };
//! let panel = Panel { title: "VAE".into(), x_label: "epoch".into(), series: vec![loss], ..Panel::default() };
//! # let dir = tempfile::tempdir().unwrap();
//! curves(&dir.path().join("curves.png"), "Training", &[panel])?;
//! # Ok::<(), carff_plots::PlotError>(())
//! ```

mod board;
mod canvas;
mod curves;
mod filmstrip;
mod sheet;

pub use board::{Bar, Board};
pub use curves::{Marks, Panel, Series, curves};
pub use filmstrip::{StripCell, StripRow, filmstrip};
pub use sheet::labelled_sheet;

/// Longest side of a drawn image, pixels.
pub const MAX_SIDE_PX: u32 = 8192;

/// Reason why an image could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The file could not be written.
    #[error(transparent)]
    File(#[from] carff_dataset::DatasetError),
    /// The image would be too large.
    #[error("an image of {width_px}x{height_px} pixels is too large, at most {MAX_SIDE_PX} a side: show less at once")]
    TooLarge {
        /// Width, pixels.
        width_px: u32,
        /// Height, pixels.
        height_px: u32,
    },
    /// The number of bytes of an image does not match its size.
    #[error("row {row}, image {cell}: {bytes} bytes do not match an image of {width_px}x{height_px} pixels")]
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
    /// The drawing library failed.
    #[error("cannot draw the image: {0}")]
    Drawing(String),
}
