//! Unknown views: images that contain something no state explains, from the camera poses of the free views.

use crate::ScenarioError;
use crate::movers::movers;
use crate::scenario::{Placement, Scenario};
use carff_base::geometry::PinholeCamera;
use carff_dataset::{Image, NamedBox, Observability};

/// A pixel shows the unknown if a channel differs by more than this, of 255, from the image without it.
pub const VISIBLE_DIFFERENCE: u8 = 25;
/// Number of such pixels from which the unknown is in sight (in an image of 128 x 128; proportional for other sizes).
pub const IN_SIGHT_PX: u32 = 100;

/// An image with something unknown, and its truth.
#[derive(Clone, Debug, PartialEq)]
pub struct UnknownView {
    /// Kind of the camera's group.
    pub view_kind: String,
    /// Branch of everything that is known.
    pub branch: usize,
    /// Time step, never the last one.
    pub timestamp: usize,
    /// Pose and intrinsics.
    pub camera: PinholeCamera,
    /// The image, without sensor noise.
    pub image: Image,
    /// The same image without the unknown.
    pub without: Image,
    /// Number of pixels that differ by more than [`VISIBLE_DIFFERENCE`] between the two, its shadow included.
    pub visible_px: u32,
    /// Visibility of the actor or of its place; `None` if nothing in the scenario is dynamic.
    pub observability: Option<Observability>,
    /// Boxes of the unknown.
    pub boxes: Vec<NamedBox>,
}

impl UnknownView {
    /// Returns true if at least [`IN_SIGHT_PX`] pixels show the unknown, in proportion to the image's size.
    pub fn in_sight(&self) -> bool {
        is_in_sight(self.visible_px, &self.image)
    }
}

/// Returns true if so many pixels of an image put something in sight: [`IN_SIGHT_PX`], in proportion to its size.
pub fn is_in_sight(visible_px: u32, image: &Image) -> bool {
    let size = f64::from(image.width_px) * f64::from(image.height_px);
    f64::from(visible_px) >= f64::from(IN_SIGHT_PX) * size / (128.0 * 128.0)
}

impl Scenario {
    /// Renders the unknown from the camera and time step of free pose `number`: of a scenario with an added object, a
    /// clear branch with the object; of one with another appearance, a hazard branch, or the first branch with the
    /// vehicle if nothing is a hazard. The same arguments give the same image.
    ///
    /// ```no_run
    /// use carff_scenes::Scenario;
    /// # fn main() -> Result<(), carff_scenes::ScenarioError> {
    /// let scenario = Scenario::load("configs/scenarios/approaching-intersection.toml".as_ref())?;
    /// let van = scenario.with_appearance("white-van")?;
    /// let view = van.unknown_view(0, 1)?;
    /// assert_eq!(view.camera, scenario.free_pose(0, 1)?.camera);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    ///
    /// The scenario has neither an appearance nor an added object, or no branch can show it.
    pub fn unknown_view(&self, number: u64, seed: u64) -> Result<UnknownView, ScenarioError> {
        let (drive, timestamp) = self.free_course(number, seed)?;
        let (camera, _) = self.free_view(&drive, timestamp);
        let (branch, parts) = self.unknown_parts(timestamp)?;
        let placement = self.free_view(&drive.through(branch), timestamp).1;
        let mut known = placement.clone();
        for &part in &parts {
            known[part] = None;
        }
        let (image, without) = (self.image_of(&placement, &camera), self.image_of(&known, &camera));
        Ok(UnknownView {
            view_kind: drive.view_kind().to_owned(),
            branch,
            timestamp,
            camera,
            visible_px: image.differing_pixels(&without, VISIBLE_DIFFERENCE).count() as u32,
            image,
            without,
            observability: self.free_observability(&placement, timestamp, &camera),
            boxes: self.boxes_of(&placement, &parts),
        })
    }

    /// Returns the branch to show and the unknown movers.
    fn unknown_parts(&self, timestamp: usize) -> Result<(usize, Vec<usize>), ScenarioError> {
        let unavailable = |problem| ScenarioError::NothingUnknown { path: self.path().to_owned(), problem };
        let (info, unknown) = (self.info(), self.unknown());
        let mut branches = 0..info.branches.len();
        if unknown.bystanders > 0 {
            let clear = branches.find(|&branch| !info.is_hazard(branch));
            let count = movers(self.config()).count();
            return clear
                .map(|branch| (branch, (count - unknown.bystanders..count).collect()))
                .ok_or_else(|| unavailable("every branch is a hazard; an added object is shown in a clear branch"));
        }
        if !unknown.appearance {
            return Err(unavailable("nothing is unknown; choose an appearance or add an object"));
        }
        let actors = self.actors();
        let there = |branch: &usize| {
            let hazard = info.hazard_branches.is_empty() || info.is_hazard(*branch);
            hazard && actors.first().is_some_and(|&actor| self.placements()[*branch][timestamp][actor].is_some())
        };
        let branch = branches.find(there);
        branch
            .map(|branch| (branch, actors))
            .ok_or_else(|| unavailable("no hazard branch contains the dynamic vehicle at this time step"))
    }

    fn boxes_of(&self, placement: &Placement, parts: &[usize]) -> Vec<NamedBox> {
        let of = |(i, mover): (usize, crate::movers::Mover)| {
            let pose = placement[i].filter(|_| parts.contains(&i))?;
            mover.named_box(pose)
        };
        movers(self.config()).enumerate().filter_map(of).collect()
    }
}
