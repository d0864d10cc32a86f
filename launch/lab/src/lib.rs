//! The commands that compute with libtorch: training, evaluation, the ablation, backbones, limits of a checkpoint, and
//! benchmarks against tensor operations. `carff-launch` has their options, and executes this program.

#![warn(clippy::print_stderr, reason = "`eprintln!` panics where standard error is full: `carff::say` does not")]

pub mod ablate;
pub mod backbone;
pub mod bench;
pub mod checkpoint;
pub mod eval;
pub mod reference;
pub mod train;
