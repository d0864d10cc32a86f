//! Poses of a scenario's cameras, outside all solids. Fixed cameras come from evenly spread sequences, random cameras
//! from the same ranges.

use carff_base::geometry::PinholeCamera;
use carff_base::random::Key;
use parry3d::bounding_volume::Aabb;
use rand::Rng;

use crate::config::{DashConfig, OrbitConfig, OverheadConfig, ScenarioConfig, StreetConfig};
use crate::shapes::Vec3;

/// A camera pose of the scenario, with its kind.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioCamera {
    /// Kind of the camera, for example `orbit`.
    pub view_kind: String,
    /// Intrinsics and pose.
    pub camera: PinholeCamera,
    /// Pose of the ego in the images of this camera: x, y in metres and heading in radians. `None`: the state gives it.
    pub ego_pose: Option<[f64; 3]>,
}

/// Minimum height above the ground, as a share of the clearance from static things.
const ABOVE_GROUND: f32 = 0.3 / 0.45;
/// Minimum distance from moving things, as a share of the same clearance.
const FROM_MOVING: f32 = 0.05 / 0.45;
/// Maximum number of tries per camera.
const MAX_TRIES: usize = 400;

/// Spaces that no camera may enter.
#[derive(Clone)]
pub(crate) struct Obstacles {
    boxes: Vec<Aabb>,
    lowest: f32,
}

impl Obstacles {
    /// Creates the obstacles. `clearance_m` is the clearance from static things.
    pub fn new(clearance_m: f32, still: impl Iterator<Item = Aabb>, moving: impl Iterator<Item = Aabb>) -> Self {
        let grow = |aabb: Aabb, by: f32| Aabb::new(aabb.mins - Vec3::splat(by), aabb.maxs + Vec3::splat(by));
        let still = still.map(|a| grow(a, clearance_m));
        let moving = moving.map(|a| grow(a, FROM_MOVING * clearance_m));
        Self { boxes: still.chain(moving).collect(), lowest: ABOVE_GROUND * clearance_m }
    }

    /// Returns true if a camera may be at a point.
    pub fn clear(&self, at: [f64; 3]) -> bool {
        let p = Vec3::from_array(at.map(|v| v as f32));
        p.z > self.lowest
            && !self.boxes.iter().any(|b| {
                p.x > b.mins.x && p.y > b.mins.y && p.z > b.mins.z && p.x < b.maxs.x && p.y < b.maxs.y && p.z < b.maxs.z
            })
    }
}

/// Returns point `index` of an evenly spread sequence in the unit cube of `N` dimensions (Roberts' generalised golden
/// ratio).
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

/// Returns all cameras, or the key of the group without enough space.
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
    let p = &config.image;
    let camera = PinholeCamera::look_at(eye, target, up, p.width_px, p.height_px, p.fov_deg);
    ScenarioCamera { view_kind: kind.to_owned(), camera, ego_pose: None }
}

/// A camera with its position.
type Candidate = ([f64; 3], ScenarioCamera);

/// Takes the first `count` candidates without obstacles, in the order of their index.
fn take_clear(
    count: usize,
    obstacles: &Obstacles,
    candidate: impl Fn(usize) -> Candidate,
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
    take_clear(group.count, obstacles, |i| orbit_at(config, group, i as f64 * golden_angle, spread(i)))
}

fn orbit_at(config: &ScenarioConfig, group: &OrbitConfig, azimuth: f64, [r, e]: [f64; 2]) -> Candidate {
    let radius = mix(group.radius_m, r);
    let elevation = mix(group.elevation_deg, e).to_radians();
    let c = group.center;
    let eye = [
        c[0] + radius * elevation.cos() * azimuth.cos(),
        c[1] + radius * elevation.cos() * azimuth.sin(),
        c[2] + radius * elevation.sin(),
    ];
    (eye, look(config, &group.view_kind, eye, c, [0.0, 0.0, 1.0]))
}

