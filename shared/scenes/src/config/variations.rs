//! Variations of a scenario: other views of the dynamic vehicle, and objects that its datasets do not contain.

use super::VehicleKind;
use super::values::{Colour, colour, heading, point3, size3};
use schemars::JsonSchema;
use serde::Deserialize;

/// Use of a variation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum VariationRole {
    /// A training may use it.
    Trained,
    /// No training may use it: tests measure what a model does without having seen it.
    HeldOut,
}

/// A vehicle that may replace the dynamic vehicle. Places, cameras and all other things stay
/// the same.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AppearanceConfig {
    /// Name of the appearance.
    pub name: String,
    /// `pickup`, `car`, `van` or `block`.
    pub kind: VehicleKind,
    /// Colour of the body, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// Length, width, height.
    #[serde(deserialize_with = "size3")]
    pub size_m: [f64; 3],
    /// Rotation about +Z, added to the vehicle's yaw at each of its places, -180 to 180.
    #[serde(default, deserialize_with = "heading")]
    #[schemars(range(min = -180.0, max = 180.0))]
    pub heading_deg: f64,
    /// `trained` or `held-out`.
    pub role: VariationRole,
}

/// Kinds of bystanders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum BystanderKind {
    /// A wooden crate with battens.
    Crate,
    /// The trunk of a fallen tree.
    Trunk,
    /// A standing person.
    Pedestrian,
    /// A bicycle without a rider.
    Bicycle,
    /// An animal on four legs.
    Animal,
    /// An upright barrel with a band.
    Barrel,
    /// A board on two posts; it faces along its yaw.
    Board,
}

impl BystanderKind {
    /// All kinds.
    pub const ALL: [Self; 7] =
        [Self::Crate, Self::Trunk, Self::Pedestrian, Self::Bicycle, Self::Animal, Self::Barrel, Self::Board];

    /// Returns the name in scenario files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Crate => "crate",
            Self::Trunk => "trunk",
            Self::Pedestrian => "pedestrian",
            Self::Bicycle => "bicycle",
            Self::Animal => "animal",
            Self::Barrel => "barrel",
            Self::Board => "board",
        }
    }
}

/// Place of a bystander.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum BystanderPlace {
    /// On the road, in the way of traffic.
    Road,
    /// Next to the road, where it is harmless.
    Roadside,
}

/// An object that can be added to the scenario, and that datasets and free poses do not contain otherwise.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BystanderConfig {
    /// Name of the object among the boxes.
    pub name: String,
    /// `crate`, `trunk`, `pedestrian`, `bicycle`, `animal`, `barrel` or `board`.
    pub kind: BystanderKind,
    /// Position on the ground or on a slab, and yaw in degrees: x, y, yaw.
    #[serde(deserialize_with = "point3")]
    pub at: [f64; 3],
    /// Length, width, height.
    #[serde(deserialize_with = "size3")]
    pub size_m: [f64; 3],
    /// Main colour, `#rrggbb`.
    #[serde(deserialize_with = "colour")]
    #[schemars(with = "Colour")]
    pub colour: [f32; 3],
    /// `road` or `roadside`.
    pub place: BystanderPlace,
    /// `trained` or `held-out`.
    pub role: VariationRole,
}
