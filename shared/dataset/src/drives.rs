//! Drives through a dataset: a hidden branch, seen from one pose, time step by time step.
//!
//! A trial of the planner is an input view with one right answer (section 4.3 of the paper). Hazard: a hazard branch
//! whose view does not reveal it, because the actor is not visible or a clear branch has the same state. Clear: a clear
//! branch with its place fully visible, in a state that is not a state of a hazard branch. The last time step is not an
//! input, because nothing follows it. Without hazard branches, every input is clear. A dataset that allows only one
//! kind, or none, can still be driven: inputs without a right answer do not count.

use crate::{Dataset, Observability, ScenarioInfo};
use carff_base::random::{Key, tag};
use rand::Rng;
use rand::seq::SliceRandom;

/// Name of the random stream, so that no other draw of the same run shares it.
const STREAM: u64 = tag("drives 1");

/// Kind of a drive: its right action.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DriveKind {
    /// Halt: the hazard comes, and the image does not show it.
    Hazard,
    /// Advance: no hazard comes, and the image shows it.
    Clear,
}

impl DriveKind {
    /// Returns the name for reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hazard => "hazard",
            Self::Clear => "clear",
        }
    }
}

/// An input view with one right answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EligibleInput {
    /// Camera pose.
    pub view: usize,
    /// Branch.
    pub branch: usize,
    /// Time step of the branch, at most the last but one.
    pub timestamp: usize,
    /// The right answer.
    pub kind: DriveKind,
}

/// A drive: all time steps of a branch, seen from one pose.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Drive {
    /// Camera pose.
    pub view: usize,
    /// Hidden branch.
    pub branch: usize,
    /// The right answer; `None` if no pose of the dataset has one.
    pub kind: Option<DriveKind>,
    /// Index in [`Dataset::frames`] of each time step's frame.
    pub frames: Vec<usize>,
}

/// Reason why no drives can be planned.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DrivesError {
    /// The dataset has no scenario.
    #[error(
        "this dataset has no `scenario`, so it cannot be driven; use a dataset with a scenario, or a folder source"
    )]
    NoScenario,
    /// No pose can be driven.
    #[error(
        "none of the {views} poses has images of all timestamps of a branch: add missing frames, or use a folder source"
    )]
    NoneWhole {
        /// Number of poses in the dataset.
        views: usize,
    },
}

impl ScenarioInfo {
    /// Returns the right answer to a view of a state, if there is one: see the module's text.
    pub fn trial_kind(
        &self,
        branch: usize,
        timestamp: usize,
        observability: Option<Observability>,
    ) -> Option<DriveKind> {
        if timestamp + 2 > self.timestamps || branch >= self.branches.len() {
            return None;
        }
        if self.hazard_branches.is_empty() {
            return Some(DriveKind::Clear);
        }
        match (self.is_hazard(branch), self.is_undecided(branch, timestamp), observability) {
            (true, true, _) | (true, false, Some(Observability::None)) => Some(DriveKind::Hazard),
            (false, false, Some(Observability::Full)) => Some(DriveKind::Clear),
            _ => None,
        }
    }

    /// Returns true if a branch with the other right action has the same known boxes at this time step.
    fn is_undecided(&self, branch: usize, timestamp: usize) -> bool {
        let boxes = |b: usize| self.state(b, timestamp).and_then(|s| self.states.get(s)).map(|s| &s.boxes);
        let own = boxes(branch).filter(|boxes| !boxes.is_empty());
        own.is_some()
            && (0..self.branches.len()).any(|b| self.is_hazard(b) != self.is_hazard(branch) && boxes(b) == own)
    }
}

/// Returns all input views with one right answer from some poses, in the order of poses, branches and time steps.
pub fn eligible_inputs(dataset: &Dataset, views: &[usize]) -> Result<Vec<EligibleInput>, DrivesError> {
    let scenario = dataset.scenario().ok_or(DrivesError::NoScenario)?;
    let mut inputs = Vec::new();
    for frame in dataset.frames() {
        let (Some(view), Some(branch), Some(timestamp)) = (frame.view, frame.branch, frame.timestamp) else { continue };
        if !views.contains(&view) {
            continue;
        }
        let Some(kind) = scenario.trial_kind(branch, timestamp, frame.observability) else { continue };
        inputs.push(EligibleInput { view, branch, timestamp, kind });
    }
    inputs.sort_by_key(|i| (i.view, i.branch, i.timestamp));
    Ok(inputs)
}

/// Poses that can be driven, each with the branch of each of its inputs.
type Poses = Vec<(usize, Vec<usize>)>;

