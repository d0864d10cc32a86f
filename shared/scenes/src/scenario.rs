//! A loaded scenario: checked, with its solids and cameras, ready to be rendered.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Candidate, DatasetWriter, FrameRecord, Image, Observability, ScenarioInfo, StateInfo, looks_same};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use toml::Spanned;

use crate::cameras::{Obstacles, ScenarioCamera, cameras, free_cameras};
use crate::config::ScenarioConfig;
use crate::error::ScenarioError;
use crate::movers::{Mover, Pose, movers};
use crate::scenery::{Body, Scenery, scenery};
use crate::tracer::{Scene, Setting, ray};

/// Minimum visible fraction of a `full` view.
pub const FULL_FRACTION: f64 = 0.75;
/// Minimum number of visible pixels of a `full` view (in an image of 128 x 128; proportional for other sizes).
pub const FULL_PIXELS: u32 = 12;
/// Maximum visible fraction of a `none` view.
pub const NONE_FRACTION: f64 = 0.02;
/// Maximum mean difference, of 255, between a `none` view's images with and without the actor.
pub const NONE_MEAN_DIFFERENCE: f64 = 0.02;
/// Size of the extended image in which hidden pixels are counted: this many widths beyond each edge.
const BEYOND: i64 = 3;

/// Results of a rendering in addition to the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detail {
    /// Image, depth and object ids.
    Picture,
    /// Also the visibility of the actor; needs one more image if the actor is hidden.
    Observability,
}

/// Options of rendering a view.
#[derive(Clone, Copy, Debug)]
pub struct RenderOptions {
    /// Results to compute.
    pub detail: Detail,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { detail: Detail::Observability }
    }
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

/// Converts positions in the text to line numbers.
struct Source<'a> {
    path: &'a Path,
    text: &'a str,
}

