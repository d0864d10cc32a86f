//! The inner loops, as plain generic bodies that vectorise when they are compiled for a wide instruction set.
//!
//! Callers go through [`dispatch`], which picks the version for the processor at run time.

#![allow(
    clippy::needless_range_loop,
    reason = "loops over lanes by index are the form that vectorises, and all of a loop's arrays read alike"
)]

pub(crate) mod activation;
pub(crate) mod adam;
pub(crate) mod bf16;
pub(crate) mod block;
pub(crate) mod dense;
pub(crate) mod dispatch;
pub(crate) mod hash_grid;
pub(crate) mod math;
mod prefetch;
pub(crate) mod traverse;
