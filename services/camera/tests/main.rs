//! The integration tests of this crate, as one program: each further one links the whole crate again.

mod drives;
mod free_drives;
#[cfg(feature = "video")]
mod video;
