//! Where a scenario's fixed cameras stand: evenly spread sequences, no random numbers, and never inside anything.

use carff_geometry::PinholeCamera;
use parry3d::bounding_volume::Aabb;

use crate::config::{DashConfig, OrbitConfig, OverheadConfig, ScenarioConfig, StreetConfig};
use crate::shapes::Vec3;

/// A camera pose of the scenario, with its kind.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioCamera {
    /// Kind of camera, for example `orbit`.
    pub view_kind: String,
    /// Intrinsics and pose.
    pub camera: PinholeCamera,
}

/// Cameras keep this far from static things, metres.
const CLEARANCE_M: f32 = 0.45;
/// Places tried for each camera before giving up.
const MAX_TRIES: usize = 400;

/// Spaces where no camera may be.
pub(crate) struct Obstacles {
    boxes: Vec<Aabb>,
}

impl Obstacles {
    pub fn new(still: impl Iterator<Item = Aabb>, moving: impl Iterator<Item = Aabb>) -> Self {
        let grow = |aabb: Aabb, by: f32| Aabb::new(aabb.mins - Vec3::splat(by), aabb.maxs + Vec3::splat(by));
        Self { boxes: still.map(|a| grow(a, CLEARANCE_M)).chain(moving.map(|a| grow(a, 0.05))).collect() }
    }

    fn clear(&self, at: [f64; 3]) -> bool {
        let p = Vec3::from_array(at.map(|v| v as f32));
        p.z > 0.3
            && !self.boxes.iter().any(|b| {
                p.x > b.mins.x && p.y > b.mins.y && p.z > b.mins.z && p.x < b.maxs.x && p.y < b.maxs.y && p.z < b.maxs.z
            })
    }
}

/// Point `index` of an evenly spread sequence in the unit cube of `N` dimensions (Roberts' generalised golden ratio).
fn spread<const N: usize>(index: usize) -> [f64; N] {
    let mut phi = 2.0_f64;
    for _ in 0..32 {
        phi = (1.0 + phi).powf(1.0 / (N as f64 + 1.0));
    }
    std::array::from_fn(|i| (0.5 + (index as f64 + 1.0) * phi.powi(-(i as i32 + 1))).fract())
}

fn mix(range: [f64; 2], t: f64) -> f64 {
    range[0] + (range[1] - range[0]) * t
}

fn within(region: &[[f64; 3]; 2], t: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| mix([region[0][i], region[1][i]], t[i]))
}

/// All cameras, or the key of the group that found no room.
pub(crate) fn cameras(
    config: &ScenarioConfig,
    obstacles: &Obstacles,
    places: impl Fn(&str) -> Vec<[f64; 3]>,
) -> Result<Vec<ScenarioCamera>, &'static str> {
    let mut all = Vec::new();
    for group in &config.orbit {
        all.extend(orbit(config, group, obstacles).ok_or("orbit")?);
    }
    for group in &config.overhead {
        all.extend(overhead(config, group));
    }
    for group in &config.dash {
        for place in places(group.vehicle.get_ref()) {
            all.extend(dash(config, group, place, obstacles).ok_or("dash")?);
        }
    }
    for group in &config.street {
        all.extend(street(config, group, obstacles).ok_or("street")?);
    }
    Ok(all)
}

fn look(config: &ScenarioConfig, kind: &str, eye: [f64; 3], target: [f64; 3], up: [f64; 3]) -> ScenarioCamera {
    let p = &config.picture;
    let camera = PinholeCamera::look_at(eye, target, up, p.width_px, p.height_px, p.fov_deg);
    ScenarioCamera { view_kind: kind.to_owned(), camera }
}

