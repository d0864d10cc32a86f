//! A dataset in memory: frames with cameras and states, and their scenario.

use std::path::{Path, PathBuf};

use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_messages::Observability;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::DatasetError;
use crate::image::Image;
use crate::{seen, transforms};

/// Maximum size of a transforms file, bytes.
pub const MAX_TRANSFORMS_BYTES: u64 = 1 << 29;
/// Maximum number of frames in a dataset.
pub const MAX_FRAMES: usize = 1_000_000;
/// Maximum width or height of an image, pixels.
pub const MAX_IMAGE_SIDE_PX: u32 = 8192;

/// An image of a dataset with its camera and state.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Path of the image, absolute or relative to the working directory. It includes the dataset's folder.
    pub image_path: PathBuf,
    /// Intrinsics and pose.
    pub camera: PinholeCamera,
    /// State index: branch * timestamps + timestamp.
    pub state: Option<usize>,
    /// Index of the branch.
    pub branch: Option<usize>,
    /// Time step of the branch.
    pub timestamp: Option<usize>,
    /// Index of the fixed camera pose.
    pub view: Option<usize>,
    /// Visibility of the actor. If the dataset does not contain it, [`Dataset::open`] derives it. `None` means unknown.
    pub observability: Option<Observability>,
    /// Ratio of visible pixels to the pixels of the unoccluded actor, 0..=1.
    pub visible_fraction: Option<f32>,
    /// Number of pixels that show the actor (or its place).
    pub actor_px: Option<u32>,
    /// Kind of camera, for example `orbit`, `bev` or `dash`.
    pub view_kind: Option<String>,
}

/// A box with a name and a role.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedBox {
    /// Name of the box, for example `actor`.
    pub name: String,
    /// Role of the box, for example `ego`, `actor` or `static`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<String>,
    /// Position and size, world space, metres.
    #[serde(flatten)]
    pub oriented_box: OrientedBox,
    /// True if its presence or motion is the subject of the forecast.
    #[serde(default)]
    pub dynamic: bool,
}

/// A place where the actor can be.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Candidate {
    /// Branch of the place; `None`: any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub branch: Option<usize>,
    /// Time step of the place; `None`: any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timestamp: Option<usize>,
    /// Box of the place, world space, metres.
    #[serde(flatten)]
    pub named_box: NamedBox,
}

/// A state: a branch at a time step, with its known boxes.
#[derive(Clone, Debug, PartialEq)]
pub struct StateInfo {
    /// Index of the branch.
    pub branch: usize,
    /// Time step of the branch.
    pub timestamp: usize,
    /// Known boxes of this state.
    pub boxes: Vec<NamedBox>,
}

/// The scenario of a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioInfo {
    /// Name of the scenario; the folder's name if the file has none.
    pub name: String,
    /// Lower and upper corner of the region of interest, world space, metres.
    pub bounds: [[f64; 3]; 2],
    /// Names of the branches.
    pub branches: Vec<String>,
    /// Number of time steps per branch.
    pub timestamps: usize,
    /// Index of the view that looks straight down.
    pub bev_view: Option<usize>,
    /// All states, `branches * timestamps` of them; state s is branch s / timestamps at time step s % timestamps.
    pub states: Vec<StateInfo>,
    /// Places where the actor can be.
    pub candidates: Vec<Candidate>,
    /// Known boxes that never move.
    pub static_boxes: Vec<NamedBox>,
    /// Branches in which the hazard action is right.
    pub hazard_branches: Vec<usize>,
    /// Action in a hazard branch.
    pub hazard_action: String,
    /// Action in all other branches.
    pub clear_action: String,
}

impl ScenarioInfo {
    /// Returns the number of states: branches x time steps.
    pub fn state_count(&self) -> usize {
        self.branches.len() * self.timestamps
    }

    /// Returns the state index of a branch at a time step.
    pub fn state(&self, branch: usize, timestamp: usize) -> Option<usize> {
        (branch < self.branches.len() && timestamp < self.timestamps).then(|| branch * self.timestamps + timestamp)
    }

    /// Returns the branch of a state.
    pub fn branch_of(&self, state: usize) -> usize {
        state / self.timestamps.max(1)
    }

    /// Returns the time step of a state.
    pub fn timestamp_of(&self, state: usize) -> usize {
        state % self.timestamps.max(1)
    }

