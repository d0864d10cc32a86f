//! The scenario file: static objects, moving actors per branch, and cameras. All lengths are metres, all angles
//! degrees, +Z is up, and the ground is z = 0. Unknown keys and values out of range are errors.

mod closed_loop;
mod variations;

pub use closed_loop::ClosedLoopConfig;
pub use variations::{AppearanceConfig, BystanderConfig, BystanderKind, BystanderPlace, VariationRole};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use std::borrow::Cow;
use toml::Spanned;

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
    /// Index of the camera pose that looks straight down.
    #[schemars(with = "Option<usize>")]
    pub bev_view: Option<Spanned<usize>>,
    /// Names of the actions.
    #[serde(default)]
    pub actions: ActionsConfig,
    /// Size and field of view of all images.
    #[serde(default)]
    pub picture: PictureConfig,
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
    /// Drives in which the ego moves by its controller's actions (`carff drive`).
    pub closed_loop: Option<ClosedLoopConfig>,
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
pub struct PictureConfig {
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

impl Default for PictureConfig {
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

/// A straight strip of asphalt.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RoadConfig {
    /// Start of its centre line (x, y).
    #[serde(deserialize_with = "point2")]
    pub from: [f64; 2],
    /// End of its centre line (x, y).
    #[serde(deserialize_with = "point2")]
    pub to: [f64; 2],
    /// Width of the strip.
    #[serde(deserialize_with = "positive")]
    pub width_m: f64,
}

/// A straight strip of paint: solid, dashed, or a zebra crossing (wide, with short dashes).
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MarkingConfig {
    /// Start of its centre line (x, y).
    #[serde(deserialize_with = "point2")]
    pub from: [f64; 2],
    /// End of its centre line (x, y).
    #[serde(deserialize_with = "point2")]
    pub to: [f64; 2],
    /// Width of the strip.
    #[serde(deserialize_with = "positive")]
    pub width_m: f64,
    /// Length of a dash; 0 for a solid line.
    #[serde(default, deserialize_with = "not_negative")]
    pub dash_m: f64,
    /// Length of a gap.
    #[serde(default, deserialize_with = "not_negative")]
    pub gap_m: f64,
    /// Colour of the paint, `#rrggbb`.
    #[serde(default = "default_marking", deserialize_with = "colour")]
    #[schemars(with = "Colour", extend("default" = "#e4e4de"))]
    pub colour: [f32; 3],
}

/// Surface of the open ground.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum GroundSurface {
    /// Grass.
    #[default]
    Grass,
    /// A single colour.
    Plain,
}

/// Surface of a slab.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SlabSurface {
    /// Concrete slabs.
    Pavement,
    /// Grass.
    Grass,
}

/// A raised slab, aligned with the axes.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SlabConfig {
    /// Lower corner (x, y).
    #[serde(deserialize_with = "point2")]
    pub min: [f64; 2],
    /// Upper corner (x, y).
    #[serde(deserialize_with = "point2")]
    pub max: [f64; 2],
    /// Height of the slab.
    #[serde(deserialize_with = "positive")]
    pub height_m: f64,
    /// `pavement` or `grass`.
    pub surface: SlabSurface,
}

/// Material of walls.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Walls {
    /// Rows of bricks.
    Brick,
    /// Smooth plaster.
    Plaster,
}

/// Shape of a roof.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Roof {
    /// Flat, with a parapet.
    Flat,
    /// Two slopes; the ridge runs along X.
    Gable,
}

/// Wall that contains a door.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// The +X wall.
    East,
    /// The +Y wall.
    North,
    /// The -X wall.
    West,
    /// The -Y wall.
    South,
}

/// A building, aligned with the axes.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BuildingConfig {
    /// Name of the building among the static boxes.
    pub name: String,
    /// Lower corner (x, y).
    #[serde(deserialize_with = "point2")]
    pub min: [f64; 2],
    /// Upper corner (x, y).
    #[serde(deserialize_with = "point2")]
    pub max: [f64; 2],
    /// Height of the walls.
    #[serde(deserialize_with = "positive")]
    pub height_m: f64,
    /// Number of rows of windows, 1 to 64.
    #[serde(default = "one", deserialize_with = "count")]
    #[schemars(range(min = 1, max = 64))]
    pub storeys: usize,
    /// `brick` or `plaster`.
    pub walls: Walls,
    /// Colour of the walls, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// Colour of frames and edges, `#rrggbb`.
    #[serde(default = "default_trim", deserialize_with = "colour")]
    #[schemars(with = "Colour", extend("default" = "#d8d2c4"))]
    pub trim: [f32; 3],
    /// `flat` or `gable`.
    #[serde(default = "flat")]
    pub roof: Roof,
    /// Wall with the door: `east`, `north`, `west` or `south`.
    #[serde(default = "north")]
    pub door: Side,
}