fn overhead(config: &ScenarioConfig, group: &OverheadConfig) -> Vec<ScenarioCamera> {
    let [x, y] = group.center;
    (0..group.count)
        .map(|i| match i {
            0 => look(config, &group.view_kind, [x, y, group.height_m], [x, y, 0.0], [0.0, 1.0, 0.0]),
            _ => overhead_at(config, group, i as f64 * 1.1, spread(i)).1,
        })
        .collect()
}

fn overhead_at(config: &ScenarioConfig, group: &OverheadConfig, turn: f64, [a, b, c]: [f64; 3]) -> Candidate {
    let [x, y] = group.center;
    let eye = [
        x + group.spread_m * (2.0 * a - 1.0),
        y + group.spread_m * (2.0 * b - 1.0),
        group.height_m * mix([0.8, 1.0], c),
    ];
    (eye, look(config, &group.view_kind, eye, [x, y, 0.0], [turn.sin(), turn.cos(), 0.0]))
}

fn dash(
    config: &ScenarioConfig,
    group: &DashConfig,
    place: [f64; 3],
    obstacles: &Obstacles,
) -> Option<Vec<ScenarioCamera>> {
    take_clear(group.count_per_place, obstacles, |i| {
        // Angles are spread evenly from the lowest to the highest, for any count.
        let turn = ((i % group.count_per_place) as f64 + 0.5) / group.count_per_place as f64;
        dash_at(config, group, place, turn, spread(i))
    })
}

fn dash_at(config: &ScenarioConfig, group: &DashConfig, place: [f64; 3], turn: f64, [f, h, d]: [f64; 3]) -> Candidate {
    let mount = Mount {
        forward_m: mix(group.forward_m, f),
        height_m: mix(group.height_m, h),
        left: mix(group.left_deg, turn).to_radians(),
        down: mix(group.down_deg, d).to_radians(),
    };
    let (eye, target) = mount.at(place);
    (eye, look(config, &group.view_kind, eye, target, [0.0, 0.0, 1.0]))
}

fn street(config: &ScenarioConfig, group: &StreetConfig, obstacles: &Obstacles) -> Option<Vec<ScenarioCamera>> {
    take_clear(group.count, obstacles, |i| street_at(config, group, spread(i), spread(i + 7)))
}

fn street_at(config: &ScenarioConfig, group: &StreetConfig, eye: [f64; 3], target: [f64; 3]) -> Candidate {
    let (eye, target) = (within(&group.region, eye), within(&group.look_at, target));
    (eye, look(config, &group.view_kind, eye, target, [0.0, 0.0, 1.0]))
}

/// Camera groups, each with its share.
struct Groups<'a>(Vec<(usize, Group<'a>)>);

impl<'a> Groups<'a> {
    fn new(config: &'a ScenarioConfig, places: impl Fn(&str) -> Vec<[f64; 3]>) -> Self {
        let dash = |group: &'a DashConfig| {
            let places = places(group.vehicle.get_ref());
            (group.count_per_place * places.len(), Group::Dash(group, places))
        };
        let groups = (config.orbit.iter().map(|g| (g.count, Group::Orbit(g))))
            .chain(config.overhead.iter().map(|g| (g.count, Group::Overhead(g))))
            .chain(config.dash.iter().map(dash))
            .chain(config.street.iter().map(|g| (g.count, Group::Street(g))));
        Self(groups.collect())
    }

    /// Returns one camera without obstacles, or the key of the group without enough space.
    fn draw(
        &self,
        config: &ScenarioConfig,
        obstacles: &Obstacles,
        rng: &mut impl Rng,
    ) -> Result<ScenarioCamera, &'static str> {
        let total: usize = self.0.iter().map(|(share, _)| share).sum();
        if total == 0 {
            return Err("orbit");
        }
        let mut nth = rng.random_range(0..total);
        let group = self.0.iter().find(|(share, _)| {
            let here = nth < *share;
            nth = nth.saturating_sub(*share);
            here
        });
        let (_, group) = group.ok_or("orbit")?;
        (0..MAX_TRIES)
            .map(|_| group.candidate(config, rng))
            .find(|(eye, _)| obstacles.clear(*eye))
            .map(|(_, camera)| camera)
            .ok_or(group.key())
    }
}

