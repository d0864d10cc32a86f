//! The limits of the known: calibrated on images of known states, for a checkpoint whose field is trained.
//!
//! The images come from free poses of the scenario and from drives whose camera pans, as many of each, from a seed that no
//! evaluation uses. A dataset without a scenario file uses its trained poses, on which the field errs less than elsewhere.

use crate::TrainingError;
use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_base::random::{Key, tag};
use carff_checkpoint::{Manifest, load_field};
use carff_dataset::{
    Image, PoseRole,
    sensor::{SensorNoise, apply_noise_into},
};
use carff_evaluation::{PosedImages, Progress};
use carff_field::{Field, InstructionSet};
use carff_messages::LATENT_DIM;
use carff_scenes::{FRAMES_PER_TIMESTAMP, Scenario};
use carff_unknown::{CameraLimits, Comparer, Comparison, Known, KnownScene, Lanes, Measured, OwnBox};
use std::collections::BTreeSet;
use std::path::Path;

/// Part of the seed of these images, so that they share no draws with training, thresholds or evaluation.
const KNOWN: u64 = tag("known");
/// Length of the vehicle that carries the camera, times this, is the distance below which nothing is judged.
const BEYOND_VEHICLE: f64 = 1.25;
/// Margin of the vehicle's own pose, metres.
const POSE_MARGIN_M: f64 = 0.5;
/// Share of a place's size by which the ground around it counts, where a scenario has no roads.
const AROUND_PLACE: f64 = 0.75;
/// Largest number of images of the dataset on which the camera's limits rest.
const MOST_IMAGES: usize = 400;
/// Factor of the limit where the images are of trained poses.
const TRAINED_POSES: f32 = 1.5;

/// Input of the calibration.
#[derive(Clone, Copy)]
pub struct KnownInput<'a> {
    /// Folder of the checkpoint; `known.json` is written into it.
    pub checkpoint: &'a Path,
    /// Folder of its dataset.
    pub dataset: &'a Path,
    /// Scenario of the dataset; `None` for any other dataset.
    pub scenario: Option<&'a Scenario>,
    /// Free poses of the scenario, each with an image of each branch, and as many images of drives.
    pub free_poses: usize,
    /// Threads that render.
    pub threads: usize,
}

/// Calibrates the limits and writes them into the checkpoint.
pub fn calibrate_known(input: KnownInput, on_progress: &dyn Fn(&Progress)) -> Result<Known, TrainingError> {
    let manifest = Manifest::load(input.checkpoint)?;
    let mut field = load_field(input.checkpoint, &manifest)?;
    field.set_instruction_set(InstructionSet::detect_for_images());
    let posed = PosedImages::open(input.dataset, manifest.split.seed)?;
    let hazard_states = manifest.scenario.hazard_states();
    let mut work = Work {
        hazard_states: hazard_states.clone(),
        lanes: lanes(&manifest, &field, input.scenario),
        states: manifest.states.iter().map(|state| state.mean).collect(),
        field,
        seed: manifest.seed ^ KNOWN,
        threads: input.threads,
        comparer: Comparer::default(),
    };
    work.comparer = Comparer::new(&work.field, &work.lanes);
    let comparisons = match input.scenario {
        Some(scenario) => work.free_poses(scenario, input.free_poses, on_progress)?,
        None => work.trained_poses(&posed, on_progress),
    };
    let camera = camera_limits(&posed, work.seed);
    let fit = |comparisons: &[(usize, Comparison)]| {
        Known::fit(work.lanes.clone(), hazard_states.clone(), comparisons, camera)
    };
    let mut known = fit(&comparisons.all);
    // A view of a drive may show hardly anything of the place: it does not lower the limit for other places.
    known.least_explained = fit(&comparisons.of_poses()).least_explained;
    if input.scenario.is_none() {
        known.clear = known.clear.times(TRAINED_POSES);
        known.hazard = known.hazard.times(TRAINED_POSES);
    }
    known.save(input.checkpoint)?;
    Ok(known)
}

/// Comparisons of images, each with the state that it shows.
#[derive(Default)]
struct Compared {
    all: Vec<(usize, Comparison)>,
    /// Indices of the images of drives.
    of_drives: BTreeSet<usize>,
}

impl Compared {
    fn of_poses(&self) -> Vec<(usize, Comparison)> {
        let is_of_pose = |(i, _): &(usize, &(usize, Comparison))| !self.of_drives.contains(i);
        self.all.iter().enumerate().filter(is_of_pose).map(|(_, compared)| compared.clone()).collect()
    }
}

struct Work {
    lanes: Lanes,
    states: Vec<[f32; LATENT_DIM]>,
    hazard_states: Vec<bool>,
    field: Field,
    seed: u64,
    threads: usize,
    comparer: Comparer,
}

impl Work {
    fn free_poses(
        &mut self,
        scenario: &Scenario,
        count: usize,
        on_progress: &dyn Fn(&Progress),
    ) -> Result<Compared, TrainingError> {
        let Compared { mut all, mut of_drives } = Compared::default();
        for number in 0..count {
            let pose = scenario.free_pose(number as u64, self.seed)?;
            for (branch, view) in pose.views.iter().enumerate() {
                let Some(state) = scenario.info().state(branch, pose.timestamp) else { continue };
                all.extend(self.compare(&pose.camera, &view.image, all.len()).map(|compared| (state, compared)));
            }
            for branch in 0..pose.views.len() {
                let drive = number * pose.views.len() + branch;
                if let Some(compared) = self.of_drive(scenario, drive as u64, number, all.len())? {
                    of_drives.insert(all.len());
                    all.push(compared);
                }
            }
            on_progress(&Progress { phase: "known", done: number + 1, total: count, line: String::new() });
        }
        Ok(Compared { all, of_drives })
    }

