//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod doctor;
mod launching;
mod schemas;
