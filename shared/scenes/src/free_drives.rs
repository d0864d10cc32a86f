//! Free drives: what a moving camera sees, from poses that no dataset has.
//!
//! A drive goes through the timestamps of one branch, with so many frames for each. The ego moves all the time: with the
//! last frame of a timestamp it arrives at that state's place, but for a small deviation to the side, along and in
//! heading that is drawn for each drive. Everybody else stands where the state says, so that nothing is shown before the
//! state that shows it. The camera sits on the ego's roof; where no view from there is a trial of the wanted kind (no
//! place that a building hides is seen to be clear), it is drawn from all of the scenario's ranges and drifts along.
//!
//! All that is drawn for drive `n` comes from the streams (seed, frame `n`, step `0x6472_7666`, sample `try`): drives can
//! be made one by one, in any order. A drive is a trial of its kind as [`carff_dataset::ScenarioInfo::trial_kind`] says, which is judged
//! on images of a third of the width and height.
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

use carff_dataset::drives::DriveKind;
use carff_dataset::{Image, Observability};
use carff_geometry::PinholeCamera;
use carff_random::Key;
use rand::Rng;
use rand::seq::IndexedRandom;

use crate::cameras::{Mount, free_camera};
use crate::error::ScenarioError;
use crate::movers::Pose;
use crate::scenario::{Placement, Scenario};

/// Names this use of a seed.
const STREAM: u32 = 0x6472_7666;
/// Drives drawn before giving up.
const MAX_TRIES: u32 = 400;
/// So many of them look for a trial from the ego's roof alone.
const ROOF_TRIES: u32 = 2;
/// Largest deviation of the ego to the side and along its course, metres, and in heading, radians.
const ASIDE_M: f64 = 0.25;
const ALONG_M: f64 = 0.35;
const HEADING: f64 = 0.035;
/// How far the camera sways about its course, metres and radians, and how often in a timestamp, at most.
const SWAY_M: f64 = 0.03;
const SWAY: f64 = 0.012;
const SWAYS: f64 = 1.5;
/// How far a camera that is not on the ego drifts in a timestamp, along each axis, metres.
const DRIFT_M: f64 = 0.4;
/// Truth is judged on images so many times smaller, along each side: it costs up to two of them.
const TRUTH_SHARE: u32 = 3;
/// Least distance from things in scenarios as large as roads, metres: others are as much smaller as theirs is.
const ROAD_CLEARANCE_M: f64 = 0.45;

/// A drive, planned.
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

/// What was drawn for one drive.
#[derive(Clone, Debug, PartialEq)]
struct Course {
    aside_m: f64,
    along_m: f64,
    heading: f64,
    /// Amplitude-free: phase and cycles a timestamp, for x, y, z and yaw.
    sway: [[f64; 2]; 4],
    camera: Carrier,
    /// Scale of all that is drawn in metres.
    scale: f64,
}

/// What the camera is on.
#[derive(Clone, Debug, PartialEq)]
enum Carrier {
    /// The roof of the vehicle of this index.
    Roof { vehicle: usize, mount: Mount },
    /// Nothing: it drifts from a pose by so much a timestamp.
    Drifting { from: PinholeCamera, drift_m: [f64; 3] },
}

/// One frame of a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeFrame {
    /// The image, without sensor noise.
    pub image: Image,
    /// Where it was taken.
    pub camera: PinholeCamera,
    /// Hidden branch.
    pub branch: usize,
    /// Step of it.
    pub timestamp: usize,
    /// How much of the actor, or of its place, is seen; `None` when nothing in the scenario is dynamic.
    pub observability: Option<Observability>,
    /// Whether this is the timestamp's last frame, at the state's own place.
    pub last_of_timestamp: bool,
}

impl FreeDrive {
    /// Hidden branch.
    pub fn branch(&self) -> usize {
        self.branch
    }

    /// The right answer at [`Self::eligible_timestamp`].
    pub fn kind(&self) -> DriveKind {
        self.kind
    }

    /// The first timestamp whose decision has one right answer.
    pub fn eligible_timestamp(&self) -> usize {
        self.eligible_timestamp
    }

    /// Kind of the camera: that of the group that it was drawn from.
    pub fn view_kind(&self) -> &str {
        &self.view_kind
    }

    /// Frames of the whole drive.
    pub fn frame_count(&self) -> usize {
        self.timestamps * self.frames_per_timestamp
    }

    /// The frame whose decision counts: the last one of the eligible timestamp.
    pub fn decisive_frame(&self) -> usize {
        (self.eligible_timestamp + 1) * self.frames_per_timestamp - 1
    }

    /// Time of a frame in timestamps: 0 at the first state, whole numbers at the last frame of each timestamp.
    fn time(&self, frame: usize) -> f64 {
        (frame + 1) as f64 / self.frames_per_timestamp as f64 - 1.0
    }
}

