//! The live window: scenes that explain an image, forecast, probed and seen from any pose.
//!
//! [`session`] is the logic without a window; it calls the same functions as the stages. It works on [`models`] and
//! [`input`], and fills [`history`] and [`journal`]. [`live`] watches a running graph. [`camera`], [`render`] and
//! [`slice`] make images. [`app`] is the window.

pub mod app;
pub mod camera;
pub mod history;
pub mod input;
pub mod journal;
pub mod live;
pub mod models;
pub mod render;
pub mod session;
pub mod slice;
