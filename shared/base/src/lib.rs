//! The ground of all crates: plain mathematics and words, without a message, a file format or a process.
//!
//! | module | content |
//! |---|---|
//! | [`geometry`] | cameras, rays and boxes, with their spaces and units |
//! | [`random`] | random streams that are named by what they are drawn for |
//! | [`statistics`] | percentiles, intervals and PSNR |
//! | [`names`] | suggestions for names that do not exist |
//! | [`errors`] | an error and its causes as one sentence |

pub mod errors;
pub mod geometry;
pub mod names;
pub mod random;
pub mod statistics;
