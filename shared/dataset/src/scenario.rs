//! Frames and scenarios: the content of a transforms file.

use std::path::PathBuf;

use crate::lens::Lens;
use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_messages::Observability;
use serde::{Deserialize, Serialize};

/// Maximum number of frames in a dataset.
pub const MAX_FRAMES: usize = 1_000_000;

/// An image of a dataset with its camera and state.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Path of the image, absolute or relative to the working directory. It includes the dataset's folder.
    pub image_path: PathBuf,
    /// Path of the mask of the pixels that training uses (zero: not used), of the image's size.
    pub mask_path: Option<PathBuf>,
    /// Lens that took the image. The camera's intrinsics are those of the undistorted image.
    pub(crate) lens: Lens,
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
    /// Visibility of the actor. If the dataset does not contain it, [`crate::Dataset::open`] derives it. `None` means unknown.
    pub observability: Option<Observability>,
    /// Ratio of visible pixels to the pixels of the unoccluded actor, 0..=1.
    pub visible_fraction: Option<f32>,
    /// Number of pixels that show the actor (or its place).
    pub actor_px: Option<u32>,
    /// Kind of camera, for example `orbit`, `bev` or `dash`.
    pub view_kind: Option<String>,
    /// States that look the same from this pose, including its own, where the images cannot show it. Only evaluation
    /// reads them.
    pub alike_states: Option<Vec<usize>>,
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
    /// Duration of a time step, seconds.
    pub step_s: Option<f64>,
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
    /// First time step at which a hazard branch is a hazard.
    pub hazard_from_timestamp: usize,
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

    /// Returns true if the hazard action is right in this branch. The hazard itself may begin at a later time step.
    pub fn is_hazard(&self, branch: usize) -> bool {
        self.hazard_branches.contains(&branch)
    }

    /// Returns true if the state of a branch at a time step is a hazard.
    pub fn is_hazard_at(&self, branch: usize, timestamp: usize) -> bool {
        self.is_hazard(branch) && timestamp >= self.hazard_from_timestamp
    }
}