/// Takes `count` candidates that stand clear, in the order of their index.
fn take_clear(
    count: usize,
    obstacles: &Obstacles,
    candidate: impl Fn(usize) -> ([f64; 3], ScenarioCamera),
) -> Option<Vec<ScenarioCamera>> {
    let found: Vec<_> = (0..count * MAX_TRIES)
        .map(candidate)
        .filter(|(eye, _)| obstacles.clear(*eye))
        .take(count)
        .map(|(_, camera)| camera)
        .collect();
    (found.len() == count).then_some(found)
}

fn orbit(config: &ScenarioConfig, group: &OrbitConfig, obstacles: &Obstacles) -> Option<Vec<ScenarioCamera>> {
    let golden_angle = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    take_clear(group.count, obstacles, |i| {
        let azimuth = i as f64 * golden_angle;
        let [r, e] = spread::<2>(i);
        let radius = mix(group.radius_m, r);
        let elevation = mix(group.elevation_deg, e).to_radians();
        let c = group.center;
        let eye = [
            c[0] + radius * elevation.cos() * azimuth.cos(),
            c[1] + radius * elevation.cos() * azimuth.sin(),
            c[2] + radius * elevation.sin(),
        ];
        (eye, look(config, &group.view_kind, eye, c, [0.0, 0.0, 1.0]))
    })
}

fn overhead(config: &ScenarioConfig, group: &OverheadConfig) -> Vec<ScenarioCamera> {
    let [x, y] = group.center;
    (0..group.count)
        .map(|i| {
            if i == 0 {
                return look(config, &group.view_kind, [x, y, group.height_m], [x, y, 0.0], [0.0, 1.0, 0.0]);
            }
            let [a, b, c] = spread::<3>(i);
            let eye = [
                x + group.spread_m * (2.0 * a - 1.0),
                y + group.spread_m * (2.0 * b - 1.0),
                group.height_m * mix([0.8, 1.0], c),
            ];
            let turn = i as f64 * 1.1;
            look(config, &group.view_kind, eye, [x, y, 0.0], [turn.sin(), turn.cos(), 0.0])
        })
        .collect()
}

fn dash(
    config: &ScenarioConfig,
    group: &DashConfig,
    place: [f64; 3],
    obstacles: &Obstacles,
) -> Option<Vec<ScenarioCamera>> {
    take_clear(group.count_per_place, obstacles, |i| {
        let [f, h, d] = spread::<3>(i);
        let [x, y, yaw] = place;
        // Turned evenly from the lowest to the highest angle, whatever the count.
        let turn = ((i % group.count_per_place) as f64 + 0.5) / group.count_per_place as f64;
        let heading = yaw + mix(group.left_deg, turn).to_radians();
        let down = mix(group.down_deg, d).to_radians();
        let forward = mix(group.forward_m, f);
        let eye = [x + forward * yaw.cos(), y + forward * yaw.sin(), mix(group.height_m, h)];
        let target = [eye[0] + down.cos() * heading.cos(), eye[1] + down.cos() * heading.sin(), eye[2] - down.sin()];
        (eye, look(config, &group.view_kind, eye, target, [0.0, 0.0, 1.0]))
    })
}

fn street(config: &ScenarioConfig, group: &StreetConfig, obstacles: &Obstacles) -> Option<Vec<ScenarioCamera>> {
    take_clear(group.count, obstacles, |i| {
        let eye = within(&group.region, spread::<3>(i));
        let target = within(&group.look_at, spread::<3>(i + 7));
        (eye, look(config, &group.view_kind, eye, target, [0.0, 0.0, 1.0]))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sequence is even: of 64 points, each quarter of the square holds between 12 and 20.
    #[test]
    fn spread_is_even() {
        let mut counts = [0; 4];
        for i in 0..64 {
            let [x, y] = spread::<2>(i);
            assert!((0.0..1.0).contains(&x) && (0.0..1.0).contains(&y));
            counts[usize::from(x > 0.5) * 2 + usize::from(y > 0.5)] += 1;
        }
        assert!(counts.iter().all(|c| (12..=20).contains(c)), "{counts:?}");
    }
}
