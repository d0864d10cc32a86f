//! Training: batches of rays, forward, losses, backward by hand, Adam, and the upkeep of the occupancy grid.

mod backward;
pub(crate) mod batch;
mod finish;
mod forward;
mod losses;
mod occupancy;
pub(crate) mod sampler;
mod shard;
pub(crate) mod state;
pub(crate) mod trainer;

#[cfg(test)]
mod tests;
