//! Watches: drives whose camera pans, so that the actor's place passes in and out of sight.
//!
//! They have no right action at one frame; each frame has the states that look the same from its camera. With the order
//! of the time steps they give the exact posterior of an observer with a memory.

use crate::{ScenarioError, free_drives::FreeDrive, free_drives::MAX_TRIES, scenario::Scenario};
use carff_base::{geometry::PinholeCamera, random::Key};
use carff_dataset::{Image, MAX_DIFFERENT_PIXELS, PIXEL_TOLERANCE};
use rand::Rng;
use std::f64::consts::TAU;

/// Name of the random stream.
const STREAM: u32 = Key::named("watc", 0, 0).step;
/// Smallest and largest number of pans to and fro per time step.
const CYCLES: [f64; 2] = [0.25, 0.7];
/// Factor by which the images that are compared are smaller along each side.
const SMALLER: u32 = 3;

impl Scenario {
    /// Plans watch `number`, on a roof where the scenario has such cameras. Watches go through the branches in turn. The
    /// same arguments give the same drive.
    ///
    /// # Errors
    ///
    /// No course is free of obstacles.
    pub fn watch(&self, number: u64, frames_per_timestamp: usize, seed: u64) -> Result<FreeDrive, ScenarioError> {
        let info = self.info();
        let branch = (number % info.branches.len().max(1) as u64) as usize;
        for sample in 0..MAX_TRIES {
            let mut rng = carff_base::random::stream(Key { seed, frame: number, step: STREAM, sample });
            let (view_kind, mut course) = self.course(branch, true, &mut rng)?;
            let range =
                self.config().dash.iter().find(|group| group.view_kind == view_kind).map(|group| group.left_deg);
            let (phase, cycles) = (rng.random_range(0.0..TAU), rng.random_range(CYCLES[0]..CYCLES[1]));
            if let Some(range) = range {
                course.pan_over(range.map(f64::to_radians), phase, cycles);
            }
            let drive = FreeDrive::of_course(branch, info.timestamps, frames_per_timestamp, view_kind, course);
            if (0..drive.frame_count()).all(|frame| self.stands_clear(&drive, frame)) {
                return Ok(drive);
            }
        }
        Err(ScenarioError::NoPose { path: self.path().to_owned(), tries: MAX_TRIES })
    }

    /// Renders frame `frame` of a drive without its truth: the camera and the image, without sensor noise.
    pub fn free_image(&self, drive: &FreeDrive, frame: usize) -> (PinholeCamera, Image) {
        let (camera, placement) = self.free_view(drive, frame);
        (camera, self.image_of(&placement, &camera))
    }

    /// Returns the states that look the same from the camera of a frame, including its own. All vehicles except the ego
    /// are at the poses of a state; the ego is where it is in this frame for states of its time step, else at the state's
    /// pose.
    pub fn alike(&self, drive: &FreeDrive, frame: usize) -> Vec<usize> {
        let info = self.info();
        let (camera, own) = self.free_view(drive, frame);
        let camera = camera.resized(camera.width_px.div_ceil(SMALLER), camera.height_px.div_ceil(SMALLER));
        let own = self.image_of(&own, &camera);
        let timestamp = drive.timestamp_of(frame);
        let same = |state: usize| {
            let through = drive.through(info.branch_of(state));
            let of_state = info.timestamp_of(state);
            let at = if of_state == timestamp { frame } else { through.last_frame_of(of_state) };
            same_when_small(&own, &self.image_of(&self.free_view(&through, at).1, &camera))
        };
        (0..info.state_count()).filter(|&state| same(state)).collect()
    }
}

/// Returns [`carff_dataset::looks_same`] for images that are [`SMALLER`]: fewer pixels may differ.
fn same_when_small(a: &Image, b: &Image) -> bool {
    let allowed = MAX_DIFFERENT_PIXELS / (SMALLER * SMALLER) as usize;
    a.differing_pixels(b, PIXEL_TOLERANCE).take(allowed + 1).count() <= allowed
}
