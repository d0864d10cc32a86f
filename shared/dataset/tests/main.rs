//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod corruptions;
mod importing;
mod lenses_and_masks;
mod other_tools;
mod reading;
