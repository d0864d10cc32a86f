//! Step sizes along rays.

use super::contraction::Contraction;
use crate::config::FieldConfig;

/// Step sizes and limits of rays, metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Marcher {
    /// Least step inside the bounds.
    pub step_m: f32,
    /// The step is at least this times the distance.
    pub cone: f32,
    /// Distance at which rays start.
    pub near_m: f32,
    /// Distance at which rays end.
    pub far_m: f32,
    /// Half the longest extent of the bounds.
    half_m: f32,
}

impl Marcher {
    /// Makes the step sizes of a configuration.
    pub fn new(config: &FieldConfig, contraction: Contraction) -> Self {
        Self {
            step_m: 2.0 * contraction.longest_half_m() / config.samples_across,
            half_m: contraction.longest_half_m(),
            cone: config.cone_angle,
            near_m: config.near_m,
            far_m: config.far_m,
        }
    }

    /// Maps a distance to 0..1, so that far and near count alike: t / (t + half the longest extent).
    pub fn bounded(&self, distance_m: f32) -> f32 {
        distance_m / (distance_m + self.half_m)
    }
}
