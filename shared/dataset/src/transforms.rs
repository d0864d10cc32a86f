//! Reading of transforms files: every value is checked, and every error names file, place and key.

use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};

use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_messages::Observability;
use serde_json::{Map, Value};

use crate::error::DatasetError;
use crate::image::{MAX_IMAGE_SIDE_PX, dimensions};
use crate::scenario::{Candidate, Frame, NamedBox, ScenarioInfo, StateInfo};

/// Maximum size of a transforms file, bytes.
pub const MAX_TRANSFORMS_BYTES: u64 = 1 << 29;
/// Maximum number of frames in a dataset.
pub const MAX_FRAMES: usize = 1_000_000;
const MAX_BRANCHES: usize = 1024;
const MAX_TIMESTAMPS: usize = 4096;
/// Tolerance between poses of one view in different states (metres, or entries of the rotation).
const POSE_TOLERANCE: f64 = 1e-4;

/// Image formats that frames may name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pictures {
    /// PNG files inside the dataset's folder: the program's own format.
    Png,
    /// PNG and JPEG files, for imports.
    PngOrJpeg,
}

/// Lens distortion of the `OPENCV` model: k1, k2, k3, k4 (radial, of the 2nd, 4th, 6th and 8th power), p1, p2.
pub(crate) type Distortion = [f64; 6];

pub(crate) struct Transforms {
    pub frames: Vec<Frame>,
    /// Distortion of each frame.
    pub distortions: Vec<Distortion>,
    pub scenario: Option<ScenarioInfo>,
    pub warnings: Vec<String>,
}

pub(crate) fn read(dir: &Path, pictures: Pictures) -> Result<Transforms, DatasetError> {
    if !dir.is_dir() {
        return Err(DatasetError::NotAFolder { path: dir.to_owned() });
    }
    let whole = dir.join("transforms.json");
    let files: Vec<PathBuf> = if whole.is_file() {
        vec![whole]
    } else {
        ["train", "val", "test"]
            .iter()
            .map(|part| dir.join(format!("transforms_{part}.json")))
            .filter(|path| path.is_file())
            .collect()
    };
    if files.is_empty() {
        return Err(DatasetError::NoTransforms { path: dir.to_owned() });
    }

    let mut documents = Vec::new();
    for path in files {
        documents.push(Document { root: parse(&path)?, path });
    }
    // The scenario is read first, from whichever file has it: it defines how a scene_id splits into branch and time
    // step.
    let mut scenario: Option<ScenarioInfo> = None;
    for document in &documents {
        let file = Place { path: &document.path, place: "top level".to_owned() };
        let top = file.object(&document.root)?;
        if let Some(value) = present(top, "scenario") {
            let found = read_scenario(&document.path, dir, value)?;
            match &scenario {
                None => scenario = Some(found),
                Some(first) if *first == found => {}
                Some(_) => return Err(file.error("scenario", "differs from that of the file read before it")),
            }
        }
    }

    let (mut frames, mut distortions) = (Vec::new(), Vec::new());
    let mut places: Vec<(PathBuf, String)> = Vec::new();
    let mut warnings = Vec::new();
    for document in &documents {
        let file = Place { path: &document.path, place: "top level".to_owned() };
        let top = file.object(&document.root)?;
        warn_about_distortion(&document.path, top, &mut warnings);
        let list = file.array(top, "frames")?;
        if frames.len() + list.len() > MAX_FRAMES {
            return Err(file.error("frames", format!("more than {MAX_FRAMES} frames")));
        }
        for (index, value) in list.iter().enumerate() {
            let label = value.get("file_path").and_then(Value::as_str).map_or_else(
                || format!("frame {index}"),
                |name| format!("frame {index} ({})", name.chars().take(120).collect::<String>()),
            );
            let place = Place { path: &document.path, place: label };
            let frame = place.object(value)?;
            distortions.push(read_distortion(&place, frame, top)?);
            frames.push(read_frame(dir, &place, frame, top, scenario.as_ref(), pictures)?);
            places.push((document.path.clone(), place.place));
        }
    }
    if frames.is_empty() {
        let file = Place { path: &documents[0].path, place: "top level".to_owned() };
        return Err(file.error("frames", "is empty; at least one frame is needed"));
    }
    if scenario.is_none() {
        derive_states_without_scenario(&mut frames);
    }
    if scenario.is_some() {
        if frames.iter().all(|f| f.view.is_none()) {
            number_views_by_pose(&mut frames);
        } else {
            number_views_of_parts(&mut frames, &places);
        }
    }
    check_views(&frames, &places, scenario.as_ref())?;
    Ok(Transforms { frames, distortions, scenario, warnings })
}

