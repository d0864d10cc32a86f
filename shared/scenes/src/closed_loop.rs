//! Closed-loop drives: the ego's camera image and all boxes, for any place of the ego and any time.
//!
//! The ego's place is an input: a vehicle model outside this crate moves it. The other vehicles of an episode only depend
//! on its number, the seed and the time. All random values of episode `n` come from the stream (seed, frame `n`, step
//! `loop`), so episodes can be made one by one, in any order.

use crate::cameras::{Mount, ScenarioCamera};
use crate::config::{ClosedLoopConfig, DashConfig};
use crate::error::ScenarioError;
use crate::movers::{Mover, Pose};
use crate::path::Path;
use crate::scenario::Scenario;
use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_base::random::Key;
use carff_dataset::Image;
use rand::Rng;

/// Name of the random stream of training cameras.
const TRAINING_STREAM: u32 = Key::named("path", 0, 0).step;
/// Name of the random stream.
const STREAM: u32 = Key::named("loop", 0, 0).step;
/// Length by which the line of the others' course is extended in both directions, metres.
const EXTENDED_M: f64 = 80.0;
/// Length of the part behind the stop line on which training cameras are drawn, metres.
const BEYOND_LINE_M: f64 = 1.0;
/// Largest number of draws of a training camera.
const MAX_TRIES: u32 = 400;
/// Step of the search for the place where the ways meet, metres.
const SEARCH_M: f64 = 0.05;

/// A route of a scenario's closed-loop drives.
#[derive(Debug)]
pub struct ClosedLoop {
    scenario: Scenario,
    config: ClosedLoopConfig,
    /// Ranges of the camera's mounting pose on the ego's roof.
    mounting: DashConfig,
    /// Indices of the ego and of the dynamic vehicle among the vehicles.
    ego: usize,
    actor: usize,
    path: Path,
    lane: Path,
    /// Boxes that the others cover along their lane.
    strips: Vec<OrientedBox>,
    conflict_m: [f64; 2],
}

/// The random part of one drive.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    actors: Vec<Actor>,
    mount: Mount,
}

/// Another vehicle: place on the lane at the start, metres, and speed.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Actor {
    start_m: f64,
    speed_mps: f64,
}

impl ClosedLoop {
    /// Prepares the drives on a route of a scenario: the one named `route`, or the first one.
    ///
    /// # Errors
    ///
    /// The scenario has no `closed_loop`, or none of this name, no ego with a roof camera, no dynamic vehicle with a
    /// course, or a route that never meets the others' lane.
    pub fn new(scenario: Scenario, route: Option<&str>) -> Result<Self, ScenarioError> {
        let error = |problem: &'static str| ScenarioError::NoClosedLoop { path: scenario.path().to_owned(), problem };
        let routes = &scenario.config().closed_loop;
        let first = routes.first().ok_or_else(|| error("it has no table `closed_loop`"))?;
        let unknown = |name: &str| scenario.no_such("closed_loop", name, routes.iter().map(|route| &route.name));
        let named = |name: &str| routes.iter().find(|route| route.name == name).ok_or_else(|| unknown(name));
        let config = route.map_or(Ok(first), named)?.clone();
        let vehicles = &scenario.config().vehicle;
        let ego =
            vehicles.iter().position(|v| v.role == "ego").ok_or_else(|| error("no vehicle has the role `ego`"))?;
        let actor = vehicles.iter().position(|v| v.dynamic).ok_or_else(|| error("no vehicle is dynamic"))?;
        let on_roof = |group: &&DashConfig| *group.vehicle.get_ref() == vehicles[ego].name;
        let group = scenario.config().dash.iter().find(on_roof);
        let group = group.ok_or_else(|| error("the ego has no roof camera (`dash`)"))?;
        let mounting = DashConfig { left_deg: config.camera_left_deg, ..group.clone() };
        let branches = || (0..scenario.info().branches.len()).filter(|&b| scenario.info().is_hazard(b));
        let course = branches()
            .map(|b| scenario.placements()[b].iter().filter_map(|p| p[actor].map(|pose| pose.position_m)))
            .map(|course| course.map(|[x, y, _]| [x, y]).collect::<Vec<_>>())
            .find(|course| course.len() > 1)
            .ok_or_else(|| error("no hazard branch moves the dynamic vehicle"))?;
        let (path, lane) = (Path::new(config.path.clone()), Path::new(course).extended(EXTENDED_M));
        let strips = lane.strips(vehicles[actor].size_m[1]);
        let mut drives = Self { scenario, config, mounting, ego, actor, path, lane, strips, conflict_m: [0.0; 2] };
        drives.conflict_m = drives.find_conflict().ok_or(ScenarioError::NoClosedLoop {
            path: drives.scenario.path().to_owned(),
            problem: "the ego's path never meets the dynamic vehicle's course",
        })?;
        Ok(drives)
    }

