//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod common;
mod in_process;
mod processes;
mod untyped;