/// Plans drives: hazard and clear ones alternate. A seed draws their poses from `views` without replacement until all
/// are used. If no pose allows one kind, only the other is planned; if none allows either, drives have no right answer.
/// The same arguments give the same drives.
pub fn plan_drives(dataset: &Dataset, views: &[usize], count: usize, seed: u64) -> Result<Vec<Drive>, DrivesError> {
    let scenario = dataset.scenario().ok_or(DrivesError::NoScenario)?;
    let mut rng = carff_base::random::stream(Key { seed, frame: STREAM, step: 0, sample: 0 });
    let frames = |branch: usize, view: usize| -> Option<Vec<usize>> {
        (0..scenario.timestamps).map(|t| dataset.frame_index(scenario.state(branch, t)?, view)).collect()
    };
    // A pose without an image of each time step cannot be driven.
    let (mut hazard, mut clear): (Poses, Poses) = Default::default();
    for input in eligible_inputs(dataset, views)?.iter().filter(|i| frames(i.branch, i.view).is_some()) {
        let poses = if input.kind == DriveKind::Hazard { &mut hazard } else { &mut clear };
        match poses.last_mut() {
            Some((view, branches)) if *view == input.view => branches.push(input.branch),
            _ => poses.push((input.view, vec![input.branch])),
        }
    }
    let mut deck = |kind: Option<DriveKind>, mut poses: Poses, wanted: usize| -> Vec<Drive> {
        let mut drives = Vec::with_capacity(wanted);
        while drives.len() < wanted && !poses.is_empty() {
            poses.shuffle(&mut rng);
            for (view, branches) in poses.iter().take(wanted - drives.len()) {
                let branch = branches[rng.random_range(0..branches.len())];
                drives.extend(frames(branch, *view).map(|frames| Drive { view: *view, branch, kind, frames }));
            }
        }
        drives
    };
    let drives = match (hazard.is_empty(), clear.is_empty()) {
        (false, false) => {
            let wanted = count.div_ceil(2);
            let hazard = deck(Some(DriveKind::Hazard), hazard, wanted);
            let clear = deck(Some(DriveKind::Clear), clear, wanted);
            hazard.into_iter().zip(clear).flat_map(|(h, c)| [h, c]).take(count).collect()
        }
        (false, true) => deck(Some(DriveKind::Hazard), hazard, count),
        (true, false) => deck(Some(DriveKind::Clear), clear, count),
        (true, true) => {
            let whole =
                |view: usize| (0..scenario.branches.len()).filter(move |b| frames(*b, view).is_some()).collect();
            let any = views.iter().map(|v| (*v, whole(*v))).filter(|(_, branches): &(_, Vec<_>)| !branches.is_empty());
            deck(None, any.collect(), count)
        }
    };
    if drives.is_empty() && count > 0 { Err(DrivesError::NoneWhole { views: views.len() }) } else { Ok(drives) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DatasetWriter, FrameRecord, Image};
    use carff_base::geometry::PinholeCamera;

    /// Writes two branches (0 holds the hazard) x three time steps x six poses: poses 0 to 2 do not see the actor's
    /// place, poses 3 and 4 see it fully, pose 5 sees a part.
    fn dataset(folder: &std::path::Path) -> Dataset {
        let writer = DatasetWriter::create(folder).unwrap();
        let camera = PinholeCamera::look_at([0.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 4, 4, 60.0);
        let mut records = Vec::new();
        for (branch, timestamp, view) in (0..2).flat_map(|b| (0..3).flat_map(move |t| (0..6).map(move |v| (b, t, v)))) {
            let path = format!("images/b{branch}_t{timestamp}_v{view}.png");
            let image = Image::filled(4, 4, [branch as u8, timestamp as u8, view as u8]);
            writer.write_image(&path, &image).unwrap();
            let mut record = FrameRecord::new(path, camera);
            record.branch_and_timestamp = Some((branch, timestamp));
            record.view = Some(view);
            record.observability = Some(match view {
                0..3 => Observability::None,
                3..5 => Observability::Full,
                _ => Observability::Partial,
            });
            records.push(record);
        }
        writer.finish(&records, Some(&scenario(Vec::new()))).unwrap();
        Dataset::open(folder).unwrap()
    }

    /// Every eligible input matches the definition, and none is missing.
    #[test]
    fn inputs_have_one_right_answer() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = dataset(folder.path());
        let inputs = eligible_inputs(&dataset, &[0, 1, 2, 3, 4, 5]).unwrap();
        // Three blind poses x two time steps, and two seeing poses x two time steps.
        assert_eq!(inputs.iter().filter(|i| i.kind == DriveKind::Hazard).count(), 6);
        assert_eq!(inputs.iter().filter(|i| i.kind == DriveKind::Clear).count(), 4);
        assert!(inputs.iter().all(|i| i.timestamp < 2 && (i.branch == 0) == (i.view < 3) && i.view < 5));
    }

    fn scenario(states: Vec<crate::StateInfo>) -> ScenarioInfo {
        ScenarioInfo {
            name: "test".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["hazard".into(), "clear".into()],
            timestamps: 3,
            step_s: None,
            bev_view: None,
            states,
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        }
    }

    /// If both branches are one state, halting is right in the hazard branch from any pose, and the clear branch has no
    /// trial. If they differ, visibility decides. Without hazards every view before the last step is clear.
    #[test]
    fn undecided_states_and_no_hazard() {
        use crate::{NamedBox, StateInfo};
        let at = |x: f64| NamedBox {
            name: "actor".into(),
            role: None,
            oriented_box: carff_base::geometry::OrientedBox { center: [x, 0.0, 1.0], half_size: [1.0; 3], yaw: 0.0 },
            dynamic: true,
        };
        let places = [[0.0, 6.0, 12.0], [0.0, 3.0, 6.0]];
        let state = |s: usize| {
            let (branch, timestamp) = (s / 3, s % 3);
            StateInfo { branch, timestamp, boxes: vec![at(places[branch][timestamp])] }
        };
        let mut merge = scenario((0..6).map(state).collect());
        let [full, none] = [Observability::Full, Observability::None].map(Some);
        for (branch, timestamp, seen, expected) in [
            (0, 0, full, Some(DriveKind::Hazard)),
            (0, 0, none, Some(DriveKind::Hazard)),
            (1, 0, full, None),
            (1, 0, none, None),
            (0, 1, full, None),
            (0, 1, none, Some(DriveKind::Hazard)),
            (1, 1, full, Some(DriveKind::Clear)),
            (1, 1, none, None),
            (0, 2, none, None),
            (1, 2, full, None),
        ] {
            assert_eq!(merge.trial_kind(branch, timestamp, seen), expected, "{branch} {timestamp} {seen:?}");
        }
        merge.hazard_branches.clear();
        assert_eq!(merge.trial_kind(0, 1, none), Some(DriveKind::Clear));
        assert_eq!(merge.trial_kind(0, 2, full), None);
    }

    /// Half of the drives are hazard drives, poses repeat only after all were used, and the same seed gives the same
    /// plan.
    #[test]
    fn drives_alternate_and_do_not_repeat_early() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = dataset(folder.path());
        let views = [0, 1, 2, 3, 4, 5];
        let drives = plan_drives(&dataset, &views, 10, 1).unwrap();
        assert_eq!(drives.len(), 10);
        for (i, drive) in drives.iter().enumerate() {
            assert_eq!(drive.kind, Some(if i % 2 == 0 { DriveKind::Hazard } else { DriveKind::Clear }));
            assert_eq!(drive.frames.len(), 3);
            for (timestamp, &frame) in drive.frames.iter().enumerate() {
                let frame = &dataset.frames()[frame];
                assert_eq!(
                    (frame.view, frame.branch, frame.timestamp),
                    (Some(drive.view), Some(drive.branch), Some(timestamp))
                );
            }
        }
        let mut first: Vec<usize> = drives.iter().step_by(2).take(3).map(|d| d.view).collect();
        first.sort_unstable();
        assert_eq!(first, [0, 1, 2]);
        assert_eq!(drives, plan_drives(&dataset, &views, 10, 1).unwrap());
        assert!((2..9).any(|seed| plan_drives(&dataset, &views, 10, seed).unwrap() != drives));
    }

    /// Poses that allow only one kind, or neither, are driven; drives of the latter have no right answer.
    #[test]
    fn poses_without_trials_are_driven_too() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = dataset(folder.path());
        for (views, kind) in [
            ([0, 1], Some(DriveKind::Hazard)), // blind
            ([3, 4], Some(DriveKind::Clear)),  // seeing
            ([5, 5], None),                    // seeing in part
        ] {
            let drives = plan_drives(&dataset, &views, 8, 1).unwrap();
            assert_eq!(drives.len(), 8);
            assert!(drives.iter().all(|d| d.kind == kind && views.contains(&d.view) && d.frames.len() == 3));
            assert_eq!(
                (0..2).filter(|b| drives.iter().any(|d| d.branch == *b)).count(),
                if kind.is_none() { 2 } else { 1 }
            );
        }
    }

    /// A pose that is not in the dataset cannot be driven, and the error reports it.
    #[test]
    fn missing_images_are_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let error = plan_drives(&dataset(folder.path()), &[7, 8], 4, 1).unwrap_err();
        assert_eq!(error, DrivesError::NoneWhole { views: 2 });
    }
}
