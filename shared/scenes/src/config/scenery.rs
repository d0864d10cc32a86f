//! Roads, buildings and other things that never move.

use super::values::{
    Colour, colour, count, default_marking, default_trim, finite, not_negative, one, point2, positive,
};
use schemars::JsonSchema;
use serde::Deserialize;

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

fn flat() -> Roof {
    Roof::Flat
}

fn north() -> Side {
    Side::North
}