struct Document {
    path: PathBuf,
    root: Value,
}

fn parse(path: &Path) -> Result<Value, DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let bytes = std::fs::metadata(path).map_err(io)?.len();
    if bytes > MAX_TRANSFORMS_BYTES {
        return Err(DatasetError::TooLarge { path: path.to_owned(), bytes, limit: MAX_TRANSFORMS_BYTES });
    }
    let text = std::fs::read(path).map_err(io)?;
    serde_json::from_slice(&text).map_err(|source| DatasetError::Json { path: path.to_owned(), source })
}

/// Place in a file, for errors and typed look-ups.
struct Place<'a> {
    path: &'a Path,
    place: String,
}

impl<'a> Place<'a> {
    fn error(&self, key: &str, problem: impl Into<String>) -> DatasetError {
        DatasetError::Key {
            path: self.path.to_owned(),
            place: self.place.clone(),
            key: key.to_owned(),
            problem: problem.into(),
        }
    }

    fn within(&self, place: String) -> Place<'a> {
        Place { path: self.path, place }
    }

    fn object<'v>(&self, value: &'v Value) -> Result<&'v Map<String, Value>, DatasetError> {
        value.as_object().ok_or_else(|| self.error("{}", format!("must be an object, found {}", kind(value))))
    }

    fn array<'v>(&self, map: &'v Map<String, Value>, key: &str) -> Result<&'v Vec<Value>, DatasetError> {
        let value = present(map, key).ok_or_else(|| self.error(key, "is missing"))?;
        value.as_array().ok_or_else(|| self.error(key, format!("must be a list, found {}", kind(value))))
    }

    fn number(&self, map: &Map<String, Value>, key: &str) -> Result<Option<f64>, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(None) };
        match value.as_f64() {
            Some(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(self.error(key, format!("must be a finite number, found {}", kind(value)))),
        }
    }

    /// Returns a whole number below `limit`. `3.0` is accepted, because other tools write sizes that way.
    fn index(&self, map: &Map<String, Value>, key: &str, limit: usize) -> Result<Option<usize>, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(None) };
        let number = value.as_f64().filter(|n| n.fract() == 0.0 && *n >= 0.0 && *n < limit as f64);
        match number {
            Some(number) => Ok(Some(number as usize)),
            None => Err(self.error(key, format!("must be a whole number from 0 to {}, found {value}", limit - 1))),
        }
    }

    fn text<'v>(&self, map: &'v Map<String, Value>, key: &str) -> Result<Option<&'v str>, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(None) };
        value.as_str().map(Some).ok_or_else(|| self.error(key, format!("must be a text, found {}", kind(value))))
    }

    fn vector(&self, map: &Map<String, Value>, key: &str) -> Result<[f64; 3], DatasetError> {
        let value = present(map, key).ok_or_else(|| self.error(key, "is missing"))?;
        numbers::<3>(value).ok_or_else(|| self.error(key, "must be a list of 3 finite numbers"))
    }
}

/// Returns the value of a key that exists and is not null.
fn present<'v>(map: &'v Map<String, Value>, key: &str) -> Option<&'v Value> {
    map.get(key).filter(|value| !value.is_null())
}