/// Kinds of trees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TreeKind {
    /// A trunk under a crown.
    Round,
    /// Cones on a trunk.
    Conifer,
    /// Leaves down to the ground.
    Bush,
}

/// A tree on the ground.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TreeConfig {
    /// Position of the trunk (x, y).
    #[serde(deserialize_with = "point2")]
    pub at: [f64; 2],
    /// Height of the tree.
    #[serde(deserialize_with = "positive")]
    pub height_m: f64,
    /// `round`, `conifer` or `bush`.
    pub kind: TreeKind,
}

/// Kinds of street furniture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PropKind {
    /// A lamp post, 5 m; its arm points along its yaw.
    Lamp,
    /// A bench.
    Bench,
    /// A litter bin.
    Bin,
    /// A fire hydrant.
    Hydrant,
    /// A traffic cone.
    Cone,
    /// A stop sign; it faces along its yaw.
    Stop,
}

/// A piece of street furniture.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PropConfig {
    /// `lamp`, `bench`, `bin`, `hydrant`, `cone` or `stop`.
    pub kind: PropKind,
    /// Position on the ground (x, y).
    #[serde(deserialize_with = "point2")]
    pub at: [f64; 2],
    /// Rotation about +Z.
    #[serde(default, deserialize_with = "finite")]
    pub yaw_deg: f64,
}

/// Kinds of vehicles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum VehicleKind {
    /// An open bed behind a cabin.
    Pickup,
    /// A hatchback.
    Car,
    /// A van.
    Van,
    /// A plain cuboid, for tests and abstract scenes.
    Block,
}

/// A vehicle with its courses.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Name of the vehicle among the boxes.
    pub name: String,
    /// Role of the vehicle: `ego`, `actor`, or any other word.
    pub role: String,
    /// `pickup`, `car`, `van` or `block`.
    pub kind: VehicleKind,
    /// Colour of the body, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// Length, width, height.
    #[serde(deserialize_with = "size3")]
    pub size_m: [f64; 3],
    /// True if its presence or motion is the subject of the forecast. At most one vehicle is dynamic.
    #[serde(default)]
    pub dynamic: bool,
    /// Poses of the vehicle. In branches without a course, it is absent.
    pub course: Vec<CourseConfig>,
    /// Rotation of the body about +Z, added to the yaw of its poses: not a key, but part of an appearance.
    #[serde(skip)]
    pub heading_deg: f64,
}

/// Poses of a vehicle in some branches.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CourseConfig {
    /// Names of the branches.
    #[schemars(with = "Vec<String>")]
    pub branches: Vec<Spanned<String>>,
    /// One [x, y, yaw in degrees] per time step.
    #[schemars(with = "Vec<[f64; 3]>")]
    pub poses: Spanned<Vec<[f64; 3]>>,
}

/// An object made of simple shapes. Their positions are in the object's own axes: +X ahead, +Y left, +Z up.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectConfig {
    /// Name of the object among the boxes.
    pub name: String,
    /// Role of the object: `actor`, `static`, or any other word.
    pub role: String,
    /// True if its presence or motion is the subject of the forecast. At most one vehicle or object is dynamic.
    #[serde(default)]
    pub dynamic: bool,
    /// Name of the dynamic object whose presence this object shares, as an arm shares its hand's.
    #[schemars(with = "Option<String>")]
    pub follows: Option<Spanned<String>>,
    /// Constant pose of an object without a course: x, y, z, yaw in degrees.
    #[serde(default, deserialize_with = "pose4")]
    pub at: [f64; 4],
    /// Cuboids of the object.
    #[serde(default, rename = "box")]
    pub boxes: Vec<BoxConfig>,
    /// Ellipsoids of the object.
    #[serde(default)]
    pub ellipsoid: Vec<EllipsoidConfig>,
    /// Cylinders of the object.
    #[serde(default)]
    pub cylinder: Vec<RodConfig>,
    /// Cylinders with round ends.
    #[serde(default)]
    pub capsule: Vec<RodConfig>,
    /// Poses of the object. In branches without a course, it is absent.
    #[serde(default)]
    pub course: Vec<ObjectCourseConfig>,
}

