//! Vehicles and objects that may move, and what they consist of.

use super::values::{Colour, colour, count, edges, one, point3, pose4, positive, six_colours, size3};
use schemars::JsonSchema;
use serde::Deserialize;
use toml::Spanned;

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
    pub checks: Option<CheckerConfig>,
    /// Colours of its faces.
    pub faces: Option<FacesConfig>,
    /// Variants of the object with this part. Default: all.
    #[serde(default)]
    pub variants: Vec<String>,
}

/// A checkerboard with a second colour.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CheckerConfig {
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
