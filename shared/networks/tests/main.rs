//! The integration tests of this crate, as one program: each further one links the whole crate again.

#[cfg(feature = "import")]
mod importing;
mod round_trip;
