//! Marching: samples along rays, their densities and weights.

pub(crate) mod ray_samples;
pub(crate) mod samples;
