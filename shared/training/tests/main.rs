//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod free_poses;
mod gradients;
mod learning;
mod one_state;
mod results;
