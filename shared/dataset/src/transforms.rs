//! Reading of transforms files: every value is checked, and every error names file, place and key.

use std::path::{Path, PathBuf};

use carff_messages::Observability;
use rayon::prelude::*;
use serde::de::Error;
use serde_json::{Map, Value};

use crate::camera::{Keys, read_path};
use crate::error::DatasetError;
use crate::image::{dimensions, is_turned};
use crate::lens::Lens;
use crate::place::{Place, present};
use crate::scenario::MAX_FRAMES;
use crate::scenario::{Frame, ScenarioInfo};
use crate::scenario_keys::{read_scenario, read_state};
use crate::unique::Unique;
use crate::views::{Views, check_views, derive_states_without_scenario, number_views_by_pose, number_views_of_parts};

/// Maximum size of a transforms file, bytes.
pub const MAX_TRANSFORMS_BYTES: u64 = 1 << 29;

pub(crate) struct Transforms {
    pub frames: Vec<Frame>,
    pub scenario: Option<ScenarioInfo>,
    pub warnings: Vec<String>,
    /// Frames without a readable image or mask, with the error.
    pub faults: Vec<(usize, DatasetError)>,
}

pub(crate) fn read(dir: &Path, views: Views) -> Result<Transforms, DatasetError> {
    let mut documents = Vec::new();
    for path in files(dir)? {
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

    let (mut frames, mut faults) = (Vec::new(), Vec::new());
    let mut places: Vec<(PathBuf, String)> = Vec::new();
    let mut warnings = Vec::new();
    for document in &documents {
        let file = Place { path: &document.path, place: "top level".to_owned() };
        let top = file.object(&document.root)?;
        let first = frames.len();
        let mut rounded = 0;
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
            let keys = Keys { place: &place, frame: place.object(value)?, top };
            let (frame, was_rounded, fault) = read_frame(dir, &keys, scenario.as_ref())?;
            faults.extend(fault.map(|fault| (frames.len(), fault)));
            rounded += usize::from(was_rounded);
            frames.push(frame);
            places.push((document.path.clone(), place.place));
        }
        warn(&document.path, &frames[first..], rounded, &mut warnings);
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
    check_views(&frames, &places, scenario.as_ref(), views)?;
    Ok(Transforms { frames, scenario, warnings, faults })
}

/// Returns the files of a folder: one, or one for each part.
fn files(dir: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    if !dir.is_dir() {
        return Err(DatasetError::NotAFolder { path: dir.to_owned() });
    }
    let whole = dir.join("transforms.json");
    if whole.is_file() {
        return Ok(vec![whole]);
    }
    let of_parts = ["train", "val", "test"].map(|part| dir.join(format!("transforms_{part}.json")));
    let files: Vec<PathBuf> = of_parts.into_iter().filter(|path| path.is_file()).collect();
    if files.is_empty() { Err(DatasetError::NoTransforms { path: dir.to_owned() }) } else { Ok(files) }
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
    let bytes = std::fs::read(path).map_err(io)?;
    let json = |source| DatasetError::Json { path: path.to_owned(), source };
    if let Some(what) = carff_base::errors::stand_in(&bytes[..bytes.len().min(64)]) {
        return Err(json(serde_json::Error::custom(what)));
    }
    let text = match utf16_order(&bytes) {
        Some(order) => {
            decode_utf16(&bytes, order).ok_or_else(|| json(serde_json::Error::custom("not valid UTF-16")))?
        }
        None => bytes,
    };
    let text = text.strip_prefix("\u{feff}".as_bytes()).unwrap_or(&text);
    serde_json::from_slice(text).map(|Unique(root)| root).map_err(json)
}

type ByteOrder = fn([u8; 2]) -> u16;

/// Returns the byte order of UTF-16, which has a byte order mark, or a zero next to the first character of a JSON file.
fn utf16_order(bytes: &[u8]) -> Option<ByteOrder> {
    match bytes {
        [0xFF, 0xFE, ..] | [b'{' | b'\n' | b'\r' | b'\t' | b' ', 0, ..] => Some(u16::from_le_bytes),
        [0xFE, 0xFF, ..] | [0, b'{' | b'\n' | b'\r' | b'\t' | b' ', ..] => Some(u16::from_be_bytes),
        _ => None,
    }
}

/// Converts UTF-16 to UTF-8; `None` if it is not valid.
fn decode_utf16(bytes: &[u8], order: ByteOrder) -> Option<Vec<u8>> {
    let (pairs, rest) = bytes.as_chunks::<2>();
    let text = String::from_utf16(&pairs.iter().map(|&pair| order(pair)).collect::<Vec<_>>()).ok()?;
    rest.is_empty().then(|| text.into_bytes())
}

/// Returns true if instant-ngp would find a mask next to the image; its masks are white where a pixel is ignored.
fn has_unnamed_mask(frame: &Frame) -> bool {
    let name = frame.image_path.file_stem().map(|stem| format!("dynamic_mask_{}.png", stem.display()));
    frame.mask_path.is_none() && name.is_some_and(|name| frame.image_path.with_file_name(name).is_file())
}

/// Warns about lenses, rounded poses and unnamed masks of a file's frames.
fn warn(path: &Path, frames: &[Frame], rounded: usize, warnings: &mut Vec<String>) {
    let bent: Vec<&Frame> = frames.iter().filter(|f| f.lens != Lens::Pinhole).collect();
    if let Some(first) = bent.first() {
        warnings.push(format!(
            "{}: lens distortion (key `{}`) is undone in {} of {} images when they are read; a run's camera must \
             deliver undistorted images as well",
            path.display(),
            first.lens.key(),
            bent.len(),
            frames.len()
        ));
    }
    let outside = |centre: f64, side: u32| !(0.0..=f64::from(side)).contains(&centre);
    let cropped =
        |f: &&Frame| outside(f.camera.cx_px, f.camera.width_px) || outside(f.camera.cy_px, f.camera.height_px);
    let outside = frames.iter().filter(cropped).count();
    if outside > 0 {
        warnings.push(format!(
            "{}: the principal point (keys `cx` and `cy`) of {outside} of {} images is outside of them, as in parts of \
             larger images",
            path.display(),
            frames.len()
        ));
    }
    let unnamed = frames.iter().filter(|frame| has_unnamed_mask(frame)).count();
    if unnamed > 0 {
        warnings.push(format!(
            "{}: {unnamed} of {} images have a `dynamic_mask_` file next to them, which is not used; name inverted masks \
             (zero where a pixel is ignored) with the key `mask_path`",
            path.display(),
            frames.len()
        ));
    }
    if rounded > 0 {
        warnings.push(format!(
            "{}: the rotation of {rounded} of {} poses is rounded; the nearest rotation is used",
            path.display(),
            frames.len()
        ));
    }
}

/// Returns a warning about images that viewers turn or mirror; `None` if there are none.
pub(crate) fn warning_of_turned(dir: &Path, frames: &[Frame]) -> Option<String> {
    let turned = frames.par_iter().filter(|frame| is_turned(&frame.image_path)).count();
    (turned > 0).then(|| {
        format!(
            "{}: {turned} of {} images have an EXIF orientation, which is not used; if the poses are those of the turned \
             images, turn the pixels and remove it",
            dir.display(),
            frames.len()
        )
    })
}

/// Returns the frame, whether its rotation was rounded, and the error of its image or mask.
fn read_frame(
    dir: &Path,
    keys: &Keys,
    scenario: Option<&ScenarioInfo>,
) -> Result<(Frame, bool, Option<DatasetError>), DatasetError> {
    let Keys { place, frame, top } = *keys;
    let name = place
        .text(frame, "file_path")?
        .filter(|name| !name.is_empty())
        .ok_or_else(|| place.error("file_path", "is missing; it is the image's path relative to the dataset folder"))?;
    let (image_path, mut fault) = read_path(dir, place, "file_path", name)?;
    let mask = match place.text(frame, "mask_path")?.filter(|name| !name.is_empty()) {
        Some(name) => Some(read_path(dir, place, "mask_path", name)?),
        None => None,
    };
    let mask_path = mask.map(|(path, missing)| {
        fault = fault.take().or(missing);
        path
    });
    let (camera, rounded) = keys.camera(|| match dimensions(&image_path) {
        Ok(size) => Some(size),
        Err(error) => {
            fault.get_or_insert(error);
            None
        }
    })?;
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
    let frame = Frame {
        image_path,
        mask_path,
        lens: Lens::read(place, frame, top)?,
        camera,
        state,
        branch,
        timestamp,
        view,
        observability,
        visible_fraction,
        actor_px: place.index(frame, "actor_px", 1 << 30)?.map(|v| v as u32),
        view_kind: place.text(frame, "view_kind")?.map(str::to_owned),
        alike_states: alike_states(place, frame, scenario)?,
    };
    Ok((frame, rounded, fault))
}

/// Reads `alike_states`: indices of states of the scenario.
fn alike_states(
    place: &Place,
    frame: &Map<String, Value>,
    scenario: Option<&ScenarioInfo>,
) -> Result<Option<Vec<usize>>, DatasetError> {
    let Some(value) = present(frame, "alike_states") else { return Ok(None) };
    let count = scenario.map_or(0, ScenarioInfo::state_count);
    let index = |v: &Value| v.as_u64().map(|v| v as usize).filter(|v| *v < count);
    let states: Option<Vec<usize>> = value.as_array().and_then(|all| all.iter().map(index).collect());
    let error =
        || place.error("alike_states", format!("must be a list of state indices from 0 to {}", count.max(1) - 1));
    states.map(Some).ok_or_else(error)
}