    /// Returns the settings of the drives.
    pub fn config(&self) -> &ClosedLoopConfig {
        &self.config
    }

    /// Returns the scenario.
    pub fn scenario(&self) -> &Scenario {
        &self.scenario
    }

    /// Returns the length of the ego's route, metres.
    pub fn length_m(&self) -> f64 {
        self.path.length_m()
    }

    /// Returns the part of the ego's route on which it would be in the way of the others, as distances of its centre from
    /// the start, metres.
    pub fn conflict_m(&self) -> [f64; 2] {
        self.conflict_m
    }

    /// Returns the ego's centre where it is first in the way of the others, x and y in metres.
    pub fn crossing_m(&self) -> [f64; 2] {
        let [x, y, _] = self.path.at(self.conflict_m[0]);
        [x, y]
    }

    /// Returns the way along the others' lane, in their direction, that the ego's rear has made from its centre's place at
    /// the start of the conflict to the conflict's end, metres; 0 where it crosses the lane.
    pub fn along_conflict_m(&self) -> f64 {
        let ([x, y], [end_x, end_y, heading]) = (self.crossing_m(), self.path.at(self.conflict_m[1]));
        let course = self.lane.heading_near([end_x, end_y]);
        let [length_m, width_m, _] = self.scenario.config().vehicle[self.ego].size_m;
        let turn = heading - course;
        let rear_m = 0.5 * (length_m * turn.cos().abs() + width_m * turn.sin().abs());
        ((end_x - x) * course.cos() + (end_y - y) * course.sin() - rear_m).max(0.0)
    }

    /// Returns the boxes that the other vehicles cover along their lane.
    pub fn lane_boxes(&self) -> &[OrientedBox] {
        &self.strips
    }

    /// Draws episode `number`; `actors` replaces the scenario's number of other vehicles. The same arguments give the
    /// same episode.
    pub fn episode(&self, number: u64, seed: u64, actors: Option<u32>) -> Episode {
        let mut rng = carff_base::random::stream(Key { seed, frame: number, step: STREAM, sample: 0 });
        let mut within = |[low, high]: [f64; 2]| low + (high - low) * rng.random::<f64>();
        let config = &self.config;
        let [low, high] = config.actors.map(f64::from);
        let count = actors.unwrap_or_else(|| (within([low, high + 1.0]) as u32).min(config.actors[1]));
        let mut drawn: Vec<Actor> = Vec::new();
        for _ in 0..count {
            let limit = drawn.last().map_or(f64::INFINITY, |ahead| ahead.speed_mps);
            let speed_mps = within(config.actor_speed_mps).min(limit);
            let start_m = match drawn.last() {
                None => EXTENDED_M + within(config.actor_start_m),
                Some(ahead) => ahead.start_m - self.actor_length_m() - within(config.actor_gap_m),
            };
            drawn.push(Actor { start_m, speed_mps });
        }
        Episode { actors: drawn, mount: Mount::draw(&self.mounting, &mut rng) }
    }

    /// Returns the scenario with `count` random cameras on the ego's roof, from the start of its route to one metre behind
    /// the stop line, and without a bird's-eye view. The ego is at the camera in the images of every state. The poses are
    /// for training an encoder that sees what a drive shows; the vehicles stand at the places of the states.
    ///
    /// # Errors
    ///
    /// Static things block the way.
    pub fn with_training_cameras(self, count: usize, seed: u64) -> Result<Scenario, ScenarioError> {
        let cameras: Option<Vec<_>> = (0..count as u64).map(|number| self.training_camera(number, seed)).collect();
        let path = self.scenario.path().to_owned();
        let cameras = cameras.ok_or(ScenarioError::NoRoom { path, key: "closed_loop" })?;
        Ok(self.scenario.with_cameras(cameras))
    }

