//! Rendering: images of colour, expected depth and opacity.

pub(crate) mod buffers;
mod compositor;
mod images;
