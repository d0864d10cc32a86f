//! The scenario file: static objects, moving actors per branch, and cameras. All lengths are metres, all angles
//! degrees, +Z is up, and the ground is z = 0. Unknown keys and values out of range are errors.

mod cameras;
mod closed_loop;
mod movers;
mod scenery;
mod values;
mod variations;

pub use cameras::{DashConfig, OrbitConfig, OverheadConfig, StreetConfig};
pub use closed_loop::ClosedLoopConfig;
pub use movers::{
    BoxConfig, CheckerConfig, CourseConfig, EllipsoidConfig, FacesConfig, ObjectConfig, ObjectCourseConfig, RodConfig,
    VehicleConfig, VehicleKind,
};
pub use scenery::{
    BuildingConfig, GroundSurface, MarkingConfig, PropConfig, PropKind, RoadConfig, Roof, Side, SlabConfig,
    SlabSurface, TreeConfig, TreeKind, Walls,
};
pub use variations::{AppearanceConfig, BystanderConfig, BystanderKind, BystanderPlace, VariationRole};

use schemars::JsonSchema;
use serde::Deserialize;
use toml::Spanned;
use values::{
    Colour, box3, clearance, colour, count, default_clearance, default_ground, default_shade_reach, duration,
    elevation, field_of_view, finite, first_timestamp, side, softness,
};

/// A scenario file.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScenarioConfig {
    /// Name of the scenario, as it appears in datasets and checkpoints.
    pub name: String,
    /// Lower and upper corner of the region of interest, metres.
    #[serde(deserialize_with = "box3")]
    pub bounds_m: [[f64; 3]; 2],
    /// Number of time steps of each branch, 1 to 64.
    #[serde(deserialize_with = "count")]
    #[schemars(range(min = 1, max = 64))]
    pub timestamps: usize,
    /// Duration of a time step, seconds: how long the belief of a real camera's images stays at a state.
    #[serde(default, deserialize_with = "duration")]
    #[schemars(range(min = 0.001, max = 3600.0))]
    pub step_s: Option<f64>,
    /// Names of the branches.
    pub branches: Vec<String>,
    /// Names of the branches in which the hazard action is right.
    #[serde(default)]
    #[schemars(with = "Vec<String>")]
    pub hazard_branches: Vec<Spanned<String>>,
    /// First time step at which a hazard branch is a hazard, below `timestamps`: before it, the actor has not reached the
    /// place where it matters. A look-ahead that ends earlier does not meet the hazard.
    #[serde(default = "first_timestamp")]
    #[schemars(with = "usize", range(max = 63), extend("default" = 0))]
    pub hazard_from_timestamp: Spanned<usize>,
    /// Index of the camera pose that looks straight down.
    #[schemars(with = "Option<usize>")]
    pub bev_view: Option<Spanned<usize>>,
    /// Names of the actions.
    #[serde(default)]
    pub actions: ActionsConfig,
    /// Size and field of view of all images. The earlier name `picture` is read too.
    #[serde(default, alias = "picture")]
    pub image: ImageConfig,
    /// Direction and size of the sun.
    #[serde(default)]
    pub sun: SunConfig,
    /// Colour of the open ground, `#rrggbb`.
    #[serde(default = "default_ground", deserialize_with = "colour")]
    #[schemars(with = "Colour", extend("default" = "#5d8a3c"))]
    pub ground_colour: [f32; 3],
    /// Surface of the open ground: `grass` or `plain`.
    #[serde(default)]
    pub ground_surface: GroundSurface,
    /// Asphalt strips on the ground.
    #[serde(default)]
    pub road: Vec<RoadConfig>,
    /// Paint on the roads.
    #[serde(default)]
    pub marking: Vec<MarkingConfig>,
    /// Raised slabs: pavements, verges, islands.
    #[serde(default)]
    pub slab: Vec<SlabConfig>,
    /// Buildings of the scenario.
    #[serde(default)]
    pub building: Vec<BuildingConfig>,
    /// Trees of the scenario.
    #[serde(default)]
    pub tree: Vec<TreeConfig>,
    /// Street furniture of the scenario.
    #[serde(default)]
    pub prop: Vec<PropConfig>,
    /// Moving and parked vehicles.
    #[serde(default)]
    pub vehicle: Vec<VehicleConfig>,
    /// Objects made of simple shapes, static or moving.
    #[serde(default)]
    pub object: Vec<ObjectConfig>,
    /// Vehicles that may replace the dynamic vehicle. Datasets and free poses show none of them unless one is chosen.
    #[serde(default)]
    pub appearance: Vec<AppearanceConfig>,
    /// Objects that can be added on the road or next to it. Datasets and free poses show none of them unless one is
    /// added.
    #[serde(default)]
    pub bystander: Vec<BystanderConfig>,
    /// Drives in which the ego moves by its controller's actions (`carff drive`), one table for each route.
    #[serde(default, deserialize_with = "closed_loop::routes")]
    pub closed_loop: Vec<ClosedLoopConfig>,
    /// Minimum distance of cameras from static things, 0.001 to 100.
    #[serde(default = "default_clearance", deserialize_with = "clearance")]
    #[schemars(range(min = 0.001, max = 100.0))]
    pub clearance_m: f64,
    /// Range of ambient occlusion: things within this distance block light from the sky. About the size of objects that
    /// cast soft shadows, 0.001 to 100.
    #[serde(default = "default_shade_reach", deserialize_with = "clearance")]
    #[schemars(range(min = 0.001, max = 100.0))]
    pub shade_reach_m: f64,
    /// Cameras on a dome that look inwards. Views are numbered in the order orbit, overhead, dash, street.
    #[serde(default)]
    pub orbit: Vec<OrbitConfig>,
    /// Cameras high above that look down.
    #[serde(default)]
    pub overhead: Vec<OverheadConfig>,
    /// Cameras above a vehicle's roof, at each of its positions.
    #[serde(default)]
    pub dash: Vec<DashConfig>,
    /// Cameras spread over a region that look at another region.
    #[serde(default)]
    pub street: Vec<StreetConfig>,
}