    fn training_camera(&self, number: u64, seed: u64) -> Option<ScenarioCamera> {
        let mut rng = carff_base::random::stream(Key { seed, frame: number, step: TRAINING_STREAM, sample: 0 });
        (0..MAX_TRIES).find_map(|_| {
            let at_m = rng.random_range(0.0..self.conflict_m[0] + BEYOND_LINE_M);
            let camera = self.camera_at(&Mount::draw(&self.mounting, &mut rng), at_m);
            let free = self.scenario.obstacles().clear(camera.position_m());
            let view_kind = self.mounting.view_kind.clone();
            free.then(|| ScenarioCamera { view_kind, camera, ego_pose: Some(self.path.at(at_m)) })
        })
    }

    /// Returns the ego's box at a place on its route, metres from the start.
    pub fn ego_box(&self, at_m: f64) -> OrientedBox {
        self.footprint(self.ego, self.path.at(at_m))
    }

    /// Returns the ego's pose on the ground at a place on its route: x, y in metres, heading in radians.
    pub fn ego_pose(&self, at_m: f64) -> [f64; 3] {
        self.path.at(at_m)
    }

    /// Returns the boxes of the other vehicles, `time_s` seconds after the start.
    pub fn actor_boxes(&self, episode: &Episode, time_s: f64) -> Vec<OrientedBox> {
        episode.actors.iter().map(|a| self.footprint(self.actor, self.actor_pose(a, time_s))).collect()
    }

    /// Returns the smallest gap between the ego and another vehicle, metres, negative if they overlap; infinite without
    /// others.
    pub fn gap_m(&self, episode: &Episode, at_m: f64, time_s: f64) -> f64 {
        let ego = self.ego_box(at_m);
        self.actor_boxes(episode, time_s).iter().map(|actor| ego.gap_m(actor)).fold(f64::INFINITY, f64::min)
    }

    /// Returns the camera on the ego's roof.
    pub fn camera(&self, episode: &Episode, at_m: f64) -> PinholeCamera {
        self.camera_at(&episode.mount, at_m)
    }

    fn camera_at(&self, mount: &Mount, at_m: f64) -> PinholeCamera {
        let (eye, target) = mount.at(self.path.at(at_m));
        let image = &self.scenario.config().image;
        PinholeCamera::look_at(eye, target, [0.0, 0.0, 1.0], image.width_px, image.height_px, image.fov_deg)
    }

    /// Renders the image of the ego's camera, without sensor noise.
    pub fn image(&self, episode: &Episode, at_m: f64, time_s: f64) -> Image {
        self.image_from(episode, at_m, time_s, &self.camera(episode, at_m))
    }

    /// Renders the image of any camera.
    pub fn image_from(&self, episode: &Episode, at_m: f64, time_s: f64, camera: &PinholeCamera) -> Image {
        let mut placement = self.scenario.placements()[0][0].clone();
        placement[self.ego] = Some(upright(self.path.at(at_m)));
        placement[self.actor] = None;
        let actor = Mover::Vehicle(&self.scenario.config().vehicle[self.actor]);
        let poses: Vec<Pose> = episode.actors.iter().map(|a| upright(self.actor_pose(a, time_s))).collect();
        self.scenario.image_with(&placement, &[(actor, &poses)], camera)
    }

    fn actor_pose(&self, actor: &Actor, time_s: f64) -> [f64; 3] {
        self.lane.at(actor.start_m + actor.speed_mps * time_s)
    }

    fn actor_length_m(&self) -> f64 {
        self.scenario.config().vehicle[self.actor].size_m[0]
    }

    fn footprint(&self, vehicle: usize, [x, y, yaw]: [f64; 3]) -> OrientedBox {
        let [l, w, h] = self.scenario.config().vehicle[vehicle].size_m;
        OrientedBox { center: [x, y, h / 2.0], half_size: [l / 2.0, w / 2.0, h / 2.0], yaw }
    }

    /// First and last place on the ego's route at which it would be in the way of the others.
    fn find_conflict(&self) -> Option<[f64; 2]> {
        let meets = |at_m: f64| self.strips.iter().any(|strip| self.ego_box(at_m).gap_m(strip) < self.config.space_m);
        let places = (0..=(self.length_m() / SEARCH_M) as usize).map(|i| i as f64 * SEARCH_M);
        let met: Vec<f64> = places.filter(|&at_m| meets(at_m)).collect();
        Some([*met.first()?, *met.last()?])
    }
}

impl Episode {
    /// Returns the number of other vehicles.
    pub fn actor_count(&self) -> usize {
        self.actors.len()
    }
}

fn upright([x, y, yaw]: [f64; 3]) -> Pose {
    Pose { position_m: [x, y, 0.0], yaw, variant: None }
}
