//! A loaded scenario: checked, with its solids and cameras, ready to be rendered.

mod check;
mod datasets;
mod visibility;

pub use visibility::{FULL_FRACTION, FULL_PIXELS, NONE_FRACTION, NONE_MEAN_DIFFERENCE};

use crate::cameras::{Obstacles, ScenarioCamera, cameras, free_cameras};
use crate::config::ScenarioConfig;
use crate::error::ScenarioError;
use crate::movers::{Mover, Pose, movers};
use crate::scenery::{Body, Scenery, scenery};
use crate::tracer::{Scene, Setting};
use carff_base::geometry::PinholeCamera;
use carff_dataset::{Candidate, Image, Observability, ScenarioInfo, StateInfo};
use check::{Source, check};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use visibility::{Shots, counterparts};

/// Results of a rendering in addition to the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Detail {
    /// Image, depth and object ids.
    Image,
    /// Also the visibility of the actor; needs one more image if the actor is hidden.
    #[default]
    Observability,
}

/// Visibility of the actor in a view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActorView {
    /// Ratio of visible pixels to the pixels of the unoccluded actor in an unbounded image, 0..=1.
    pub visible_fraction: f32,
    /// Number of visible pixels; if the actor is absent, of its place.
    pub actor_px: u32,
    /// The resulting class of visibility.
    pub observability: Observability,
}

/// A rendered view.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendering {
    /// Pixels of the view.
    pub image: Image,
    /// Distance along the ray through each pixel's centre, metres, row-major; infinite for the sky.
    pub depth_m: Vec<f32>,
    /// First hit of the ray through each pixel's centre: 0 sky, 1 ground, then static and moving objects (see
    /// [`Scenario::object_of`]).
    pub object_id: Vec<u16>,
    /// Visibility of the actor; `None` if not requested or if nothing in the scenario is dynamic.
    pub actor: Option<ActorView>,
}

/// Files to write in addition to images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Extras {
    /// Images only.
    #[default]
    None,
    /// Also `depth/` (16-bit PNG, millimetres along the ray, 0 for the sky and beyond 65.535 m) and `masks/` (8-bit
    /// PNG, 255 where the pixel's centre shows the actor), named by `depth_file_path` and `mask_file_path`.
    DepthAndMasks,
}

/// Poses of all movers; an absent mover is `None`.
pub(crate) type Placement = Vec<Option<Pose>>;

/// Returns the distinct poses (x, y, yaw) of a vehicle over all states.
fn places(config: &ScenarioConfig, placements: &[Vec<Placement>], name: &str) -> Vec<[f64; 3]> {
    let Some(index) = config.vehicle.iter().position(|v| v.name == name) else { return Vec::new() };
    let mut seen: Vec<[f64; 3]> = Vec::new();
    for pose in (0..config.timestamps).flat_map(|t| placements.iter().filter_map(move |b| b[t][index])) {
        let place = [pose.position_m[0], pose.position_m[1], pose.yaw];
        if !seen.contains(&place) {
            seen.push(place);
        }
    }
    seen
}

type PlacementKey = Vec<Option<[u64; 5]>>;

fn key_of(placement: &Placement) -> PlacementKey {
    placement.iter().map(|p| p.as_ref().map(Pose::key)).collect()
}

/// A scenario that is ready to be rendered.
pub struct Scenario {
    path: PathBuf,
    config: ScenarioConfig,
    scenery: Scenery,
    setting: Setting,
    obstacles: Obstacles,
    cameras: Vec<ScenarioCamera>,
    info: ScenarioInfo,
    /// Placements by branch, then time step.
    placements: Vec<Vec<Placement>>,
    actor: Option<Actor>,
    scenes: HashMap<PlacementKey, Scene>,
    unknown: Unknown,
}

/// The part of a scenario that its file does not place: see [`Scenario::with_appearance`].
#[derive(Clone, Debug, Default)]
pub(crate) struct Unknown {
    /// True if the dynamic vehicle has another appearance.
    pub appearance: bool,
    /// Number of added bystanders: the last movers.
    pub bystanders: usize,
}

impl std::fmt::Debug for Scenario {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Scenario").field("path", &self.path).field("name", &self.config.name).finish_non_exhaustive()
    }
}