/// A cuboid with its colours.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BoxConfig {
    /// Centre of the cuboid.
    #[serde(deserialize_with = "point3")]
    pub center: [f64; 3],
    /// Lengths of its edges.
    #[serde(deserialize_with = "edges")]
    pub size_m: [f64; 3],
    /// Yaw about +Z, pitch (nose down) and roll (left side up), one after the other.
    #[serde(default, deserialize_with = "point3")]
    pub turn_deg: [f64; 3],
    /// Colour of the cuboid, `#rrggbb`; with `faces`, colour of the joints.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// A second colour, as a checkerboard.
    pub checks: Option<ChecksConfig>,
    /// Colours of its faces.
    pub faces: Option<FacesConfig>,
    /// Variants of the object with this part. Default: all.
    #[serde(default)]
    pub variants: Vec<String>,
}

/// A checkerboard with a second colour.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ChecksConfig {
    /// The second colour, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// Edge length of a square.
    #[serde(deserialize_with = "positive")]
    pub size_m: f64,
}

/// Colours of the six faces of a cuboid.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FacesConfig {
    /// Colours of +X, -X, +Y, -Y, +Z, -Z, each `#rrggbb`.
    #[serde(deserialize_with = "six_colours")]
    #[schemars(with = "[Colour; 6]")]
    pub colours: [[f32; 3]; 6],
    /// Number of squares along each edge, 1 to 64.
    #[serde(default = "one", deserialize_with = "count")]
    #[schemars(range(min = 1, max = 64))]
    pub tiles: usize,
}

/// An ellipsoid with its colour.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EllipsoidConfig {
    /// Centre of the ellipsoid.
    #[serde(deserialize_with = "point3")]
    pub center: [f64; 3],
    /// Diameters along its axes.
    #[serde(deserialize_with = "edges")]
    pub size_m: [f64; 3],
    /// Yaw about +Z, pitch (nose down) and roll (left side up), one after the other.
    #[serde(default, deserialize_with = "point3")]
    pub turn_deg: [f64; 3],
    /// Colour of the ellipsoid, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// Variants of the object with this part. Default: all.
    #[serde(default)]
    pub variants: Vec<String>,
}

/// A cylinder or capsule.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RodConfig {
    /// Start of the axis, without a capsule's round end.
    #[serde(deserialize_with = "point3")]
    pub from: [f64; 3],
    /// End of the axis.
    #[serde(deserialize_with = "point3")]
    pub to: [f64; 3],
    /// Radius of the cylinder.
    #[serde(deserialize_with = "positive")]
    pub radius_m: f64,
    /// Colour of the cylinder, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// Variants of the object with this part. Default: all.
    #[serde(default)]
    pub variants: Vec<String>,
}

/// Poses of an object in some branches.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectCourseConfig {
    /// Names of the branches.
    #[schemars(with = "Vec<String>")]
    pub branches: Vec<Spanned<String>>,
    /// One [x, y, z, yaw in degrees] per time step.
    #[schemars(with = "Vec<[f64; 4]>")]
    pub poses: Spanned<Vec<[f64; 4]>>,
    /// One variant per time step: it selects the object's parts. Default: only parts without a variant.
    #[schemars(with = "Option<Vec<String>>")]
    pub variants: Option<Spanned<Vec<String>>>,
}

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

/// Format of colours, for the schema.
enum Colour {}

impl JsonSchema for Colour {
    fn schema_name() -> Cow<'static, str> {
        "Colour".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": "^#[0-9a-fA-F]{6}$" })
    }
}

fn default_ground() -> [f32; 3] {
    parse_colour("#5d8a3c").unwrap_or([0.1; 3])
}

fn default_marking() -> [f32; 3] {
    parse_colour("#e4e4de").unwrap_or([0.8; 3])
}

fn default_trim() -> [f32; 3] {
    parse_colour("#d8d2c4").unwrap_or([0.7; 3])
}

fn default_clearance() -> f64 {
    0.45
}

fn default_shade_reach() -> f64 {
    1.6
}

fn one() -> usize {
    1
}

fn flat() -> Roof {
    Roof::Flat
}

fn north() -> Side {
    Side::North
}

/// Parses `#rrggbb` in sRGB into linear RGB.
fn parse_colour(text: &str) -> Option<[f32; 3]> {
    let digits = text.strip_prefix('#').filter(|d| d.len() == 6 && d.is_ascii())?;
    let mut rgb = [0.0; 3];
    for (i, value) in rgb.iter_mut().enumerate() {
        let byte = u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).ok()?;
        let c = f32::from(byte) / 255.0;
        *value = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
    }
    Some(rgb)
}

