//! States and views of frames that do not name them, and the check that each view is one pose in every state.

use std::collections::HashMap;
use std::path::PathBuf;

use carff_base::geometry::PinholeCamera;

use crate::error::DatasetError;
use crate::place::Place;
use crate::scenario::{Frame, ScenarioInfo};

/// Tolerance between poses of one view in different states (metres, or entries of the rotation).
const POSE_TOLERANCE: f64 = 1e-4;

/// Derives states without a scenario: the largest timestamp gives the number of time steps.
pub(crate) fn derive_states_without_scenario(frames: &mut [Frame]) {
    if frames.iter().any(|f| f.state.is_some() || f.branch.is_none() || f.timestamp.is_none()) {
        return;
    }
    let timestamps = frames.iter().filter_map(|f| f.timestamp).max().map_or(1, |t| t + 1);
    for frame in frames {
        frame.state = frame.branch.zip(frame.timestamp).map(|(b, t)| b * timestamps + t);
    }
}

fn same_pose(a: &PinholeCamera, b: &PinholeCamera) -> bool {
    let (a, b) = (a.world_from_camera.iter().flatten(), b.world_from_camera.iter().flatten());
    a.zip(b).all(|(a, b)| (a - b).abs() <= POSE_TOLERANCE)
}

/// Numbers the views of frames without a view: each distinct pose is a view, in order of appearance.
pub(crate) fn number_views_by_pose(frames: &mut [Frame]) {
    // Poses are sorted into cells of the tolerance's size; equal poses may be in neighbouring cells along the position.
    let mut known: HashMap<[i64; 3], Vec<(PinholeCamera, usize)>> = HashMap::new();
    let mut next = 0;
    for frame in frames {
        let position = frame.camera.position_m();
        let cell = position.map(|v| (v / (4.0 * POSE_TOLERANCE)).floor() as i64);
        let neighbours =
            (0..27).map(|i| [0, 1, 2].map(|axis| cell[axis].saturating_add(i / 3_i64.pow(axis as u32) % 3 - 1)));
        let found = neighbours
            .filter_map(|cell| known.get(&cell))
            .flatten()
            .find(|(camera, _)| same_pose(camera, &frame.camera))
            .map(|(_, view)| *view);
        let view = found.unwrap_or_else(|| {
            known.entry(cell).or_default().push((frame.camera, next));
            next += 1;
            next - 1
        });
        frame.view = Some(view);
    }
}

/// Renumbers views of files that each start at 0: if a number means different poses in two files, the later file's
/// views continue the numbering.
pub(crate) fn number_views_of_parts(frames: &mut [Frame], places: &[(PathBuf, String)]) {
    let mut first: HashMap<usize, usize> = HashMap::new();
    let collide = frames.iter().enumerate().any(|(i, frame)| {
        let Some(view) = frame.view else { return false };
        let other = *first.entry(view).or_insert(i);
        places[other].0 != places[i].0 && !same_pose(&frames[other].camera, &frame.camera)
    });
    if !collide {
        return;
    }
    let (mut offset, mut end) = (0, 0);
    for i in 0..frames.len() {
        if i > 0 && places[i].0 != places[i - 1].0 {
            offset = end;
        }
        if let Some(view) = &mut frames[i].view {
            *view += offset;
            end = end.max(*view + 1);
        }
    }
}

/// States in which each view of a scenario must have a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Views {
    InEveryState,
    InSomeStates,
}

/// Checks that a view is one pose that occurs at most once in a state of the scenario, and where `views` demands it, in
/// every state; and that indices have no gaps.
pub(crate) fn check_views(
    frames: &[Frame],
    places: &[(PathBuf, String)],
    scenario: Option<&ScenarioInfo>,
    views: Views,
) -> Result<(), DatasetError> {
    let place = |i: usize| Place { path: &places[i].0, place: places[i].1.clone() };
    let Some(scenario) = scenario else { return Ok(()) };
    let mut by_state_and_view: HashMap<(usize, usize), usize> = HashMap::new();
    let mut first_of_view: HashMap<usize, usize> = HashMap::new();
    for (i, frame) in frames.iter().enumerate() {
        let Some(state) = frame.state else { continue };
        let Some(view) = frame.view else {
            return Err(place(i).error("view_id", "is missing; each frame of a scenario names its camera pose"));
        };
        if let Some(&other) = by_state_and_view.get(&(state, view)) {
            return Err(place(i)
                .error("view_id", format!("view {view} of state {state} occurs before, in {}", places[other].1)));
        }
        by_state_and_view.insert((state, view), i);
        let first = *first_of_view.entry(view).or_insert(i);
        let (a, b) = (&frames[first].camera, &frame.camera);
        if !same_pose(a, b) {
            return Err(place(i).error(
                "transform_matrix",
                format!("differs from that of the same view {view} in {}; a view is one fixed pose", places[first].1),
            ));
        }
    }
    let view_count = first_of_view.keys().max().map_or(0, |v| v + 1);
    let file = Place { path: &places[0].0, place: "frames".to_owned() };
    for view in 0..view_count {
        if !first_of_view.contains_key(&view) {
            return Err(file.error("view_id", format!("no frame has view {view}, though {} is used", view_count - 1)));
        }
        for state in (0..scenario.state_count()).filter(|_| views == Views::InEveryState) {
            if !by_state_and_view.contains_key(&(state, view)) {
                return Err(file.error(
                    "view_id",
                    format!(
                        "view {view} is missing in state {state} (branch `{}`, timestamp {}); every view is needed in \
                         every state, except for `carff train` and `carff eval`",
                        scenario.branches[state / scenario.timestamps],
                        state % scenario.timestamps
                    ),
                ));
            }
        }
    }
    if let Some(view) = scenario.bev_view.filter(|v| *v >= view_count) {
        let at = Place { path: &places[0].0, place: "scenario".to_owned() };
        return Err(at.error("bev_view", format!("is {view}, but the views are 0 to {}", view_count - 1)));
    }
    Ok(())
}
