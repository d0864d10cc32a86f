//! Reading of the scenario and of a frame's state.

use std::path::Path;

use carff_base::geometry::OrientedBox;
use serde_json::{Map, Value};

use crate::error::DatasetError;
use crate::place::{Place, numbers, present};
use crate::scenario::MAX_FRAMES;
use crate::scenario::{Candidate, NamedBox, ScenarioInfo, StateInfo};

const MAX_BRANCHES: usize = 1024;
const MAX_TIMESTAMPS: usize = 4096;

type StateIndices = (Option<usize>, Option<usize>, Option<usize>);

/// Returns state, branch and timestamp of a frame, each derived from the others if the scenario allows it.
pub(crate) fn read_state(
    place: &Place,
    frame: &Map<String, Value>,
    scenario: Option<&ScenarioInfo>,
) -> Result<StateIndices, DatasetError> {
    let Some(scenario) = scenario else {
        let state = place.index(frame, "scene_id", MAX_BRANCHES * MAX_TIMESTAMPS)?;
        let branch = place.index(frame, "branch", MAX_BRANCHES)?;
        return Ok((state, branch, place.index(frame, "timestamp", MAX_TIMESTAMPS)?));
    };
    let scene_id = place.index(frame, "scene_id", scenario.state_count())?;
    let branch = place.index(frame, "branch", scenario.branches.len())?;
    let timestamp = place.index(frame, "timestamp", scenario.timestamps)?;
    let single_branch = (scenario.branches.len() == 1).then_some(0);
    let single_timestamp = (scenario.timestamps == 1).then_some(0);
    let named = branch.or(single_branch).zip(timestamp.or(single_timestamp)).map(|(b, t)| b * scenario.timestamps + t);
    let state = match (scene_id, named) {
        (Some(id), Some(named)) if id != named => {
            return Err(place.error(
                "scene_id",
                format!(
                    "is {id}, but `branch` and `timestamp` make {named} (branch * {} + timestamp)",
                    scenario.timestamps
                ),
            ));
        }
        (Some(id), _) => id,
        (None, Some(named)) => named,
        (None, None) => {
            let key = if branch.is_some() { "timestamp" } else { "scene_id" };
            return Err(place.error(key, "is missing; add `scene_id`, or `branch` and `timestamp`"));
        }
    };
    let (b, t) = (state / scenario.timestamps, state % scenario.timestamps);
    for (key, given, derived) in [("branch", branch, b), ("timestamp", timestamp, t)] {
        if given.is_some_and(|given| given != derived) {
            return Err(place.error(key, format!("is in conflict with `scene_id` {state}, which makes it {derived}")));
        }
    }
    Ok((Some(state), Some(b), Some(t)))
}

pub(crate) fn read_scenario(path: &Path, dir: &Path, value: &Value) -> Result<ScenarioInfo, DatasetError> {
    let place = Place { path, place: "scenario".to_owned() };
    let map = place.object(value)?;
    let name = match place.text(map, "name")? {
        Some(name) => name.to_owned(),
        None => dir.file_name().map_or_else(|| "unnamed".to_owned(), |n| n.to_string_lossy().into_owned()),
    };
    let corners: Option<Vec<[f64; 3]>> =
        present(map, "bounds").and_then(Value::as_array).and_then(|c| c.iter().map(numbers::<3>).collect());
    let bounds: [[f64; 3]; 2] = corners
        .and_then(|c| c.try_into().ok())
        .ok_or_else(|| place.error("bounds", "must be [[x0, y0, z0], [x1, y1, z1]], finite, in metres"))?;
    if (0..3).any(|i| bounds[0][i] >= bounds[1][i]) {
        return Err(place.error("bounds", "the first corner must be below the second along every axis"));
    }
    let branches = read_branches(&place, map)?;
    let timestamps = place
        .index(map, "timestamps", MAX_TIMESTAMPS + 1)?
        .filter(|t| *t > 0)
        .ok_or_else(|| place.error("timestamps", format!("must be a whole number from 1 to {MAX_TIMESTAMPS}")))?;
    let states = read_states(&place, map, branches.len(), timestamps)?;
    let mut candidates = Vec::new();
    for (i, value) in optional_list(&place, map, "candidates")?.iter().enumerate() {
        let at = place.within(format!("scenario.candidates[{i}]"));
        let candidate = at.object(value)?;
        candidates.push(Candidate {
            branch: at.index(candidate, "branch", branches.len())?,
            timestamp: at.index(candidate, "timestamp", timestamps)?,
            named_box: read_box(&at, candidate)?,
        });
    }
    let mut static_boxes = Vec::new();
    for (i, value) in optional_list(&place, map, "static_boxes")?.iter().enumerate() {
        let at = place.within(format!("scenario.static_boxes[{i}]"));
        static_boxes.push(read_box(&at, at.object(value)?)?);
    }
    let hazard_branches = read_hazard_branches(&place, map, branches.len())?;
    let hazard_from_timestamp = place.index(map, "hazard_from_timestamp", timestamps)?.unwrap_or(0);
    let (mut hazard_action, mut clear_action) = ("halt".to_owned(), "advance".to_owned());
    if let Some(actions) = present(map, "actions") {
        let at = place.within("scenario.actions".to_owned());
        let actions = at.object(actions)?;
        if let Some(name) = at.text(actions, "hazard")? {
            name.clone_into(&mut hazard_action);
        }
        if let Some(name) = at.text(actions, "clear")? {
            name.clone_into(&mut clear_action);
        }
    }
    let step_s = match present(map, "step_s") {
        None => None,
        Some(value) => match value.as_f64().filter(|s| *s > 0.0 && s.is_finite()) {
            Some(step_s) => Some(step_s),
            None => return Err(place.error("step_s", "must be a number of seconds above 0")),
        },
    };
    Ok(ScenarioInfo {
        name,
        bounds,
        branches,
        timestamps,
        step_s,
        bev_view: place.index(map, "bev_view", MAX_FRAMES)?,
        states,
        candidates,
        static_boxes,
        hazard_branches,
        hazard_from_timestamp,
        hazard_action,
        clear_action,
    })
}