/// Names of the actions.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ActionsConfig {
    /// Action in a hazard branch.
    pub hazard: String,
    /// Action in all other branches.
    pub clear: String,
}

impl Default for ActionsConfig {
    fn default() -> Self {
        Self { hazard: "halt".to_owned(), clear: "advance".to_owned() }
    }
}

/// Size and field of view of all images.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ImageConfig {
    /// Width, pixels, 8 to 4096.
    #[serde(deserialize_with = "side")]
    #[schemars(range(min = 8, max = 4096))]
    pub width_px: u32,
    /// Height, pixels, 8 to 4096.
    #[serde(deserialize_with = "side")]
    #[schemars(range(min = 8, max = 4096))]
    pub height_px: u32,
    /// Horizontal field of view, degrees, 5 to 150.
    #[serde(deserialize_with = "field_of_view")]
    #[schemars(range(min = 5.0, max = 150.0))]
    pub fov_deg: f64,
}

impl Default for ImageConfig {
    fn default() -> Self {
        Self { width_px: 128, height_px: 128, fov_deg: 60.0 }
    }
}

/// Direction and size of the sun.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SunConfig {
    /// Direction to the sun, from +X towards +Y.
    #[serde(deserialize_with = "finite")]
    pub azimuth_deg: f64,
    /// Elevation above the horizon, 5 to 90.
    #[serde(deserialize_with = "elevation")]
    #[schemars(range(min = 5.0, max = 90.0))]
    pub elevation_deg: f64,
    /// Apparent radius: a larger radius makes softer shadows. 0 to 10 (the real radius is 0.27).
    #[serde(deserialize_with = "softness")]
    #[schemars(range(min = 0.0, max = 10.0))]
    pub radius_deg: f64,
}

impl Default for SunConfig {
    fn default() -> Self {
        Self { azimuth_deg: 50.0, elevation_deg: 50.0, radius_deg: 1.5 }
    }
}
