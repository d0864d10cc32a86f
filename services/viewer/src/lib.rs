//! The live window: what an image may mean, forecast, probed and seen from anywhere.
//!
//! What lives where: [`session`] is the window without a window, computed by the functions that the stages use;
//! [`models`] and [`input`] are what it works on, [`history`] and [`journal`] what it remembers; [`live`] watches a
//! running graph; [`camera`], [`render`] and [`slice`] make images; [`app`] is what is seen and pressed.

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