impl Scenario {
    /// Reads and checks a scenario file, and makes its solids and cameras.
    pub fn load(path: &Path) -> Result<Self, ScenarioError> {
        let text =
            std::fs::read_to_string(path).map_err(|source| ScenarioError::Io { path: path.to_owned(), source })?;
        Self::parse(path, &text)
    }

    /// Reads a scenario from text, as [`Scenario::load`] does; `path` only appears in errors.
    pub fn parse(path: &Path, text: &str) -> Result<Self, ScenarioError> {
        let config: ScenarioConfig = toml::from_str(text)
            .map_err(|source| ScenarioError::Toml { path: path.to_owned(), source: Box::new(source) })?;
        let source = Source { path, text };
        let (placements, actor, hazard_branches) = check(&source, &config)?;

        let scenery = scenery(&config);
        let (scenes, [still_bodies, moving_bodies]) = scenes(&config, &scenery, &placements, actor.as_ref());
        let obstacles = Obstacles::new(
            config.clearance_m as f32,
            scenery.bodies.iter().chain(&still_bodies).map(|b| b.solid.aabb()),
            moving_bodies.iter().map(|b| b.solid.aabb()),
        );
        let places = |name: &str| places(&config, &placements, name);
        let cameras = cameras(&config, &obstacles, places).map_err(|key| {
            source.error_in(key, "too few positions for these cameras are free of obstacles; widen their ranges")
        })?;
        if let Some(view) = config.bev_view.as_ref().filter(|v| *v.get_ref() >= cameras.len()) {
            return Err(source.error_at(
                view,
                "bev_view",
                format!("is {}, but there are {} cameras", view.get_ref(), cameras.len()),
            ));
        }
        let info = info(&config, &scenery, &placements, hazard_branches);
        let setting = Setting::new(&config);
        Ok(Self {
            path: path.to_owned(),
            config,
            scenery,
            setting,
            obstacles,
            cameras,
            info,
            placements,
            actor,
            scenes,
            unknown: Unknown::default(),
        })
    }

    /// Returns the scenario with another configuration of its movers, of which the last `added` are new and at rest.
    /// Cameras, and the spaces that no camera may enter, are unchanged.
    pub(crate) fn varied(&self, config: ScenarioConfig, unknown: Unknown, added: usize) -> Self {
        let mut placements = self.placements.clone();
        let known = movers(&config).count() - added;
        for placement in placements.iter_mut().flatten() {
            placement.extend(movers(&config).skip(known).map(|mover| mover.still()));
        }
        let info = info(&config, &self.scenery, &placements, self.info.hazard_branches.clone());
        Self {
            path: self.path.clone(),
            scenes: scenes(&config, &self.scenery, &placements, self.actor.as_ref()).0,
            info: ScenarioInfo { bev_view: self.info.bev_view, ..info },
            scenery: self.scenery.clone(),
            setting: self.setting.clone(),
            obstacles: self.obstacles.clone(),
            cameras: self.cameras.clone(),
            actor: self.actor.clone(),
            config,
            placements,
            unknown,
        }
    }

    /// Returns the part of the scenario that its file does not place.
    pub(crate) fn unknown(&self) -> &Unknown {
        &self.unknown
    }

    /// Returns the dynamic mover and its followers, as indices of movers; empty if nothing is dynamic.
    pub(crate) fn actors(&self) -> Vec<usize> {
        self.actor.iter().flat_map(|actor| std::iter::once(actor.dynamic).chain(actor.followers.clone())).collect()
    }

    /// Returns the path of its file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns branches, states, boxes and actions, as they are written into datasets.
    pub fn info(&self) -> &ScenarioInfo {
        &self.info
    }

    /// Returns the fixed camera poses, in the order of their view index.
    pub fn cameras(&self) -> &[ScenarioCamera] {
        &self.cameras
    }

    /// Returns the scenario with `count` random cameras from the ranges of its fixed ones, and without a bird's-eye
    /// view. The poses differ from all fixed ones, for training an encoder that must not memorise poses.
    pub fn with_free_cameras(self, count: usize, seed: u64) -> Result<Self, ScenarioError> {
        let places = |name: &str| places(&self.config, &self.placements, name);
        let cameras = free_cameras(&self.config, &self.obstacles, places, count, seed)
            .map_err(|key| ScenarioError::NoRoom { path: self.path.clone(), key })?;
        Ok(self.with_cameras(cameras))
    }

