//! Free drives: images from a moving camera, at poses that are not in any dataset.
//!
//! A drive passes through the time steps of one branch, with a fixed number of frames per step. The ego moves
//! continuously. With the last frame of a time step it reaches the state's pose, except for a small random deviation to
//! the side, along and in heading. All other actors are at the poses of the current state, so that no frame shows a
//! later state. The camera is on the ego's roof. If no roof view is a trial of the wanted kind, because a building
//! hides the place, the camera is drawn from all of the scenario's ranges and drifts.
//!
//! All random values of drive `n` come from the streams (seed, frame `n`, step `drvf`, sample `try`), so drives can be
//! made one by one, in any order. [`carff_dataset::ScenarioInfo::trial_kind`] defines the kind of a trial; it is
//! evaluated on images of a third of the width and height.
//!
//! ```no_run
//! use carff_scenes::Scenario;
//! # fn main() -> Result<(), carff_scenes::ScenarioError> {
//! let scenario = Scenario::load("configs/scenarios/approaching-intersection.toml".as_ref())?;
//! for number in 0..300 {
//!     let drive = scenario.free_drive(number, 6, 1)?;
//!     let decisive = scenario.free_frame(&drive, drive.decisive_frame())?;
//!     assert_eq!(decisive.timestamp, drive.eligible_timestamp());
//! }
//! # Ok(())
//! # }
//! ```

use std::f64::consts::TAU;

use carff_base::geometry::PinholeCamera;
use carff_base::random::Key;
use carff_dataset::drives::DriveKind;
use carff_dataset::{Image, Observability};
use rand::Rng;
use rand::seq::IndexedRandom;

use crate::cameras::{Mount, free_camera};
use crate::error::ScenarioError;
use crate::movers::Pose;
use crate::scenario::{Placement, Scenario};

/// Frames between two time steps of the drives of training and evaluation, as the cameras of the shipped graphs take.
pub const FRAMES_PER_TIMESTAMP: usize = 6;

/// Name of the random stream.
const STREAM: u32 = Key::named("drvf", 0, 0).step;
/// Maximum number of drawn drives.
pub(crate) const MAX_TRIES: u32 = 400;
/// Number of tries that only use the ego's roof.
const ROOF_TRIES: u32 = 2;
/// Largest deviation of the ego to the side and along its course, metres, and in heading, radians.
const ASIDE_M: f64 = 0.25;
const ALONG_M: f64 = 0.35;
const HEADING: f64 = 0.035;
/// Largest sway of the camera about its course, metres and radians, and its largest frequency per time step.
const SWAY_M: f64 = 0.03;
const SWAY: f64 = 0.012;
const SWAYS: f64 = 1.5;
/// Drift of a camera that is not on the ego, per time step, along each axis, metres.
const DRIFT_M: f64 = 0.4;
/// Factor by which images for the truth are smaller along each side, because each truth needs up to two images.
const TRUTH_SHARE: u32 = 3;
/// Clearance of scenarios with roads, metres. Random lengths scale with a scenario's own clearance.
const ROAD_CLEARANCE_M: f64 = 0.45;

/// A planned drive.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeDrive {
    branch: usize,
    kind: DriveKind,
    eligible_timestamp: usize,
    timestamps: usize,
    frames_per_timestamp: usize,
    view_kind: String,
    course: Course,
}

/// Random values of a drive.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Course {
    aside_m: f64,
    along_m: f64,
    heading: f64,
    /// Phase and cycles per time step, for x, y, z and yaw.
    sway: [[f64; 2]; 4],
    camera: Carrier,
    /// Pan of a roof camera about its mounting direction: amplitude in radians, phase, cycles per time step.
    pan: [f64; 3],
    /// Scale of all random lengths.
    scale: f64,
}

/// Carrier of the camera.
#[derive(Clone, Debug, PartialEq)]
enum Carrier {
    /// The roof of the vehicle of this index.
    Roof { vehicle: usize, mount: Mount },
    /// A free camera that drifts from a pose by a vector per time step.
    Drifting { from: PinholeCamera, drift_m: [f64; 3] },
}