fn numbers<const N: usize>(value: &Value) -> Option<[f64; N]> {
    let list: Vec<f64> = value.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?;
    let list: [f64; N] = list.try_into().ok()?;
    list.iter().all(|v| v.is_finite()).then_some(list)
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "a number",
        Value::String(_) => "a text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}

/// Returns the frame's own coefficients, or else those at top level.
fn read_distortion(
    place: &Place,
    frame: &Map<String, Value>,
    top: &Map<String, Value>,
) -> Result<Distortion, DatasetError> {
    let mut distortion = [0.0; 6];
    for (value, key) in distortion.iter_mut().zip(["k1", "k2", "k3", "k4", "p1", "p2"]) {
        *value = match place.number(frame, key)? {
            Some(own) => own,
            None => place.within("top level".to_owned()).number(top, key)?.unwrap_or(0.0),
        };
    }
    Ok(distortion)
}

fn warn_about_distortion(path: &Path, top: &Map<String, Value>, warnings: &mut Vec<String>) {
    for key in ["k1", "k2", "k3", "k4", "p1", "p2"] {
        if top.get(key).and_then(Value::as_f64).is_some_and(|v| v.abs() > 1e-9) {
            warnings.push(format!(
                "{}: lens distortion (key `{key}`) is ignored; undistort the images first",
                path.display()
            ));
        }
    }
}

fn read_frame(
    dir: &Path,
    place: &Place,
    frame: &Map<String, Value>,
    top: &Map<String, Value>,
    scenario: Option<&ScenarioInfo>,
    pictures: Pictures,
) -> Result<Frame, DatasetError> {
    let image_path = read_image_path(dir, place, frame, pictures)?;
    let camera = read_camera(place, frame, top, &image_path)?;
    let (state, branch, timestamp) = read_state(place, frame, scenario)?;
    let view = match place.index(frame, "view_id", MAX_FRAMES)? {
        Some(view) => Some(view),
        None => match place.index(frame, "view_index", MAX_FRAMES)? {
            Some(view) => Some(view),
            None => place.index(frame, "time_index", MAX_FRAMES)?,
        },
    };
    let observability = match place.text(frame, "observability")? {
        None => None,
        Some(name) => Some(Observability::from_name(name).ok_or_else(|| {
            place.error("observability", format!("must be `full`, `partial` or `none`, found `{name}`"))
        })?),
    };
    let visible_fraction = match place.number(frame, "visible_fraction")? {
        Some(v) if !(0.0..=1.0).contains(&v) => {
            return Err(place.error("visible_fraction", format!("must be from 0 to 1, found {v}")));
        }
        v => v.map(|v| v as f32),
    };
    Ok(Frame {
        image_path,
        camera,
        state,
        branch,
        timestamp,
        view,
        observability,
        visible_fraction,
        actor_px: place.index(frame, "actor_px", 1 << 30)?.map(|v| v as u32),
        view_kind: place.text(frame, "view_kind")?.map(str::to_owned),
    })
}

fn read_image_path(
    dir: &Path,
    place: &Place,
    frame: &Map<String, Value>,
    pictures: Pictures,
) -> Result<PathBuf, DatasetError> {
    let name = place
        .text(frame, "file_path")?
        .filter(|name| !name.is_empty())
        .ok_or_else(|| place.error("file_path", "is missing; it is the image's path relative to the dataset folder"))?;
    let mut relative = PathBuf::new();
    for component in Path::new(name).components() {
        match component {
            Component::Normal(part) => relative.push(part),
            Component::CurDir => {}
            Component::ParentDir | Component::RootDir | Component::Prefix(_) => {
                return Err(place.error("file_path", "must stay inside the dataset folder: no leading `/` and no `..`"));
            }
        }
    }
    match relative.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()) {
        None => {
            relative.set_extension("png");
        }
        Some(extension) if extension == "png" => {}
        Some(extension) if pictures == Pictures::PngOrJpeg && matches!(&*extension, "jpg" | "jpeg") => {}
        Some(extension) => {
            return Err(place.error(
                "file_path",
                format!("is a .{extension} file; only .png images are read (`carff dataset import` also takes .jpg)"),
            ));
        }
    }
    let path = dir.join(relative);
    if path.is_file() {
        Ok(path)
    } else {
        Err(place.error("file_path", format!("there is no file {}", path.display())))
    }
}