impl Source<'_> {
    fn error(&self, offset: usize, key: &str, problem: impl Into<String>) -> ScenarioError {
        let line = self.text.bytes().take(offset).filter(|b| *b == b'\n').count() + 1;
        ScenarioError::Key { path: self.path.to_owned(), line, key: key.to_owned(), problem: problem.into() }
    }

    fn error_at<T>(&self, value: &Spanned<T>, key: &str, problem: impl Into<String>) -> ScenarioError {
        self.error(value.span().start, key, problem)
    }

    /// Returns an error at the first line that sets a key, for keys without a stored position.
    fn error_in(&self, key: &str, problem: impl Into<String>) -> ScenarioError {
        let is_key = |line: &str| {
            line.trim_start()
                .trim_start_matches('[')
                .strip_prefix(key)
                .is_some_and(|rest| rest.trim_start().starts_with('=') || rest.starts_with(']'))
        };
        let offset: usize = self.text.split_inclusive('\n').take_while(|l| !is_key(l)).map(str::len).sum();
        self.error(if offset == self.text.len() { 0 } else { offset }, key, problem)
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
    pub fn with_free_cameras(mut self, count: usize, seed: u64) -> Result<Self, ScenarioError> {
        let places = |name: &str| places(&self.config, &self.placements, name);
        let cameras = free_cameras(&self.config, &self.obstacles, places, count, seed);
        self.cameras = cameras.map_err(|key| ScenarioError::NoRoom { path: self.path.clone(), key })?;
        self.info.bev_view = None;
        Ok(self)
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
    pub(crate) fn picture_of(&self, placement: &Placement, camera: &PinholeCamera) -> Image {
        self.scene(placement).image(&self.setting, camera)
    }

    /// Returns the image of a placement with further movers.
    pub(crate) fn picture_with(
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
        options: &RenderOptions,
    ) -> Result<Rendering, ScenarioError> {
        camera.validate()?;
        let mut shots = Shots { scenario: self, camera, taken: HashMap::new() };
        self.render_with(&mut shots, branch, timestamp, options.detail)
    }

    /// Returns the scene with the movers at a placement.
    fn scene(&self, placement: &Placement) -> Scene {
        let (still, moving) = placed(&self.config, &self.scenery, placement);
        Scene::new(self.scenery.bodies.iter().cloned().chain(still).chain(moving).collect())
    }

    fn render_with(
        &self,
        shots: &mut Shots,
        branch: usize,
        timestamp: usize,
        detail: Detail,
    ) -> Result<Rendering, ScenarioError> {
        let placement =
            self.placements.get(branch).and_then(|b| b.get(timestamp)).ok_or(ScenarioError::NoSuchState {
                branch,
                timestamp,
                branches: self.info.branches.len(),
                timestamps: self.info.timestamps,
            })?;
        let actor = match detail {
            Detail::Observability => self.actor_view(shots, placement, timestamp),
            Detail::Picture => None,
        };
        let shot = shots.take(placement);
        Ok(Rendering {
            image: shot.image.clone(),
            depth_m: shot.depth_m.clone(),
            object_id: shot.object_id.clone(),
            actor,
        })
    }

    /// Casts a ray per pixel centre at only the actor, in an unbounded image, and at the whole scene. Returns `None` if
    /// nothing is dynamic.
    fn actor_view(&self, shots: &mut Shots, placement: &Placement, timestamp: usize) -> Option<ActorView> {
        let camera = shots.camera;
        let others = counterparts(placement, &self.placements, self.actor.as_ref(), timestamp);
        let dynamic = self.actor.as_ref()?.dynamic;
        let mover = movers(&self.config).nth(dynamic)?;
        let object = self.scenery.next_object + dynamic as u16;
        let (mut visible, mut would_be) = (0_u32, 0_u32);
        let poses: Vec<Pose> = match placement[dynamic] {
            Some(pose) => vec![pose],
            None => others.iter().filter_map(|o| o[dynamic]).collect(),
        };
        for pose in poses {
            let alone = Scene::new(mover.bodies(pose, object));
            let shot = shots.take(placement);
            let corners = alone.bodies().iter().flat_map(|b| {
                let aabb = b.solid.aabb();
                (0..8).map(move |i| {
                    let pick =
                        |axis: usize| f64::from(if i >> axis & 1 == 0 { aabb.mins[axis] } else { aabb.maxs[axis] });
                    [pick(0), pick(1), pick(2)]
                })
            });
            let (w, h) = (i64::from(camera.width_px), i64::from(camera.height_px));
            let (low, high) = reach(camera, corners);
            for y in low[1].max(-BEYOND * h)..high[1].min((BEYOND + 1) * h) {
                for x in low[0].max(-BEYOND * w)..high[0].min((BEYOND + 1) * w) {
                    let (origin, direction) = ray(camera, x as f64 + 0.5, y as f64 + 0.5);
                    let (t, hit) = alone.probe(origin, direction);
                    if hit != object {
                        continue;
                    }
                    would_be += 1;
                    if (0..w).contains(&x) && (0..h).contains(&y) {
                        // In a branch with the actor the first hit is the actor itself, at the same distance.
                        let at = (y * w + x) as usize;
                        visible += u32::from(shot.object_id[at] == object || t < shot.depth_m[at]);
                    }
                }
            }
        }
        let fraction = if would_be == 0 { 0.0 } else { f64::from(visible) / f64::from(would_be) };
        let scale = f64::from(camera.width_px) * f64::from(camera.height_px) / (128.0 * 128.0);
        let observability = if fraction >= FULL_FRACTION && f64::from(visible) >= f64::from(FULL_PIXELS) * scale {
            Observability::Full
        } else if fraction <= NONE_FRACTION {
            let own = shots.take(placement).image.clone();
            let hidden = others.iter().all(|other| {
                let image = &shots.take(other).image;
                looks_same(&own, image) && mean_difference(&own, image) <= NONE_MEAN_DIFFERENCE
            });
            if hidden { Observability::None } else { Observability::Partial }
        } else {
            Observability::Partial
        };
        Some(ActorView { visible_fraction: fraction as f32, actor_px: visible, observability })
    }

    /// Renders every camera in every state into a posed dataset, in parallel. `progress` receives the number of
    /// finished images and of all images, from any thread, and may stop the work. `transforms.json` is written last, so
    /// a stopped run is not mistaken for a dataset; the next run continues with the remaining cameras.
    pub fn render_dataset(
        &self,
        out_dir: &Path,
        extras: Extras,
        progress: impl Fn(usize, usize) -> ControlFlow<()> + Sync,
    ) -> Result<(), ScenarioError> {
        let (writer, notes) = DatasetWriter::go_on::<ViewNote>(out_dir, &self.identity(extras))?;
        let states = self.info.state_count();
        let total = self.cameras.len() * states;
        let known = notes.into_iter().filter(|n| n.view < self.cameras.len() && n.actors.len() == states);
        let finished: HashMap<usize, Vec<Option<ActorView>>> = known.map(|n| (n.view, n.actors)).collect();
        let (done, stopped) = (AtomicUsize::new(finished.len() * states), AtomicBool::new(false));
        let of_view = |(view, camera): (usize, &ScenarioCamera)| -> Result<Vec<FrameRecord>, ScenarioError> {
            if let Some(actors) = finished.get(&view) {
                return Ok(self.records(view, camera, actors, extras));
            }
            let mut shots = Shots { scenario: self, camera: &camera.camera, taken: HashMap::new() };
            let mut actors = Vec::with_capacity(states);
            for timestamp in 0..self.info.timestamps {
                shots.taken.clear();
                for branch in 0..self.info.branches.len() {
                    if stopped.load(Ordering::Relaxed) {
                        return Err(ScenarioError::Stopped);
                    }
                    let rendering = self.render_with(&mut shots, branch, timestamp, Detail::Observability)?;
                    self.write_frame(&writer, &frame_name(branch, timestamp, view), &rendering, extras)?;
                    actors.push(rendering.actor);
                    if progress(done.fetch_add(1, Ordering::Relaxed) + 1, total).is_break() {
                        stopped.store(true, Ordering::Relaxed);
                    }
                }
            }
            let records = self.records(view, camera, &actors, extras);
            writer.note(&ViewNote { view, actors })?;
            Ok(records)
        };
        let by_view: Vec<_> = self.cameras.par_iter().enumerate().map(of_view).collect();
        let mut records = Vec::with_capacity(total);
        for of_view in by_view {
            records.extend(of_view?);
        }
        if stopped.load(Ordering::Relaxed) {
            return Err(ScenarioError::Stopped);
        }
        records.sort_by_key(|r| (r.branch_and_timestamp, r.view));
        writer.finish(&records, Some(&self.info))?;
        Ok(())
    }

    /// Returns a line that identifies the rendered content; the program's version represents the renderer.
    fn identity(&self, extras: Extras) -> String {
        let mut hasher = DefaultHasher::new();
        format!("{:?}", (&self.config, &self.cameras, extras)).hash(&mut hasher);
        format!("{} {} {:016x}", self.info.name, env!("CARGO_PKG_VERSION"), hasher.finish())
    }

    /// Returns the records of one camera's images, with the actor's visibility by time step, then branch.
    fn records(
        &self,
        view: usize,
        camera: &ScenarioCamera,
        actors: &[Option<ActorView>],
        extras: Extras,
    ) -> Vec<FrameRecord> {
        let states = (0..self.info.timestamps).flat_map(|t| (0..self.info.branches.len()).map(move |b| (b, t)));
        states
            .zip(actors)
            .map(|((branch, timestamp), actor)| {
                let name = frame_name(branch, timestamp, view);
                let with_extras = extras == Extras::DepthAndMasks;
                FrameRecord {
                    branch_and_timestamp: Some((branch, timestamp)),
                    view: Some(view),
                    view_kind: Some(camera.view_kind.clone()),
                    observability: actor.map(|a| a.observability),
                    visible_fraction: actor.map(|a| a.visible_fraction),
                    actor_px: actor.map(|a| a.actor_px),
                    depth_file_path: with_extras.then(|| format!("depth/{name}")),
                    mask_file_path: with_extras.then(|| format!("masks/{name}")),
                    ..FrameRecord::new(format!("images/{name}"), camera.camera)
                }
            })
            .collect()
    }

    fn write_frame(
        &self,
        writer: &DatasetWriter,
        name: &str,
        rendering: &Rendering,
        extras: Extras,
    ) -> Result<(), ScenarioError> {
        writer.write_image(&format!("images/{name}"), &rendering.image)?;
        if extras == Extras::DepthAndMasks {
            let (w, h) = (rendering.image.width_px, rendering.image.height_px);
            writer.write_depth(&format!("depth/{name}"), &rendering.depth_m, w, h)?;
            let object = self.actor.as_ref().map(|a| self.scenery.next_object + a.dynamic as u16);
            let mask: Vec<bool> = rendering.object_id.iter().map(|id| Some(*id) == object).collect();
            writer.write_mask(&format!("masks/{name}"), &mask, w, h)?;
        }
        Ok(())
    }
}

fn frame_name(branch: usize, timestamp: usize, view: usize) -> String {
    format!("b{branch}_t{timestamp}_v{view:03}.png")
}

/// A camera whose images are all written, with the actor's visibility by time step, then branch.
#[derive(Serialize, Deserialize)]
struct ViewNote {
    view: usize,
    actors: Vec<Option<ActorView>>,
}

/// A camera's image of one placement.
struct Shot {
    image: Image,
    depth_m: Vec<f32>,
    object_id: Vec<u16>,
}

/// The images of one camera by placement: equal states share an image.
struct Shots<'a> {
    scenario: &'a Scenario,
    camera: &'a PinholeCamera,
    taken: HashMap<PlacementKey, Shot>,
}