/// A frame of a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeFrame {
    /// The image, without sensor noise.
    pub image: Image,
    /// Pose and intrinsics of the camera.
    pub camera: PinholeCamera,
    /// Hidden branch.
    pub branch: usize,
    /// Time step of the branch.
    pub timestamp: usize,
    /// Visibility of the actor or of its place; `None` if nothing in the scenario is dynamic.
    pub observability: Option<Observability>,
    /// True for the time step's last frame, at the state's own pose.
    pub last_of_timestamp: bool,
}

impl FreeDrive {
    /// A drive of one frame per time step without a right answer.
    pub(crate) fn of_course(
        branch: usize,
        timestamps: usize,
        frames_per_timestamp: usize,
        view_kind: String,
        course: Course,
    ) -> Self {
        let kind = DriveKind::Clear;
        Self { branch, kind, eligible_timestamp: 0, timestamps, frames_per_timestamp, view_kind, course }
    }

    /// Returns the same drive through another branch.
    pub(crate) fn through(&self, branch: usize) -> Self {
        Self { branch, ..self.clone() }
    }

    /// Returns the hidden branch.
    pub fn branch(&self) -> usize {
        self.branch
    }

    /// Returns the right answer at [`Self::eligible_timestamp`].
    pub fn kind(&self) -> DriveKind {
        self.kind
    }

    /// Returns the first time step whose decision has one right answer.
    pub fn eligible_timestamp(&self) -> usize {
        self.eligible_timestamp
    }

    /// Returns the kind of the camera's group.
    pub fn view_kind(&self) -> &str {
        &self.view_kind
    }

    /// Returns the number of frames of the drive.
    pub fn frame_count(&self) -> usize {
        self.timestamps * self.frames_per_timestamp
    }

    /// Returns the frame whose decision counts: the last one of the eligible time step.
    pub fn decisive_frame(&self) -> usize {
        self.last_frame_of(self.eligible_timestamp)
    }

    /// Returns the time step of a frame.
    pub fn timestamp_of(&self, frame: usize) -> usize {
        frame / self.frames_per_timestamp.max(1)
    }

    /// Returns the last frame of a time step.
    pub fn last_frame_of(&self, timestamp: usize) -> usize {
        (timestamp + 1) * self.frames_per_timestamp - 1
    }

    /// Returns the time of a frame in time steps: 0 at the first state, whole numbers at the last frame of each time
    /// step.
    fn time(&self, frame: usize) -> f64 {
        (frame + 1) as f64 / self.frames_per_timestamp as f64 - 1.0
    }
}

impl Scenario {
    /// Plans drive `number`. Even drives are hazard trials, odd ones clear trials; without hazards, all are clear.
    /// `frames_per_timestamp` is at least 1. The same arguments give the same drive.
    pub fn free_drive(&self, number: u64, frames_per_timestamp: usize, seed: u64) -> Result<FreeDrive, ScenarioError> {
        let info = self.info();
        let hazards = !info.hazard_branches.is_empty();
        let kind = if hazards && number.is_multiple_of(2) { DriveKind::Hazard } else { DriveKind::Clear };
        let branches: Vec<usize> =
            (0..info.branches.len()).filter(|b| info.is_hazard(*b) == (kind == DriveKind::Hazard)).collect();
        for sample in 0..MAX_TRIES {
            let mut rng = carff_base::random::stream(Key { seed, frame: number, step: STREAM, sample });
            let Some(&branch) = branches.choose(&mut rng) else { break };
            let roof = kind == DriveKind::Hazard || sample < ROOF_TRIES;
            let (view_kind, course) = self.course(branch, roof, &mut rng)?;
            let timestamps = info.timestamps;
            let mut drive =
                FreeDrive { branch, kind, eligible_timestamp: 0, timestamps, frames_per_timestamp, view_kind, course };
            if !(0..drive.frame_count()).all(|f| self.stands_clear(&drive, f)) {
                continue;
            }
            let eligible = (0..timestamps).find(|t| {
                drive.eligible_timestamp = *t;
                let (camera, placement) = self.free_view(&drive, drive.decisive_frame());
                let seen = self.free_observability(&placement, *t, &camera);
                info.trial_kind(branch, *t, seen) == Some(kind)
            });
            if eligible.is_some() {
                return Ok(drive);
            }
        }
        Err(ScenarioError::NoDrive { path: self.path().to_owned(), kind, tries: MAX_TRIES })
    }

