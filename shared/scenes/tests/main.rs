//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod closed_loop;
mod free_drives;
mod rendering;
mod variations;