    /// Returns the scenario with other cameras, and without a bird's-eye view.
    pub(crate) fn with_cameras(mut self, cameras: Vec<ScenarioCamera>) -> Self {
        self.cameras = cameras;
        self.info.bev_view = None;
        self
    }

    /// Returns the object index of a vehicle or object, as it appears in [`Rendering::object_id`].
    pub fn object_of(&self, name: &str) -> Option<u16> {
        let index = movers(&self.config).position(|m| m.name() == name)?;
        Some(self.scenery.next_object + index as u16)
    }

    pub(crate) fn config(&self) -> &ScenarioConfig {
        &self.config
    }

    pub(crate) fn obstacles(&self) -> &Obstacles {
        &self.obstacles
    }

    /// Returns the placements by branch, then time step.
    pub(crate) fn placements(&self) -> &[Vec<Placement>] {
        &self.placements
    }

    /// Returns the distinct poses of a vehicle over all states: x, y, yaw.
    pub(crate) fn places_of(&self, vehicle: &str) -> Vec<[f64; 3]> {
        places(&self.config, &self.placements, vehicle)
    }

    /// Returns the image of any placement.
    pub(crate) fn image_of(&self, placement: &Placement, camera: &PinholeCamera) -> Image {
        self.scene(placement).image(&self.setting, camera)
    }

