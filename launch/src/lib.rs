//! The commands that start graphs: launch, replay and soak; datasets, schemas, the doctor, and the options of all other
//! commands. Never linked with libtorch.
//!
//! The crate `carff` contains the commands that observe a run, and the crate `carff-lab` those that compute with
//! libtorch.

#![warn(clippy::print_stderr, reason = "`eprintln!` panics where standard error is full: `carff::say` does not")]

#[cfg(feature = "recording")]
mod bag;
pub mod checkpoint;
pub mod command;
pub mod dataset;
mod decisions;
pub mod doctor;
pub mod drive;
pub mod lab;
pub mod launch;
pub mod planning;
#[cfg(feature = "recording")]
pub mod replay;
pub mod report;
pub mod schema;
pub mod shell;
#[cfg(feature = "recording")]
pub mod soak;
pub mod supervision;

/// Nanoseconds of a millisecond, and of a second.
pub(crate) const NS_PER_MS: u64 = 1_000_000;
pub(crate) const NS_PER_S: u64 = 1_000_000_000;
