//! Closed-loop drives: the ego's way, its camera, and the vehicles that may come.

use super::values::{clearance, in_range, range, vector, whole};
use schemars::JsonSchema;
use serde::de::{Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::fmt;

/// A route on which the ego moves by its controller's actions.
///
/// Other vehicles look like the dynamic vehicle and follow the line of its course in the first hazard branch, extended
/// in both directions, each at a constant speed. Starts and speeds are drawn from continuous ranges.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ClosedLoopConfig {
    /// Name of the route, for `carff drive --route`.
    pub name: String,
    /// The route of the ego's centre: x and y of 2 to 64 points. A drive ends at the last one.
    #[serde(deserialize_with = "way")]
    #[schemars(length(min = 2, max = 64))]
    pub path: Vec<[f64; 2]>,
    /// Speed limit of the ego and its speed at the start, m/s, 0.1 to 60.
    #[serde(deserialize_with = "speed")]
    #[schemars(range(min = 0.1, max = 60.0))]
    pub speed_mps: f64,
    /// Lowest and highest number of other vehicles, 0 to 3; each number is equally probable.
    #[serde(deserialize_with = "actor_counts")]
    pub actors: [u32; 2],
    /// Place of the first vehicle at the start, as distance beyond the first pose of the dynamic vehicle's course, metres.
    #[serde(deserialize_with = "range")]
    pub actor_start_m: [f64; 2],
    /// Space between a vehicle and the one behind it, metres.
    #[serde(deserialize_with = "range")]
    pub actor_gap_m: [f64; 2],
    /// Speeds of the other vehicles, m/s; none is faster than the one ahead of it.
    #[serde(deserialize_with = "range")]
    pub actor_speed_mps: [f64; 2],
    /// Direction of the camera on the ego's roof, degrees to the left.
    #[serde(deserialize_with = "range")]
    pub camera_left_deg: [f64; 2],
    /// Space that the ego keeps to the lane of the others while it waits, metres, 0.001 to 100. Default 0.3.
    #[serde(default = "default_space", deserialize_with = "clearance")]
    #[schemars(range(min = 0.001, max = 100.0))]
    pub space_m: f64,
    /// Time after which a drive that has not arrived ends, seconds, 1 to 600. Default 40.
    #[serde(default = "default_limit", deserialize_with = "limit")]
    #[schemars(range(min = 1.0, max = 600.0))]
    pub limit_s: f64,
}

/// Reads the list of routes; its error names the form.
pub(super) fn routes<'de, D: Deserializer<'de>>(d: D) -> Result<Vec<ClosedLoopConfig>, D::Error> {
    struct Routes;
    impl<'de> Visitor<'de> for Routes {
        type Value = Vec<ClosedLoopConfig>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a list of routes: `[[closed_loop]]`, each with a `name`")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Self::Value, A::Error> {
            let mut routes = Vec::new();
            while let Some(route) = list.next_element()? {
                routes.push(route);
            }
            Ok(routes)
        }
    }
    d.deserialize_seq(Routes)
}

fn default_space() -> f64 {
    0.3
}

fn default_limit() -> f64 {
    40.0
}

fn limit<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 1.0, 600.0, "a duration")
}

fn speed<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    in_range(d, 0.1, 60.0, "a speed")
}

fn actor_counts<'de, D: Deserializer<'de>>(d: D) -> Result<[u32; 2], D::Error> {
    #[derive(Deserialize)]
    struct Count(#[serde(deserialize_with = "count")] u32);
    fn count<'de, D: Deserializer<'de>>(d: D) -> Result<u32, D::Error> {
        whole(d, 0, 3).map(|v| v as u32)
    }
    let [Count(low), Count(high)] = <[Count; 2]>::deserialize(d)?;
    if low <= high { Ok([low, high]) } else { Err(D::Error::custom("the lowest value must come first")) }
}

fn way<'de, D: Deserializer<'de>>(d: D) -> Result<Vec<[f64; 2]>, D::Error> {
    #[derive(Deserialize)]
    struct Point(#[serde(deserialize_with = "vector")] [f64; 2]);
    let points: Vec<[f64; 2]> = Vec::<Point>::deserialize(d)?.into_iter().map(|p| p.0).collect();
    if !(2..=64).contains(&points.len()) {
        return Err(D::Error::custom(format!("{} points; 2 to 64 are allowed", points.len())));
    }
    if points.windows(2).any(|pair| pair[0] == pair[1]) {
        return Err(D::Error::custom("two points that follow each other are equal"));
    }
    Ok(points)
}
