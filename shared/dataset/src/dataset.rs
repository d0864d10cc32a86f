//! The set in memory: frames with cameras and states, and the scenario they belong to.

use std::path::{Path, PathBuf};

use carff_geometry::{OrientedBox, PinholeCamera};
use carff_messages::Observability;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::DatasetError;
use crate::image::Image;
use crate::{seen, transforms};

/// Largest transforms file that is read, bytes.
pub const MAX_TRANSFORMS_BYTES: u64 = 1 << 29;
/// Most frames in one set.
pub const MAX_FRAMES: usize = 1_000_000;
/// Largest width or height of an image, pixels.
pub const MAX_IMAGE_SIDE_PX: u32 = 8192;

/// One image of the set.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The image, an absolute path or one relative to the working directory (the set's folder is part of it).
    pub image_path: PathBuf,
    /// Intrinsics and pose.
    pub camera: PinholeCamera,
    /// State index: branch * timestamps + timestamp.
    pub state: Option<usize>,
    /// Which branch.
    pub branch: Option<usize>,
    /// Which step of it.
    pub timestamp: Option<usize>,
    /// Index of the fixed camera pose.
    pub view: Option<usize>,
    /// How much of the actor the image shows; where the set does not say, what [`Dataset::open`] could tell. `None`
    /// means unknown.
    pub observability: Option<Observability>,
    /// Visible pixels over pixels that would be covered with nothing in between, 0..=1.
    pub visible_fraction: Option<f32>,
    /// Pixels that show the actor (or its place).
    pub actor_px: Option<u32>,
    /// Kind of camera, for example `orbit`, `bev` or `dash`.
    pub view_kind: Option<String>,
}

/// A box with a name and a part to play.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedBox {
    /// Its name, for example `actor`.
    pub name: String,
    /// Its part, for example `ego`, `actor` or `static`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<String>,
    /// Where it is, world space, metres.
    #[serde(flatten)]
    pub oriented_box: OrientedBox,
    /// Whether its presence or motion is what the forecast is about.
    #[serde(default)]
    pub dynamic: bool,
}

/// A place where the actor can be.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Candidate {
    /// The branch it belongs to; `None`: any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub branch: Option<usize>,
    /// The timestamp it belongs to; `None`: any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timestamp: Option<usize>,
    /// The place.
    #[serde(flatten)]
    pub named_box: NamedBox,
}

/// One state: a branch at a timestamp, and what stands where.
#[derive(Clone, Debug, PartialEq)]
pub struct StateInfo {
    /// Which branch.
    pub branch: usize,
    /// Which step of it.
    pub timestamp: usize,
    /// Known boxes of this state.
    pub boxes: Vec<NamedBox>,
}

/// The scenario that a set was taken from.
#[derive(Clone, Debug, PartialEq)]
pub struct ScenarioInfo {
    /// Its name; the folder's name where the file gives none.
    pub name: String,
    /// Lower and upper corner of the region that matters, world space, metres.
    pub bounds: [[f64; 3]; 2],
    /// Names of the branches.
    pub branches: Vec<String>,
    /// Steps per branch.
    pub timestamps: usize,
    /// The view that looks straight down.
    pub bev_view: Option<usize>,
    /// All states, `branches * timestamps` of them; state s is branch s / timestamps at s % timestamps.
    pub states: Vec<StateInfo>,
    /// Where the actor can be.
    pub candidates: Vec<Candidate>,
    /// Known boxes that never move.
    pub static_boxes: Vec<NamedBox>,
    /// Branches in which the hazard action is right.
    pub hazard_branches: Vec<usize>,
    /// What to do in a hazard branch.
    pub hazard_action: String,
    /// What to do in the others.
    pub clear_action: String,
}

impl ScenarioInfo {
    /// Number of states: branches x timestamps.
    pub fn state_count(&self) -> usize {
        self.branches.len() * self.timestamps
    }

    /// State index of a branch at a timestamp.
    pub fn state(&self, branch: usize, timestamp: usize) -> Option<usize> {
        (branch < self.branches.len() && timestamp < self.timestamps).then(|| branch * self.timestamps + timestamp)
    }

    /// Whether the hazard action is the right one in this branch.
    pub fn is_hazard(&self, branch: usize) -> bool {
        self.hazard_branches.contains(&branch)
    }
}

/// A posed image set, described; images are loaded on demand.
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
    /// `transforms_test.json` together. Images are looked for but not decoded, unless the set has several branches and
    /// no frame says its observability: then the images tell it, and a warning says so.
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
                "no frame says its `observability`, so the images tell it: `none` where each other branch looks the same \
                 at that timestamp, `full` where none does, else `partial`"
                    .into(),
            );
        }
        Ok(set)
    }

    /// The set's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// All frames, in the order of the file.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// The scenario, if the set has one.
    pub fn scenario(&self) -> Option<&ScenarioInfo> {
        self.scenario.as_ref()
    }

    /// Number of fixed camera poses; 0 when frames carry no view index.
    pub fn view_count(&self) -> usize {
        self.view_count
    }

    /// Number of states; a set without scenario has as many as its frames name, and at least one.
    pub fn state_count(&self) -> usize {
        match &self.scenario {
            Some(scenario) => scenario.state_count(),
            None => self.frames.iter().filter_map(|f| f.state).max().map_or(1, |s| s + 1),
        }
    }

    /// Index of the frame that shows a state from a view.
    pub fn frame_index(&self, state: usize, view: usize) -> Option<usize> {
        self.frames.iter().position(|f| f.state == Some(state) && f.view == Some(view))
    }

    /// What is accepted but looks odd, for `check` to print.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Decodes one image and checks that its size is the one its intrinsics say.
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
                    "frame {frame_index} is {}x{} pixels, but its intrinsics (keys `w` and `h`) say {w}x{h}",
                    image.width_px, image.height_px
                ),
            });
        }
        Ok(image)
    }

    /// Decodes all images, in parallel, in the order of the frames. The first bad one is the error.
    pub fn load_all_images(&self) -> Result<Vec<Image>, DatasetError> {
        let images: Vec<_> = (0..self.frames.len()).into_par_iter().map(|i| self.load_image(i)).collect();
        images.into_iter().collect()
    }
}