    /// Compares one image of a drive, whose camera is also where the vehicle is in no known state.
    fn of_drive(
        &mut self,
        scenario: &Scenario,
        drive: u64,
        frame: usize,
        image: usize,
    ) -> Result<Option<(usize, Comparison)>, TrainingError> {
        let drive = scenario.watch(drive, FRAMES_PER_TIMESTAMP, self.seed)?;
        let frame = frame % drive.frame_count();
        let Some(state) = scenario.info().state(drive.branch(), drive.timestamp_of(frame)) else { return Ok(None) };
        let (camera, rendered) = scenario.free_image(&drive, frame);
        Ok(self.compare(&camera, &rendered, image).map(|compared| (state, compared)))
    }

    fn trained_poses(&mut self, posed: &PosedImages, on_progress: &dyn Fn(&Progress)) -> Compared {
        let images = posed.with_roles(&[PoseRole::Rest]);
        let mut all = Vec::new();
        for (done, &i) in images.iter().enumerate() {
            let compared = self.compare(&posed.dataset.frames()[i].camera, &posed.images[i], i);
            all.extend(compared.map(|compared| (posed.labels[i].state, compared)));
            on_progress(&Progress { phase: "known", done: done + 1, total: images.len(), line: String::new() });
        }
        Compared { all, ..Compared::default() }
    }

    /// Compares an image with sensor noise; `None` if the camera sees no lane.
    fn compare(&mut self, camera: &PinholeCamera, image: &Image, number: usize) -> Option<Comparison> {
        let noisy = noisy(image, Key::named("knwn", self.seed, number as u64));
        let Self { lanes, states, hazard_states, field, threads, comparer, .. } = self;
        let scene = KnownScene { field, states, hazard_states, lanes };
        let compared = comparer.compare(scene, camera, noisy.view()?, *threads).filter(Comparison::sees_lanes)?;
        Some(comparer.look_closer(&compared, scene, *threads).unwrap_or(compared))
    }
}

/// The image behind a camera in use.
fn noisy(image: &Image, key: Key) -> Image {
    let mut noisy = image.clone();
    // Only noise out of range is refused.
    let _ = apply_noise_into(&image.rgb, &mut noisy.rgb, &SensorNoise::default(), key);
    noisy
}

/// The scenario's roads, else the surroundings of the places.
fn lanes(manifest: &Manifest, field: &Field, scenario: Option<&Scenario>) -> Lanes {
    let [low, high] = field.config().bounds_m.map(|corner| corner.map(f64::from));
    let roads = scenario.map(Scenario::roads).unwrap_or_default();
    let around = |place: &OrientedBox| {
        let grown = |half: f64| half * (1.0 + AROUND_PLACE);
        OrientedBox { half_size: place.half_size.map(grown), ..*place }
    };
    let has_roads = !roads.is_empty();
    let areas = if has_roads { roads } else { manifest.places.iter().map(|p| around(&p.oriented_box)).collect() };
    let length_m = scenario.and_then(Scenario::ego_length_m).filter(|_| has_roads);
    Lanes {
        areas,
        ground_m: low[2],
        bounds_m: [[low[0], low[1]], [high[0], high[1]]],
        nearest_m: length_m.map_or(0.0, |length| length * BEYOND_VEHICLE),
        own: if has_roads { own_boxes(manifest, scenario) } else { Vec::new() },
    }
}

/// Boxes of the scenario's ego vehicle in the known states, with the margin of its pose.
fn own_boxes(manifest: &Manifest, scenario: Option<&Scenario>) -> Vec<OwnBox> {
    let ego = scenario.and_then(Scenario::ego_name);
    let places = manifest.places.iter().filter(|place| Some(place.name.as_str()) == ego);
    places.map(|place| OwnBox { oriented_box: place.oriented_box, margin_m: POSE_MARGIN_M }).collect()
}

/// Limits of a camera in order, from the trained images with sensor noise.
fn camera_limits(posed: &PosedImages, seed: u64) -> CameraLimits {
    let trained = posed.trained();
    let step = trained.len().div_ceil(MOST_IMAGES).max(1);
    let measured: Vec<Measured> = trained
        .iter()
        .step_by(step)
        .filter_map(|&i| Some(Measured::of(noisy(&posed.images[i], Key::named("lims", seed, i as u64)).view()?)))
        .collect();
    let fields: Vec<[f64; 2]> = posed.dataset.frames().iter().map(|f| f.camera.field_of_view_deg()).collect();
    let alike = fields.iter().all(|f| (0..2).all(|i| (f[i] - fields[0][i]).abs() < 0.01 * fields[0][i]));
    // A dataset of several lenses does not determine the right one.
    let field_of_view_deg = fields.first().copied().filter(|_| alike).unwrap_or([0.0; 2]);
    CameraLimits::fit(&measured, field_of_view_deg)
}