fn read_camera(
    place: &Place,
    frame: &Map<String, Value>,
    top: &Map<String, Value>,
    image_path: &Path,
) -> Result<PinholeCamera, DatasetError> {
    let number = |key: &str| -> Result<Option<f64>, DatasetError> {
        match place.number(frame, key)? {
            Some(value) => Ok(Some(value)),
            None => place.within("top level".to_owned()).number(top, key),
        }
    };
    let side = |key: &str| -> Result<Option<u32>, DatasetError> {
        match number(key)? {
            None => Ok(None),
            Some(v) if v.fract() == 0.0 && v >= 1.0 && v <= f64::from(MAX_IMAGE_SIDE_PX) => Ok(Some(v as u32)),
            Some(v) => {
                Err(place.error(key, format!("must be a whole number from 1 to {MAX_IMAGE_SIDE_PX} pixels, found {v}")))
            }
        }
    };
    let (width_px, height_px) = match (side("w")?, side("h")?) {
        (Some(w), Some(h)) => (w, h),
        (None, None) => {
            let (w, h) = dimensions(image_path)?;
            if w > MAX_IMAGE_SIDE_PX || h > MAX_IMAGE_SIDE_PX {
                return Err(place.error("file_path", format!("{w}x{h} pixels; at most {MAX_IMAGE_SIDE_PX} a side")));
            }
            (w, h)
        }
        (None, Some(_)) => return Err(place.error("w", "is missing while `h` is given")),
        (Some(_), None) => return Err(place.error("h", "is missing while `w` is given")),
    };
    // A frame's own angle takes precedence over a focal length at top level.
    let focal_length_px = |place: &Place, map: &Map<String, Value>| -> Result<Option<f64>, DatasetError> {
        if let Some(fl) = place.number(map, "fl_x")? {
            return Ok(Some(fl));
        }
        match place.number(map, "camera_angle_x")? {
            Some(angle) if angle > 0.0 && angle < std::f64::consts::PI => {
                Ok(Some(f64::from(width_px) / 2.0 / (angle / 2.0).tan()))
            }
            Some(angle) => {
                Err(place.error("camera_angle_x", format!("must be above 0 and below pi radians, found {angle}")))
            }
            None => Ok(None),
        }
    };
    let fl_x_px = match focal_length_px(place, frame)? {
        Some(fl) => fl,
        None => focal_length_px(&place.within("top level".to_owned()), top)?
            .ok_or_else(|| place.error("fl_x", "is missing, and so is `camera_angle_x`; one of them is needed"))?,
    };
    let matrix = present(frame, "transform_matrix").ok_or_else(|| place.error("transform_matrix", "is missing"))?;
    let rows: Option<Vec<[f64; 4]>> =
        matrix.as_array().and_then(|rows| rows.iter().map(numbers::<4>).collect::<Option<_>>());
    let world_from_camera: [[f64; 4]; 4] = rows
        .and_then(|rows| rows.try_into().ok())
        .ok_or_else(|| place.error("transform_matrix", "must be 4 rows of 4 finite numbers"))?;
    let camera = PinholeCamera {
        width_px,
        height_px,
        fl_x_px,
        fl_y_px: number("fl_y")?.unwrap_or(fl_x_px),
        cx_px: number("cx")?.unwrap_or(f64::from(width_px) / 2.0),
        cy_px: number("cy")?.unwrap_or(f64::from(height_px) / 2.0),
        world_from_camera,
    };
    camera.validate().map_err(|error| {
        let key = match &error {
            carff_base::geometry::CameraError::NotFinite(key) | carff_base::geometry::CameraError::NotPositive(key) => {
                key
            }
            carff_base::geometry::CameraError::NotARotation => "transform_matrix",
        };
        place.error(
            key,
            format!("{error}; a camera-to-world matrix is a rotation and a translation over the row 0 0 0 1"),
        )
    })?;
    Ok(camera)
}

type StateIndices = (Option<usize>, Option<usize>, Option<usize>);

/// Returns state, branch and timestamp of a frame, each derived from the others if the scenario allows it.
fn read_state(
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

/// Derives states without a scenario: the largest timestamp gives the number of time steps.
fn derive_states_without_scenario(frames: &mut [Frame]) {
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
fn number_views_by_pose(frames: &mut [Frame]) {
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
fn number_views_of_parts(frames: &mut [Frame], places: &[(PathBuf, String)]) {
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

/// Checks that a view is one pose that occurs once in every state of the scenario, and that indices have no gaps.
fn check_views(
    frames: &[Frame],
    places: &[(PathBuf, String)],
    scenario: Option<&ScenarioInfo>,
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
        for state in 0..scenario.state_count() {
            if !by_state_and_view.contains_key(&(state, view)) {
                return Err(file.error(
                    "view_id",
                    format!(
                        "view {view} is missing in state {state} (branch `{}`, timestamp {}); every view is needed in \
                         every state",
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

fn read_scenario(path: &Path, dir: &Path, value: &Value) -> Result<ScenarioInfo, DatasetError> {
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
    let mut hazard_branches = Vec::new();
    for value in optional_list(&place, map, "hazard_branches")? {
        let branch = value.as_u64().map(|b| b as usize).filter(|b| *b < branches.len());
        hazard_branches.push(branch.ok_or_else(|| {
            place.error(
                "hazard_branches",
                format!("must be branch indices from 0 to {}, found {value}", branches.len() - 1),
            )
        })?);
    }
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
    Ok(ScenarioInfo {
        name,
        bounds,
        branches,
        timestamps,
        bev_view: place.index(map, "bev_view", MAX_FRAMES)?,
        states,
        candidates,
        static_boxes,
        hazard_branches,
        hazard_action,
        clear_action,
    })
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
