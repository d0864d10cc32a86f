//! Free views: images of every branch at one time step, from one camera pose that is not in any dataset.
//!
//! Every pose gives one view at each branch, so that the pose does not reveal the branch. Each view has the states that
//! look the same from its pose: with equally probable states, they are the exact posterior of an observer that knows
//! the scenario and the pose.

use crate::{
    ScenarioError,
    free_drives::{FreeDrive, MAX_TRIES},
    scenario::Scenario,
};
use carff_base::{geometry::PinholeCamera, random::Key};
use carff_dataset::{Image, Observability, looks_same};

/// Name of the random stream.
const STREAM: u32 = Key::named("look", 0, 0).step;

/// A camera pose at one time step, with one view at each branch.
#[derive(Clone, Debug, PartialEq)]
pub struct FreePose {
    /// Kind of the camera's group.
    pub view_kind: String,
    /// Time step of all looks, never the last one.
    pub timestamp: usize,
    /// Pose and intrinsics.
    pub camera: PinholeCamera,
    /// One look at each branch, in their order.
    pub views: Vec<FreeView>,
}

/// The image of one branch.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeView {
    /// The image, without sensor noise.
    pub image: Image,
    /// Visibility of the actor or of its place; `None` if nothing in the scenario is dynamic.
    pub observability: Option<Observability>,
    /// States that look the same from this pose, including the view's own.
    pub alike: Vec<usize>,
}

impl Scenario {
    /// Draws pose `number` and renders its looks. Even numbers are on the roof of the ego vehicle where the scenario has
    /// such cameras, odd ones anywhere in the ranges of its cameras. The time step follows from the number too. The same
    /// arguments give the same pose and images.
    ///
    /// ```no_run
    /// use carff_scenes::Scenario;
    /// # fn main() -> Result<(), carff_scenes::ScenarioError> {
    /// let scenario = Scenario::load("configs/scenarios/approaching-intersection.toml".as_ref())?;
    /// let pose = scenario.free_pose(0, 1)?;
    /// assert_eq!(pose.views.len(), scenario.info().branches.len());
    /// # Ok(())
    /// # }
    /// ```
    pub fn free_pose(&self, number: u64, seed: u64) -> Result<FreePose, ScenarioError> {
        let (drive, timestamp) = self.free_course(number, seed)?;
        let (camera, _) = self.free_view(&drive, timestamp);
        let views = self.views(&drive, timestamp, &camera);
        Ok(FreePose { view_kind: drive.view_kind().to_owned(), timestamp, camera, views })
    }

    /// Draws pose `number` as a drive through the first branch, with the time step of its looks.
    pub(crate) fn free_course(&self, number: u64, seed: u64) -> Result<(FreeDrive, usize), ScenarioError> {
        let timestamps = self.info().timestamps;
        let inputs = timestamps.saturating_sub(1).max(1) as u64;
        let timestamp = ((number / 2) % inputs) as usize;
        for sample in 0..MAX_TRIES {
            let mut rng = carff_base::random::stream(Key { seed, frame: number, step: STREAM, sample });
            let (view_kind, course) = self.course(0, number.is_multiple_of(2), &mut rng)?;
            let drive = FreeDrive::of_course(0, timestamps, 1, view_kind, course);
            if self.stands_clear(&drive, timestamp) {
                return Ok((drive, timestamp));
            }
        }
        Err(ScenarioError::NoPose { path: self.path().to_owned(), tries: MAX_TRIES })
    }

    fn views(&self, drive: &FreeDrive, timestamp: usize, camera: &PinholeCamera) -> Vec<FreeView> {
        let info = self.info();
        let placement = |branch, t| self.free_view(&drive.through(branch), t).1;
        let images: Vec<Image> = (0..info.state_count())
            .map(|state| self.image_of(&placement(info.branch_of(state), info.timestamp_of(state)), camera))
            .collect();
        let view = |branch: usize| {
            let own = &images[info.state(branch, timestamp)?];
            Some(FreeView {
                image: own.clone(),
                observability: self.free_observability(&placement(branch, timestamp), timestamp, camera),
                alike: (0..images.len()).filter(|&state| looks_same(own, &images[state])).collect(),
            })
        };
        (0..info.branches.len()).filter_map(view).collect()
    }
}
