//! The camera of rendering benchmarks.

use carff_base::geometry::PinholeCamera;
use carff_field::FieldConfig;

/// Returns a camera straight above the bounds; the image's up is +Y.
pub fn birds_eye(config: &FieldConfig, side_px: u32) -> PinholeCamera {
    let [low, high] = config.bounds_m.map(|corner| corner.map(f64::from));
    let centre = [0, 1, 2].map(|i| f64::midpoint(low[i], high[i]));
    let extent = (high[0] - low[0]).max(high[1] - low[1]);
    let fov_deg = 60.0_f64;
    let height = low[2] + extent / 2.0 / (fov_deg / 2.0).to_radians().tan();
    let eye = [centre[0], centre[1], height];
    PinholeCamera::look_at(eye, [centre[0], centre[1], low[2]], [0.0, 1.0, 0.0], side_px, side_px, fov_deg)
}