fn read_branches(place: &Place, map: &Map<String, Value>) -> Result<Vec<String>, DatasetError> {
    let mut branches = Vec::new();
    for branch in place.array(map, "branches")? {
        let name = branch.as_str().ok_or_else(|| place.error("branches", "must be a list of names"))?;
        if branches.iter().any(|b| b == name) {
            return Err(place.error("branches", format!("`{name}` is named twice")));
        }
        branches.push(name.to_owned());
    }
    if branches.is_empty() || branches.len() > MAX_BRANCHES {
        return Err(place.error("branches", format!("{} names; from 1 to {MAX_BRANCHES} are allowed", branches.len())));
    }
    Ok(branches)
}

fn read_hazard_branches(place: &Place, map: &Map<String, Value>, count: usize) -> Result<Vec<usize>, DatasetError> {
    let mut hazard_branches = Vec::new();
    for value in optional_list(place, map, "hazard_branches")? {
        let branch = value.as_u64().map(|b| b as usize).filter(|b| *b < count);
        hazard_branches.push(branch.ok_or_else(|| {
            place.error("hazard_branches", format!("must be branch indices from 0 to {}, found {value}", count - 1))
        })?);
    }
    Ok(hazard_branches)
}

fn optional_list<'v>(place: &Place, map: &'v Map<String, Value>, key: &str) -> Result<&'v [Value], DatasetError> {
    if present(map, key).is_none() { Ok(&[]) } else { Ok(place.array(map, key)?) }
}

fn read_states(
    place: &Place,
    map: &Map<String, Value>,
    branches: usize,
    timestamps: usize,
) -> Result<Vec<StateInfo>, DatasetError> {
    let count = branches * timestamps;
    let mut states: Vec<StateInfo> = (0..count)
        .map(|s| StateInfo { branch: s / timestamps, timestamp: s % timestamps, boxes: Vec::new() })
        .collect();
    let mut seen = vec![false; count];
    for (i, value) in optional_list(place, map, "states")?.iter().enumerate() {
        let at = place.within(format!("scenario.states[{i}]"));
        let entry = at.object(value)?;
        let scene_id = at.index(entry, "scene_id", count)?;
        let branch = at.index(entry, "branch", branches)?;
        let timestamp = at.index(entry, "timestamp", timestamps)?;
        let named = branch.zip(timestamp).map(|(b, t)| b * timestamps + t);
        let state = match (scene_id, named) {
            (Some(a), Some(b)) if a != b => {
                return Err(at.error("scene_id", format!("is {a}, but `branch` and `timestamp` make {b}")));
            }
            (Some(s), _) | (None, Some(s)) => s,
            (None, None) => {
                return Err(at.error("scene_id", "is missing; add `scene_id`, or `branch` and `timestamp`"));
            }
        };
        if std::mem::replace(&mut seen[state], true) {
            return Err(at.error("scene_id", format!("state {state} is given twice")));
        }
        for (j, value) in optional_list(&at, entry, "boxes")?.iter().enumerate() {
            let at = place.within(format!("scenario.states[{i}].boxes[{j}]"));
            states[state].boxes.push(read_box(&at, at.object(value)?)?);
        }
    }
    if let Some(missing) = seen.iter().position(|s| !s).filter(|_| seen.contains(&true)) {
        return Err(place.error("states", format!("state {missing} is missing; all of 0 to {} are needed", count - 1)));
    }
    Ok(states)
}

fn read_box(place: &Place, map: &Map<String, Value>) -> Result<NamedBox, DatasetError> {
    let half_size = place.vector(map, "half_size")?;
    if half_size.iter().any(|v| *v <= 0.0) {
        return Err(place.error("half_size", "must be greater than zero along every axis, metres"));
    }
    let dynamic = match present(map, "dynamic") {
        None => false,
        Some(value) => value.as_bool().ok_or_else(|| place.error("dynamic", "must be true or false"))?,
    };
    Ok(NamedBox {
        name: place.text(map, "name")?.ok_or_else(|| place.error("name", "is missing"))?.to_owned(),
        role: place.text(map, "role")?.map(str::to_owned),
        oriented_box: OrientedBox {
            center: place.vector(map, "center")?,
            half_size,
            yaw: place.number(map, "yaw")?.unwrap_or(0.0),
        },
        dynamic,
    })
}
