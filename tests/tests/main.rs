//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod bad_input;
mod camera;
mod controller;
mod drive;
mod graph;
mod logs;
mod look_ahead;
mod memory;
mod operate;
mod own_stage;
mod python;
mod real_cameras;
mod security;
mod soak;
mod stages;
mod surroundings;
mod waiting;