impl Scenario {
    /// Plans drive `number`: even ones are hazard trials, odd ones clear ones; all are clear ones where the scenario has
    /// no hazard. `frames_per_timestamp` is at least 1. The same arguments give the same drive.
    pub fn free_drive(&self, number: u64, frames_per_timestamp: usize, seed: u64) -> Result<FreeDrive, ScenarioError> {
        let info = self.info();
        let hazards = !info.hazard_branches.is_empty();
        let kind = if hazards && number.is_multiple_of(2) { DriveKind::Hazard } else { DriveKind::Clear };
        let branches: Vec<usize> =
            (0..info.branches.len()).filter(|b| info.is_hazard(*b) == (kind == DriveKind::Hazard)).collect();
        for sample in 0..MAX_TRIES {
            let mut rng = carff_random::stream(Key { seed, frame: number, step: STREAM, sample });
            let Some(&branch) = branches.choose(&mut rng) else { break };
            let roof = self.roof(branch, &mut rng).filter(|_| kind == DriveKind::Hazard || sample < ROOF_TRIES);
            let (view_kind, camera) = match roof {
                Some(roof) => roof,
                None => self.drifting(&mut rng)?,
            };
            let scale = self.config().clearance_m / ROAD_CLEARANCE_M;
            let mut within = |limit: f64| rng.random_range(-limit..=limit);
            let course = Course {
                aside_m: within(ASIDE_M) * scale,
                along_m: within(ALONG_M) * scale,
                heading: within(HEADING),
                sway: [(); 4].map(|()| [within(TAU), 0.3 + (SWAYS - 0.3) * within(1.0).abs()]),
                camera,
                scale,
            };
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

    /// Renders frame `frame` of a drive, 0 to [`FreeDrive::frame_count`] - 1, with its truth.
    pub fn free_frame(&self, drive: &FreeDrive, frame: usize) -> Result<FreeFrame, ScenarioError> {
        let timestamp = frame / drive.frames_per_timestamp.max(1);
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
            image: self.picture_of(&placement, &camera),
            camera,
            branch: drive.branch,
            timestamp,
            observability: self.free_observability(&placement, timestamp, &camera),
            last_of_timestamp: (frame + 1).is_multiple_of(drive.frames_per_timestamp),
        })
    }

    /// All frames of a drive, rendered one by one.
    pub fn free_frames<'a>(
        &'a self,
        drive: &'a FreeDrive,
    ) -> impl Iterator<Item = Result<FreeFrame, ScenarioError>> + 'a {
        (0..drive.frame_count()).map(|frame| self.free_frame(drive, frame))
    }

    /// Judged on a smaller image, as it is a share of pixels.
    fn free_observability(
        &self,
        placement: &Placement,
        timestamp: usize,
        camera: &PinholeCamera,
    ) -> Option<Observability> {
        let camera = camera.resized(camera.width_px.div_ceil(TRUTH_SHARE), camera.height_px.div_ceil(TRUTH_SHARE));
        self.observability_of(placement, timestamp, &camera)
    }

    /// A camera on a roof, from one of the scenario's groups of such cameras; none when there is none, or when its
    /// vehicle is absent at some timestamp of the branch.
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

    /// Whether nothing is where the camera is. One on a roof is above its own vehicle.
    fn stands_clear(&self, drive: &FreeDrive, frame: usize) -> bool {
        self.obstacles().clear(self.free_view(drive, frame).0.position_m())
    }

    /// Camera and placement of a frame.
    fn free_view(&self, drive: &FreeDrive, frame: usize) -> (PinholeCamera, Placement) {
        let (time, course) = (drive.time(frame), &drive.course);
        let steps = &self.placements()[drive.branch];
        let timestamp = (frame / drive.frames_per_timestamp.max(1)).min(steps.len() - 1);
        let mut placement = steps[timestamp].clone();
        for (v, vehicle) in self.config().vehicle.iter().enumerate().filter(|(_, v)| v.role == "ego") {
            if let Some(pose) = moving(steps, v, time).filter(|_| !vehicle.dynamic) {
                placement[v] = Some(course.deviate(pose));
            }
        }
        let [x, y, z, yaw] = course.swaying(time);
        let picture = &self.config().picture;
        let look = |eye: [f64; 3], target: [f64; 3], up: [f64; 3]| {
            PinholeCamera::look_at(eye, target, up, picture.width_px, picture.height_px, picture.fov_deg)
        };
        let camera = match &course.camera {
            Carrier::Roof { vehicle, mount } => {
                let pose = placement[*vehicle].or_else(|| moving(steps, *vehicle, time));
                let [px, py, _] = pose.map_or([0.0; 3], |p| p.position_m);
                let facing = pose.map_or(0.0, |p| p.yaw);
                let mount = Mount { height_m: mount.height_m + z, left: mount.left + yaw, ..*mount };
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
    /// A pose, with what was drawn for this drive.
    fn deviate(&self, pose: Pose) -> Pose {
        let (s, c) = pose.yaw.sin_cos();
        let [x, y, z] = pose.position_m;
        let position_m = [x + c * self.along_m - s * self.aside_m, y + s * self.along_m + c * self.aside_m, z];
        Pose { position_m, yaw: pose.yaw + self.heading, ..pose }
    }

    /// x, y, z in metres and yaw in radians.
    fn swaying(&self, time: f64) -> [f64; 4] {
        let amplitudes = [SWAY_M * self.scale, SWAY_M * self.scale, SWAY_M * self.scale, SWAY];
        std::array::from_fn(|i| amplitudes[i] * (self.sway[i][0] + TAU * self.sway[i][1] * time).sin())
    }
}

/// Where a mover is between timestamps, on straight lines; before the first one, on the first line backwards. `None`
/// where it is absent.
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