/// Returns `count` cameras drawn at random from the ranges of the fixed cameras, each group in proportion to its fixed
/// cameras; or the key of the group without enough space.
pub(crate) fn free_cameras(
    config: &ScenarioConfig,
    obstacles: &Obstacles,
    places: impl Fn(&str) -> Vec<[f64; 3]>,
    count: usize,
    seed: u64,
) -> Result<Vec<ScenarioCamera>, &'static str> {
    let groups = Groups::new(config, places);
    (0..count)
        .map(|i| {
            let mut rng = carff_base::random::stream(Key { seed, frame: i as u64, step: FREE_STREAM, sample: 0 });
            groups.draw(config, obstacles, &mut rng)
        })
        .collect()
}

/// Returns one camera as [`free_cameras`] draws it, from the caller's random stream.
pub(crate) fn free_camera(
    config: &ScenarioConfig,
    obstacles: &Obstacles,
    places: impl Fn(&str) -> Vec<[f64; 3]>,
    rng: &mut impl Rng,
) -> Result<ScenarioCamera, &'static str> {
    Groups::new(config, places).draw(config, obstacles, rng)
}

/// Mounting pose of a camera on a vehicle's roof.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mount {
    pub forward_m: f64,
    pub height_m: f64,
    /// Angle left of straight ahead, and angle below the horizon, radians.
    pub left: f64,
    pub down: f64,
}

impl Mount {
    /// Draws a mounting pose from the ranges of a group.
    pub fn draw(group: &DashConfig, rng: &mut impl Rng) -> Self {
        Self {
            forward_m: mix(group.forward_m, rng.random()),
            height_m: mix(group.height_m, rng.random()),
            left: mix(group.left_deg, rng.random()).to_radians(),
            down: mix(group.down_deg, rng.random()).to_radians(),
        }
    }

    /// Returns eye and target for a vehicle at x, y, with heading yaw.
    pub fn at(&self, [x, y, yaw]: [f64; 3]) -> ([f64; 3], [f64; 3]) {
        let heading = yaw + self.left;
        let eye = [x + self.forward_m * yaw.cos(), y + self.forward_m * yaw.sin(), self.height_m];
        let ahead = [self.down.cos() * heading.cos(), self.down.cos() * heading.sin(), -self.down.sin()];
        (eye, [0, 1, 2].map(|i| eye[i] + ahead[i]))
    }
}

/// Name of the random stream.
const FREE_STREAM: u32 = Key::named("free", 0, 0).step;

enum Group<'a> {
    Orbit(&'a OrbitConfig),
    Overhead(&'a OverheadConfig),
    Dash(&'a DashConfig, Vec<[f64; 3]>),
    Street(&'a StreetConfig),
}

impl Group<'_> {
    fn key(&self) -> &'static str {
        match self {
            Self::Orbit(_) => "orbit",
            Self::Overhead(_) => "overhead",
            Self::Dash(..) => "dash",
            Self::Street(_) => "street",
        }
    }

    fn candidate(&self, config: &ScenarioConfig, rng: &mut impl Rng) -> Candidate {
        let turn = rng.random::<f64>() * std::f64::consts::TAU;
        match self {
            Self::Orbit(group) => orbit_at(config, group, turn, rng.random()),
            Self::Overhead(group) => overhead_at(config, group, turn, rng.random()),
            Self::Dash(group, places) => {
                let place = places[rng.random_range(0..places.len())];
                dash_at(config, group, place, rng.random(), rng.random())
            }
            Self::Street(group) => street_at(config, group, rng.random(), rng.random()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sequence is even: of 64 points, each quarter of the square contains between 12 and 20.
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
