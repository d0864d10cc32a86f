//! The base of all crates: mathematics and texts, without messages, file formats or processes.
//!
//! | module | content |
//! |---|---|
//! | [`geometry`] | cameras, rays and boxes, with their spaces and units |
//! | [`linear`] | small systems of equations |
//! | [`random`] | random streams, named by their purpose |
//! | [`statistics`] | percentiles, intervals and PSNR |
//! | [`names`] | suggestions for unknown names |
//! | [`errors`] | an error and its causes as one sentence |
//! | [`files`] | checks of output files |

pub mod errors;
pub mod files;
pub mod geometry;
pub mod linear;
pub mod names;
pub mod random;
pub mod statistics;