    /// Returns the state at the next time step of the same branch. The last state of a branch follows itself.
    pub fn next_state(&self, state: usize) -> usize {
        if (state + 1).is_multiple_of(self.timestamps.max(1)) { state } else { state + 1 }
    }

    /// Returns the states of a branch, in the order of their time steps.
    pub fn states_of_branch(&self, branch: usize) -> std::ops::Range<usize> {
        branch * self.timestamps..(branch + 1) * self.timestamps
    }

    /// Returns true if the hazard action is right in this branch.
    pub fn is_hazard(&self, branch: usize) -> bool {
        self.hazard_branches.contains(&branch)
    }
}

/// A posed image dataset; images are loaded on demand.
#[derive(Clone, Debug)]
pub struct Dataset {
    dir: PathBuf,
    frames: Vec<Frame>,
    scenario: Option<ScenarioInfo>,
    view_count: usize,
    warnings: Vec<String>,
}

impl Dataset {
    /// Reads and checks `transforms.json`, or else `transforms_train.json`, `transforms_val.json` and
    /// `transforms_test.json` together. It checks that the images exist but does not decode them. Exception: if a
    /// dataset with several branches has no observability, it is derived from the images, with a warning.
    pub fn open(dir: &Path) -> Result<Self, DatasetError> {
        let read = transforms::read(dir, transforms::Pictures::Png)?;
        let view_count = read.frames.iter().filter_map(|f| f.view).max().map_or(0, |v| v + 1);
        let mut set = Self {
            dir: dir.to_owned(),
            frames: read.frames,
            scenario: read.scenario,
            view_count,
            warnings: read.warnings,
        };
        let several = set.scenario.as_ref().is_some_and(|s| s.branches.len() > 1);
        if several && set.frames.iter().all(|f| f.observability.is_none()) {
            let told = seen::told_by_pictures(&set.frames, view_count, |i| set.load_image(i))?;
            for (frame, observability) in set.frames.iter_mut().zip(told) {
                frame.observability = observability;
            }
            set.warnings.push(
                "no frame has an `observability`, so it is derived from the images: `none` if each other branch looks \
                 the same at that timestamp, `full` if none does, else `partial`"
                    .into(),
            );
        }
        Ok(set)
    }

    /// Returns the dataset's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns all frames, in the order of the file.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// Returns the scenario, if the dataset has one.
    pub fn scenario(&self) -> Option<&ScenarioInfo> {
        self.scenario.as_ref()
    }

    /// Returns the number of fixed camera poses; 0 if frames have no view index.
    pub fn view_count(&self) -> usize {
        self.view_count
    }

    /// Returns the number of states; without a scenario, it follows from the frames and is at least one.
    pub fn state_count(&self) -> usize {
        match &self.scenario {
            Some(scenario) => scenario.state_count(),
            None => self.frames.iter().filter_map(|f| f.state).max().map_or(1, |s| s + 1),
        }
    }

    /// Returns the index of the frame of a state from a view.
    pub fn frame_index(&self, state: usize, view: usize) -> Option<usize> {
        self.frames.iter().position(|f| f.state == Some(state) && f.view == Some(view))
    }

    /// Returns warnings about accepted but unusual values, for `check` to print.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Decodes an image and checks that its size matches its intrinsics.
    pub fn load_image(&self, frame_index: usize) -> Result<Image, DatasetError> {
        let frame = self
            .frames
            .get(frame_index)
            .ok_or(DatasetError::NoSuchFrame { index: frame_index, count: self.frames.len() })?;
        let image = Image::load_png(&frame.image_path)?;
        let (w, h) = (frame.camera.width_px, frame.camera.height_px);
        if (image.width_px, image.height_px) != (w, h) {
            return Err(DatasetError::Image {
                path: frame.image_path.clone(),
                problem: format!(
                    "frame {frame_index} is {}x{} pixels, but its intrinsics (keys `w` and `h`) are {w}x{h}",
                    image.width_px, image.height_px
                ),
            });
        }
        Ok(image)
    }

    /// Decodes all images in parallel, in the order of the frames. Returns the first error.
    pub fn load_all_images(&self) -> Result<Vec<Image>, DatasetError> {
        let images: Vec<_> = (0..self.frames.len()).into_par_iter().map(|i| self.load_image(i)).collect();
        images.into_iter().collect()
    }
}