fn colour<'de, D: Deserializer<'de>>(d: D) -> Result<[f32; 3], D::Error> {
    let text = String::deserialize(d)?;
    parse_colour(&text).ok_or_else(|| D::Error::custom(format!("`{text}` is not a colour; write `#rrggbb`")))
}

fn six_colours<'de, D: Deserializer<'de>>(d: D) -> Result<[[f32; 3]; 6], D::Error> {
    let texts = <[String; 6]>::deserialize(d)?;
    let mut colours = [[0.0; 3]; 6];
    for (colour, text) in colours.iter_mut().zip(&texts) {
        *colour =
            parse_colour(text).ok_or_else(|| D::Error::custom(format!("`{text}` is not a colour; write `#rrggbb`")))?;
    }
    Ok(colours)
}

fn in_range<'de, D: Deserializer<'de>>(d: D, low: f64, high: f64, what: &str) -> Result<f64, D::Error> {
    let value = f64::deserialize(d)?;
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is out of range; {what} from {low} to {high} is allowed")))
    }
}

fn finite<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, -1e6, 1e6, "a number")
}

fn positive<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 1e-3, 1e4, "a length")
}

fn not_negative<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 0.0, 1e4, "a length")
}

fn field_of_view<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 5.0, 150.0, "an angle")
}

fn elevation<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 5.0, 90.0, "an angle")
}

fn softness<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 0.0, 10.0, "an angle")
}

fn heading<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, -180.0, 180.0, "an angle")
}

fn duration<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    in_range(d, 0.001, 3600.0, "a duration").map(Some)
}

fn whole<'de, D: Deserializer<'de>>(d: D, low: i64, high: i64) -> Result<i64, D::Error> {
    let value = i64::deserialize(d)?;
    if (low..=high).contains(&value) {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value} is out of range; a whole number from {low} to {high} is allowed")))
    }
}

fn count<'de, D: Deserializer<'de>>(d: D) -> Result<usize, D::Error> {
    whole(d, 1, 64).map(|v| v as usize)
}

fn many<'de, D: Deserializer<'de>>(d: D) -> Result<usize, D::Error> {
    whole(d, 1, 10_000).map(|v| v as usize)
}

fn side<'de, D: Deserializer<'de>>(d: D) -> Result<u32, D::Error> {
    whole(d, 8, 4096).map(|v| v as u32)
}

fn vector<'de, D: Deserializer<'de>, const N: usize>(d: D) -> Result<[f64; N], D::Error>
where
    [f64; N]: Deserialize<'de>,
{
    let value = <[f64; N]>::deserialize(d)?;
    if value.iter().all(|v| v.abs() <= 1e5) {
        Ok(value)
    } else {
        Err(D::Error::custom("a coordinate is out of range; -100000 to 100000 is allowed"))
    }
}

fn point2<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 2], D::Error> {
    vector(d)
}

fn point3<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 3], D::Error> {
    vector(d)
}

fn pose4<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 4], D::Error> {
    vector(d)
}

fn edges<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 3], D::Error> {
    let size = vector(d)?;
    if size.iter().all(|v| (1e-3..=1e4).contains(v)) {
        Ok(size)
    } else {
        Err(D::Error::custom("a length is out of range; 0.001 to 10000 is allowed"))
    }
}

fn clearance<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 1e-3, 100.0, "a length")
}

fn size3<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 3], D::Error> {
    let size = vector(d)?;
    if size.iter().all(|v| (0.1..=100.0).contains(v)) {
        Ok(size)
    } else {
        Err(D::Error::custom("a size is out of range; 0.1 to 100 is allowed"))
    }
}

fn range<'de, D: Deserializer<'de>>(d: D) -> Result<[f64; 2], D::Error> {
    let value: [f64; 2] = vector(d)?;
    if value[0] <= value[1] { Ok(value) } else { Err(D::Error::custom("the lowest value must come first")) }
}

fn box3<'de, D: Deserializer<'de>>(d: D) -> Result<[[f64; 3]; 2], D::Error> {
    let value = <[[f64; 3]; 2]>::deserialize(d)?;
    if !value.iter().flatten().all(|v| v.abs() <= 1e5) {
        return Err(D::Error::custom("a coordinate is out of range; -100000 to 100000 is allowed"));
    }
    if (0..3).all(|i| value[0][i] <= value[1][i]) {
        Ok(value)
    } else {
        Err(D::Error::custom("the first corner must not be above the second along any axis"))
    }
}