    /// Draws a course with its camera: on a roof where `roof` is set and the branch has one, else drifting. Returns the
    /// kind of the camera's group and the course.
    pub(crate) fn course(
        &self,
        branch: usize,
        roof: bool,
        rng: &mut impl Rng,
    ) -> Result<(String, Course), ScenarioError> {
        let on_roof = self.roof(branch, rng).filter(|_| roof);
        let (view_kind, camera) = match on_roof {
            Some(on_roof) => on_roof,
            None => self.drifting(rng)?,
        };
        let scale = self.config().clearance_m / ROAD_CLEARANCE_M;
        let mut within = |limit: f64| rng.random_range(-limit..=limit);
        let course = Course {
            aside_m: within(ASIDE_M) * scale,
            along_m: within(ALONG_M) * scale,
            heading: within(HEADING),
            sway: [(); 4].map(|()| [within(TAU), 0.3 + (SWAYS - 0.3) * within(1.0).abs()]),
            camera,
            pan: [0.0; 3],
            scale,
        };
        Ok((view_kind, course))
    }

    /// Renders frame `frame` of a drive, 0 to [`FreeDrive::frame_count`] - 1, with its truth.
    pub fn free_frame(&self, drive: &FreeDrive, frame: usize) -> Result<FreeFrame, ScenarioError> {
        let timestamp = drive.timestamp_of(frame);
        if self.info().state(drive.branch, timestamp).is_none() {
            return Err(ScenarioError::NoSuchState {
                branch: drive.branch,
                timestamp,
                branches: self.info().branches.len(),
                timestamps: self.info().timestamps,
            });
        }
        let (camera, placement) = self.free_view(drive, frame);
        Ok(FreeFrame {
            image: self.image_of(&placement, &camera),
            camera,
            branch: drive.branch,
            timestamp,
            observability: self.free_observability(&placement, timestamp, &camera),
            last_of_timestamp: (frame + 1).is_multiple_of(drive.frames_per_timestamp),
        })
    }

    /// Evaluates visibility on a smaller image, because it is a share of pixels.
    pub(crate) fn free_observability(
        &self,
        placement: &Placement,
        timestamp: usize,
        camera: &PinholeCamera,
    ) -> Option<Observability> {
        let camera = camera.resized(camera.width_px.div_ceil(TRUTH_SHARE), camera.height_px.div_ceil(TRUTH_SHARE));
        self.observability_of(placement, timestamp, &camera)
    }

    /// Returns a roof camera from one of the scenario's groups. Returns `None` if there is no such group, or if its
    /// vehicle is absent at a time step of the branch.
    fn roof(&self, branch: usize, rng: &mut impl Rng) -> Option<(String, Carrier)> {
        let group = self.config().dash.choose(rng)?;
        let vehicle = self.config().vehicle.iter().position(|v| v.name == *group.vehicle.get_ref())?;
        let mount = Mount::draw(group, rng);
        let there = self.placements()[branch].iter().all(|placement| placement[vehicle].is_some());
        there.then(|| (group.view_kind.clone(), Carrier::Roof { vehicle, mount }))
    }

    fn drifting(&self, rng: &mut impl Rng) -> Result<(String, Carrier), ScenarioError> {
        let drawn = free_camera(self.config(), self.obstacles(), |name| self.places_of(name), rng)
            .map_err(|key| ScenarioError::NoRoom { path: self.path().to_owned(), key })?;
        let scale = self.config().clearance_m / ROAD_CLEARANCE_M;
        let drift_m = [(); 3].map(|()| rng.random_range(-DRIFT_M..=DRIFT_M) * scale);
        Ok((drawn.view_kind, Carrier::Drifting { from: drawn.camera, drift_m }))
    }

    /// Returns true if the camera is free of obstacles. A roof camera is above its own vehicle.
    pub(crate) fn stands_clear(&self, drive: &FreeDrive, frame: usize) -> bool {
        self.obstacles().clear(self.free_view(drive, frame).0.position_m())
    }

