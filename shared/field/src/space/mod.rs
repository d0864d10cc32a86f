//! Space: the contraction of the world to the unit cube, the occupancy grid in the cube, and step sizes along rays.

pub(crate) mod contraction;
pub(crate) mod marcher;
pub(crate) mod occupancy;