    /// Returns the image of a placement with further movers.
    pub(crate) fn image_with(
        &self,
        placement: &Placement,
        added: &[(Mover<'_>, &[Pose])],
        camera: &PinholeCamera,
    ) -> Image {
        let (still, moving) = placed(&self.config, &self.scenery, placement);
        let object = self.scenery.next_object + movers(&self.config).count() as u16;
        let added = added.iter().flat_map(|(mover, poses)| poses.iter().map(move |pose| mover.bodies(*pose, object)));
        let bodies = self.scenery.bodies.iter().cloned().chain(still).chain(moving).chain(added.flatten());
        Scene::new(bodies.collect()).image(&self.setting, camera)
    }

    /// Returns the visibility of the actor in a placement whose other movers differ from the state's.
    pub(crate) fn observability_of(
        &self,
        placement: &Placement,
        timestamp: usize,
        camera: &PinholeCamera,
    ) -> Option<Observability> {
        let mut shots = Shots { scenario: self, camera, taken: HashMap::new() };
        Some(self.actor_view(&mut shots, placement, timestamp)?.observability)
    }

    /// Renders an image from any camera.
    pub fn render(
        &self,
        branch: usize,
        timestamp: usize,
        camera: &PinholeCamera,
        detail: Detail,
    ) -> Result<Rendering, ScenarioError> {
        camera.validate()?;
        let mut shots = Shots { scenario: self, camera, taken: HashMap::new() };
        Ok(self.render_with(&mut shots, self.placement(branch, timestamp)?, timestamp, detail))
    }

    fn placement(&self, branch: usize, timestamp: usize) -> Result<&Placement, ScenarioError> {
        let (branches, timestamps) = (self.info.branches.len(), self.info.timestamps);
        let missing = ScenarioError::NoSuchState { branch, timestamp, branches, timestamps };
        self.placements.get(branch).and_then(|b| b.get(timestamp)).ok_or(missing)
    }

    /// Returns the placement of a state in the images of a camera.
    fn placement_for(
        &self,
        camera: &ScenarioCamera,
        branch: usize,
        timestamp: usize,
    ) -> Result<Placement, ScenarioError> {
        let mut placement = self.placement(branch, timestamp)?.clone();
        let ego = self.config.vehicle.iter().position(|v| v.role == "ego");
        if let (Some(ego), Some([x, y, yaw])) = (ego, camera.ego_pose) {
            placement[ego] = Some(Pose { position_m: [x, y, 0.0], yaw, variant: None });
        }
        Ok(placement)
    }

    /// Returns the scene with the movers at a placement.
    fn scene(&self, placement: &Placement) -> Scene {
        let (still, moving) = placed(&self.config, &self.scenery, placement);
        Scene::new(self.scenery.bodies.iter().cloned().chain(still).chain(moving).collect())
    }

    fn render_with(&self, shots: &mut Shots, placement: &Placement, timestamp: usize, detail: Detail) -> Rendering {
        let actor = match detail {
            Detail::Observability => self.actor_view(shots, placement, timestamp),
            Detail::Image => None,
        };
        let shot = shots.take(placement);
        Rendering { image: shot.image.clone(), depth_m: shot.depth_m.clone(), object_id: shot.object_id.clone(), actor }
    }
}

/// Returns the scenes of all states and of their counterparts, and the solids of movers at rest and in motion.
fn scenes(
    config: &ScenarioConfig,
    scenery: &Scenery,
    placements: &[Vec<Placement>],
    actor: Option<&Actor>,
) -> (HashMap<PlacementKey, Scene>, [Vec<Body>; 2]) {
    let mut scenes = HashMap::new();
    let (mut still_bodies, mut moving_bodies): (Vec<Body>, Vec<Body>) = (Vec::new(), Vec::new());
    let mut build = |placement: &Placement| {
        scenes.entry(key_of(placement)).or_insert_with(|| {
            let (still, moving) = placed(config, scenery, placement);
            still_bodies.clone_from(&still);
            moving_bodies.extend(moving.iter().cloned());
            Scene::new(scenery.bodies.iter().cloned().chain(still).chain(moving).collect())
        });
    };
    for steps in placements {
        for (timestamp, placement) in steps.iter().enumerate() {
            build(placement);
            for other in counterparts(placement, placements, actor, timestamp) {
                build(&other);
            }
        }
    }
    (scenes, [still_bodies, moving_bodies])
}

/// Returns the solids of static objects and of all placed movers.
fn placed(config: &ScenarioConfig, scenery: &Scenery, placement: &Placement) -> (Vec<Body>, Vec<Body>) {
    let (mut still, mut moving) = (Vec::new(), Vec::new());
    for (i, (mover, pose)) in movers(config).zip(placement).enumerate() {
        let Some(pose) = pose else { continue };
        let bodies = mover.bodies(*pose, scenery.next_object + i as u16);
        if mover.still().is_some() { &mut still } else { &mut moving }.extend(bodies);
    }
    (still, moving)
}

/// The actor of the forecast and its followers, as indices of movers.
#[derive(Clone, Debug)]
struct Actor {
    dynamic: usize,
    /// Movers that share the actor's presence.
    followers: Vec<usize>,
}

fn info(
    config: &ScenarioConfig,
    scenery: &Scenery,
    placements: &[Vec<Placement>],
    hazard_branches: Vec<usize>,
) -> ScenarioInfo {
    let mut states = Vec::new();
    let mut candidates: Vec<Candidate> = Vec::new();
    for (branch, steps) in placements.iter().enumerate() {
        for (timestamp, placement) in steps.iter().enumerate() {
            let mut boxes = Vec::new();
            for (mover, pose) in movers(config).zip(placement).filter(|(mover, _)| mover.still().is_none()) {
                let Some(named_box) = pose.and_then(|pose| mover.named_box(pose)) else { continue };
                if mover.dynamic() {
                    let candidate =
                        Candidate { branch: None, timestamp: Some(timestamp), named_box: named_box.clone() };
                    if !candidates.contains(&candidate) {
                        candidates.push(candidate);
                    }
                }
                boxes.push(named_box);
            }
            states.push(StateInfo { branch, timestamp, boxes });
        }
    }
    candidates.sort_by_key(|c| c.timestamp);
    let still_objects = movers(config).filter_map(|mover| mover.named_box(mover.still()?));
    ScenarioInfo {
        name: config.name.clone(),
        bounds: config.bounds_m,
        branches: config.branches.clone(),
        timestamps: config.timestamps,
        step_s: config.step_s,
        bev_view: config.bev_view.as_ref().map(|v| *v.get_ref()),
        states,
        candidates,
        static_boxes: scenery.boxes.iter().cloned().chain(still_objects).collect(),
        hazard_branches,
        hazard_from_timestamp: *config.hazard_from_timestamp.get_ref(),
        hazard_action: config.actions.hazard.clone(),
        clear_action: config.actions.clear.clone(),
    }
}