    /// Returns camera and placement of a frame.
    pub(crate) fn free_view(&self, drive: &FreeDrive, frame: usize) -> (PinholeCamera, Placement) {
        let (time, course) = (drive.time(frame), &drive.course);
        let steps = &self.placements()[drive.branch];
        let timestamp = drive.timestamp_of(frame).min(steps.len() - 1);
        let mut placement = steps[timestamp].clone();
        for (v, vehicle) in self.config().vehicle.iter().enumerate().filter(|(_, v)| v.role == "ego") {
            if let Some(pose) = moving(steps, v, time).filter(|_| !vehicle.dynamic) {
                placement[v] = Some(course.deviate(pose));
            }
        }
        let [x, y, z, yaw] = course.swaying(time);
        let image = &self.config().image;
        let look = |eye: [f64; 3], target: [f64; 3], up: [f64; 3]| {
            PinholeCamera::look_at(eye, target, up, image.width_px, image.height_px, image.fov_deg)
        };
        let camera = match &course.camera {
            Carrier::Roof { vehicle, mount } => {
                let pose = placement[*vehicle].or_else(|| moving(steps, *vehicle, time));
                let [px, py, _] = pose.map_or([0.0; 3], |p| p.position_m);
                let facing = pose.map_or(0.0, |p| p.yaw);
                let left = mount.left + yaw + course.panned(time);
                let mount = Mount { height_m: mount.height_m + z, left, ..*mount };
                let (eye, target) = mount.at([px + x, py + y, facing]);
                look(eye, target, [0.0, 0.0, 1.0])
            }
            Carrier::Drifting { from, drift_m } => {
                let m = &from.world_from_camera;
                let at = from.position_m();
                let eye = [at[0] + drift_m[0] * time + x, at[1] + drift_m[1] * time + y, at[2] + drift_m[2] * time + z];
                let about = |v: [f64; 3]| {
                    let (s, c) = yaw.sin_cos();
                    [c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]]
                };
                let (ahead, up) = (about([-m[0][2], -m[1][2], -m[2][2]]), about([m[0][1], m[1][1], m[2][1]]));
                look(eye, [0, 1, 2].map(|i| eye[i] + ahead[i]), up)
            }
        };
        (camera, placement)
    }
}

impl Course {
    /// Returns a pose with the drive's deviation.
    fn deviate(&self, pose: Pose) -> Pose {
        let (s, c) = pose.yaw.sin_cos();
        let [x, y, z] = pose.position_m;
        let position_m = [x + c * self.along_m - s * self.aside_m, y + s * self.along_m + c * self.aside_m, z];
        Pose { position_m, yaw: pose.yaw + self.heading, ..pose }
    }

    /// Lets a roof camera pan over a range of directions, radians left of straight ahead. Any other camera stays as
    /// drawn.
    pub(crate) fn pan_over(&mut self, [low, high]: [f64; 2], phase: f64, cycles: f64) {
        if let Carrier::Roof { mount, .. } = &mut self.camera {
            mount.left = f64::midpoint(low, high);
            self.pan = [(high - low) / 2.0, phase, cycles];
        }
    }

    /// Returns the pan, radians.
    fn panned(&self, time: f64) -> f64 {
        let [amplitude, phase, cycles] = self.pan;
        amplitude * (phase + TAU * cycles * time).sin()
    }

    /// Returns the sway: x, y, z in metres and yaw in radians.
    fn swaying(&self, time: f64) -> [f64; 4] {
        let amplitudes = [SWAY_M * self.scale, SWAY_M * self.scale, SWAY_M * self.scale, SWAY];
        std::array::from_fn(|i| amplitudes[i] * (self.sway[i][0] + TAU * self.sway[i][1] * time).sin())
    }
}

/// Returns the pose of a mover between time steps, by linear interpolation; before the first step it extrapolates.
/// Returns `None` if the mover is absent.
fn moving(steps: &[Placement], mover: usize, time: f64) -> Option<Pose> {
    let last = steps.len().saturating_sub(2);
    let from = (time.floor().max(0.0) as usize).min(last);
    let to = (from + 1).min(steps.len() - 1);
    let (a, b) = (steps[from][mover]?, steps[to][mover]?);
    let t = time - from as f64;
    let turn = (b.yaw - a.yaw + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
    Some(Pose {
        position_m: [0, 1, 2].map(|i| a.position_m[i] + t * (b.position_m[i] - a.position_m[i])),
        yaw: a.yaw + t * turn,
        ..a
    })
}
