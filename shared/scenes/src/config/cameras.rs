//! Groups of cameras.

use super::values::{box3, many, not_negative, point2, point3, positive, range};
use schemars::JsonSchema;
use serde::Deserialize;
use toml::Spanned;

/// Cameras on a dome, spread by the golden angle.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OrbitConfig {
    /// Kind of these views, as it appears in datasets.
    pub view_kind: String,
    /// Number of cameras, 1 to 10000.
    #[serde(deserialize_with = "many")]
    #[schemars(range(min = 1, max = 10_000))]
    pub count: usize,
    /// Target point of the cameras.
    #[serde(deserialize_with = "point3")]
    pub center: [f64; 3],
    /// Distance from the target, lowest and highest.
    #[serde(deserialize_with = "range")]
    pub radius_m: [f64; 2],
    /// Angle above the horizon, lowest and highest.
    #[serde(deserialize_with = "range")]
    pub elevation_deg: [f64; 2],
}

/// Cameras high above that look down. The first looks straight down from the middle; the image's up is +Y.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OverheadConfig {
    /// Kind of these views, as it appears in datasets.
    pub view_kind: String,
    /// Number of cameras, 1 to 10000.
    #[serde(deserialize_with = "many")]
    #[schemars(range(min = 1, max = 10_000))]
    pub count: usize,
    /// Point on the ground below the first camera (x, y).
    #[serde(deserialize_with = "point2")]
    pub center: [f64; 2],
    /// Height of the first camera.
    #[serde(deserialize_with = "positive")]
    pub height_m: f64,
    /// Maximum horizontal distance of the other cameras from the first.
    #[serde(deserialize_with = "not_negative")]
    pub spread_m: f64,
}

/// Cameras above a vehicle's roof.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DashConfig {
    /// Kind of these views, as it appears in datasets.
    pub view_kind: String,
    /// Name of the vehicle.
    #[schemars(with = "String")]
    pub vehicle: Spanned<String>,
    /// Number of cameras at each of its positions, 1 to 10000.
    #[serde(deserialize_with = "many")]
    #[schemars(range(min = 1, max = 10_000))]
    pub count_per_place: usize,
    /// Distance ahead of the vehicle's centre, lowest and highest.
    #[serde(deserialize_with = "range")]
    pub forward_m: [f64; 2],
    /// Height above the ground, lowest and highest.
    #[serde(deserialize_with = "range")]
    pub height_m: [f64; 2],
    /// Angle left of straight ahead, lowest and highest.
    #[serde(deserialize_with = "range")]
    pub left_deg: [f64; 2],
    /// Angle below the horizon, lowest and highest.
    #[serde(deserialize_with = "range")]
    pub down_deg: [f64; 2],
}

/// Cameras spread over a region that look at another region.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StreetConfig {
    /// Kind of these views, as it appears in datasets.
    pub view_kind: String,
    /// Number of cameras, 1 to 10000.
    #[serde(deserialize_with = "many")]
    #[schemars(range(min = 1, max = 10_000))]
    pub count: usize,
    /// Region of the cameras: lower and upper corner.
    #[serde(deserialize_with = "box3")]
    pub region: [[f64; 3]; 2],
    /// Region of the targets: lower and upper corner.
    #[serde(deserialize_with = "box3")]
    pub look_at: [[f64; 3]; 2],
}