impl Shots<'_> {
    fn take(&mut self, placement: &Placement) -> &Shot {
        let key = key_of(placement);
        let scenario = self.scenario;
        self.taken.entry(key).or_insert_with_key(|key| {
            let snap = |scene: &Scene| {
                let (image, depth_m, object_id) = scene.picture(&scenario.setting, self.camera);
                Shot { image, depth_m, object_id }
            };
            if let Some(scene) = scenario.scenes.get(key) {
                return snap(scene);
            }
            snap(&scenario.scene(placement))
        })
    }
}

fn mean_difference(a: &Image, b: &Image) -> f64 {
    let sum: u64 = a.rgb.iter().zip(&b.rgb).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.rgb.len().max(1) as f64
}

/// Returns the pixel range of projected points: lowest, and one past the highest. It is the maximum range if a point is
/// behind the camera.
fn reach(camera: &PinholeCamera, points: impl Iterator<Item = [f64; 3]>) -> ([i64; 2], [i64; 2]) {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let (mut behind, mut ahead) = (false, false);
    for point in points {
        match camera.project(point) {
            Some((pixel, depth)) if depth > 0.05 => {
                ahead = true;
                for i in 0..2 {
                    low[i] = low[i].min(pixel[i]);
                    high[i] = high[i].max(pixel[i]);
                }
            }
            _ => behind = true,
        }
    }
    match (ahead, behind) {
        (false, _) => ([0; 2], [0; 2]),
        (true, true) => ([i64::MIN / 4; 2], [i64::MAX / 4; 2]),
        (true, false) => (low.map(|v| v.floor() as i64 - 1), high.map(|v| v.ceil() as i64 + 1)),
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

/// Returns counterparts of a placement: without the actor if it is present; else with the actor at each of its poses in
/// other branches at this time step.
fn counterparts(
    own: &Placement,
    placements: &[Vec<Placement>],
    actor: Option<&Actor>,
    timestamp: usize,
) -> Vec<Placement> {
    let Some(actor) = actor else { return Vec::new() };
    let as_in = |other: Option<&Placement>| {
        let mut placement = own.clone();
        for &m in std::iter::once(&actor.dynamic).chain(&actor.followers) {
            placement[m] = other.and_then(|o| o[m]);
        }
        placement
    };
    if own[actor.dynamic].is_some() {
        return vec![as_in(None)];
    }
    let mut all: Vec<Placement> = Vec::new();
    for other in placements.iter().map(|b| &b[timestamp]).filter(|o| o[actor.dynamic].is_some()) {
        let with = as_in(Some(other));
        if !all.contains(&with) {
            all.push(with);
        }
    }
    all
}

/// Places a mover by its courses; `replaces` sets the pose and returns whether the mover was already placed.
fn place(
    source: &Source,
    config: &ScenarioConfig,
    mover: Mover,
    branch_index: impl Fn(&Spanned<String>, &str) -> Result<usize, ScenarioError>,
    mut replaces: impl FnMut(usize, usize, Pose) -> bool,
) -> Result<(), ScenarioError> {
    let known = mover.variants();
    for course in mover.courses() {
        let each = |found: usize, what: &str| {
            (found != config.timestamps)
                .then(|| format!("{found} {what}; one for each of the {} timestamps is needed", config.timestamps))
        };
        if let Some(problem) = each(course.poses.len(), "poses") {
            return Err(source.error(course.poses_at.start, "poses", problem));
        }
        if course.poses.iter().flatten().any(|value| value.is_nan() || value.abs() > 1e5) {
            let problem = match mover {
                Mover::Vehicle(_) => "a value is out of range; [x, y, yaw in degrees]",
                Mover::Object(_) => "a value is out of range; [x, y, z, yaw in degrees]",
            };
            return Err(source.error(course.poses_at.start, "poses", problem));
        }
        let mut variants = vec![None; config.timestamps];
        if let Some(names) = course.variants {
            if let Some(problem) = each(names.get_ref().len(), "variants") {
                return Err(source.error_at(names, "variants", problem));
            }
            for (variant, name) in variants.iter_mut().zip(names.get_ref()) {
                let Some(index) = known.iter().position(|k| k == name) else {
                    let hint = carff_base::names::hint(name, known.iter().copied());
                    let problem = format!("no part has the variant `{name}`; there are {known:?}{hint}");
                    return Err(source.error_at(names, "variants", problem));
                };
                *variant = Some(index);
            }
        }
        for name in course.branches {
            let branch = branch_index(name, "branches")?;
            for (timestamp, ([x, y, z, yaw], variant)) in course.poses.iter().zip(&variants).enumerate() {
                let pose = Pose { position_m: [*x, *y, *z], yaw: yaw.to_radians(), variant: *variant };
                if replaces(branch, timestamp, pose) {
                    let problem = format!("`{}` has two courses in branch `{}`", mover.name(), name.get_ref());
                    return Err(source.error_at(name, "branches", problem));
                }
            }
        }
    }
    Ok(())
}

type Checked = (Vec<Vec<Placement>>, Option<Actor>, Vec<usize>);

/// Checks cross-references: names, lengths of courses, at most one dynamic mover.
fn check(source: &Source, config: &ScenarioConfig) -> Result<Checked, ScenarioError> {
    if config.branches.is_empty() || config.branches.len() > 64 {
        return Err(source.error_in("branches", format!("{} names; from 1 to 64 are allowed", config.branches.len())));
    }
    if (0..3).any(|i| config.bounds_m[0][i] >= config.bounds_m[1][i]) {
        return Err(source.error_in("bounds_m", "the first corner must be below the second along every axis"));
    }
    for (i, name) in config.branches.iter().enumerate() {
        if config.branches[..i].contains(name) {
            return Err(source.error_in("branches", format!("`{name}` is named twice")));
        }
    }
    let known = || config.branches.iter().map(|b| format!("`{b}`")).collect::<Vec<_>>().join(", ");
    let branch_index = |name: &Spanned<String>, key: &str| {
        config.branches.iter().position(|b| b == name.get_ref()).ok_or_else(|| {
            let hint = carff_base::names::hint(name.get_ref(), config.branches.iter().map(String::as_str));
            let problem = format!("there is no branch `{}`; there are {}{hint}", name.get_ref(), known());
            source.error_at(name, key, problem)
        })
    };
    let hazard_branches =
        config.hazard_branches.iter().map(|b| branch_index(b, "hazard_branches")).collect::<Result<Vec<_>, _>>()?;
    for (key, boxes) in [
        ("slab", config.slab.iter().map(|b| (b.min, b.max)).collect::<Vec<_>>()),
        ("building", config.building.iter().map(|b| (b.min, b.max)).collect()),
    ] {
        if let Some((min, max)) = boxes.iter().find(|(min, max)| min[0] >= max[0] || min[1] >= max[1]) {
            return Err(source.error_in(key, format!("`min` {min:?} must be below `max` {max:?} along both axes")));
        }
    }
    let count = movers(config).count();
    let mut placements = vec![vec![vec![None; count]; config.timestamps]; config.branches.len()];
    let mut dynamic = None;
    for (m, mover) in movers(config).enumerate() {
        if movers(config).take(m).any(|other| other.name() == mover.name()) {
            return Err(source.error_in(mover.key(), format!("`{}` is named twice", mover.name())));
        }
        if mover.dynamic() && dynamic.replace(m).is_some() {
            return Err(source.error_in("dynamic", "more than one vehicle or object is dynamic; at most one may be"));
        }
        if let Some(pose) = mover.still() {
            placements.iter_mut().flatten().for_each(|placement| placement[m] = Some(pose));
        }
        place(source, config, mover, branch_index, |branch, timestamp, pose| {
            placements[branch][timestamp][m].replace(pose).is_some()
        })?;
    }
    let mut followers = Vec::new();
    for (m, mover) in movers(config).enumerate() {
        let Some(leader) = mover.follows() else { continue };
        let is_leader = |d: usize| movers(config).nth(d).is_some_and(|l| l.name() == leader.get_ref()) && d != m;
        if !dynamic.is_some_and(is_leader) {
            let hint =
                carff_base::names::hint(leader.get_ref(), movers(config).filter(Mover::dynamic).map(|m| m.name()));
            let problem = format!("`{}` is not another, dynamic vehicle or object{hint}", leader.get_ref());
            return Err(source.error_at(leader, "follows", problem));
        }
        followers.push(m);
    }
    let actor = dynamic.map(|dynamic| Actor { dynamic, followers });
    for group in &config.dash {
        if !config.vehicle.iter().any(|v| v.name == *group.vehicle.get_ref()) {
            let hint = carff_base::names::hint(group.vehicle.get_ref(), config.vehicle.iter().map(|v| v.name.as_str()));
            let problem = format!("there is no vehicle `{}`{hint}", group.vehicle.get_ref());
            return Err(source.error_at(&group.vehicle, "vehicle", problem));
        }
    }
    check_variations(source, config)?;
    Ok((placements, actor, hazard_branches))
}

/// Checks that appearances have a dynamic vehicle, and that names occur once.
fn check_variations(source: &Source, config: &ScenarioConfig) -> Result<(), ScenarioError> {
    if !config.appearance.is_empty() && !config.vehicle.iter().any(|v| v.dynamic) {
        return Err(source.error_in("appearance", "no vehicle is dynamic; set `dynamic = true` of the one to replace"));
    }
    let twice =
        |names: Vec<&str>| (1..names.len()).find(|i| names[..*i].contains(&names[*i])).map(|i| names[i].to_owned());
    if let Some(name) = twice(config.appearance.iter().map(|a| a.name.as_str()).collect()) {
        return Err(source.error_in("appearance", format!("`{name}` is named twice")));
    }
    let objects = movers(config).map(|m| m.name()).chain(config.bystander.iter().map(|b| b.name.as_str()));
    match twice(objects.collect()) {
        Some(name) => Err(source.error_in("bystander", format!("`{name}` is named twice"))),
        None => Ok(()),
    }
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
        hazard_action: config.actions.hazard.clone(),
        clear_action: config.actions.clear.clone(),
    }
}
