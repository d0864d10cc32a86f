//! Writing of datasets: images first, `transforms.json` last, so that an interrupted run never looks complete. Until
//! then, notes record the finished parts, so that the next run can continue.

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Component, Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use carff_base::geometry::PinholeCamera;
use image::ExtendedColorType;
use serde::{Serialize, de::DeserializeOwned};

use crate::error::DatasetError;
use crate::image::{Image, write_png};
use crate::scenario::{Candidate, NamedBox, ScenarioInfo};
use carff_messages::Observability;

/// Marks a folder as written by this program, so that it may be written again.
const MARKER: &str = ".carff-dataset";

/// Notes on an unfinished dataset: a line with its identity, then a line per finished part.
const NOTES: &str = "unfinished.jsonl";

/// Entry of an image in the transforms file.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameRecord {
    /// Path relative to the dataset's folder, as in `images/b0_t0_v000.png`.
    pub file_path: String,
    /// Intrinsics and pose.
    pub camera: PinholeCamera,
    /// Branch and time step of the image.
    pub branch_and_timestamp: Option<(usize, usize)>,
    /// Index of the fixed camera pose.
    pub view: Option<usize>,
    /// Visibility of the actor.
    pub observability: Option<Observability>,
    /// Ratio of visible pixels to the pixels of the unoccluded actor, 0..=1.
    pub visible_fraction: Option<f32>,
    /// Number of pixels that show the actor or its place.
    pub actor_px: Option<u32>,
    /// Kind of camera.
    pub view_kind: Option<String>,
    /// Path of its depth image (16-bit grey PNG: millimetres along the ray, 0 without a hit or beyond 65.535 m).
    pub depth_file_path: Option<String>,
    /// Path of the mask of its valid pixels (8-bit grey PNG: 0 where training ignores the pixel).
    pub mask_path: Option<String>,
    /// Path of its actor mask (8-bit grey PNG: 255 where the pixel shows the actor).
    pub mask_file_path: Option<String>,
    /// States that look the same from this pose, including its own.
    pub alike_states: Option<Vec<usize>>,
}

impl FrameRecord {
    /// Returns a record with only the image's path and camera.
    pub fn new(file_path: impl Into<String>, camera: PinholeCamera) -> Self {
        Self {
            file_path: file_path.into(),
            camera,
            branch_and_timestamp: None,
            view: None,
            observability: None,
            visible_fraction: None,
            actor_px: None,
            view_kind: None,
            depth_file_path: None,
            mask_path: None,
            mask_file_path: None,
            alike_states: None,
        }
    }
}

/// Writes a dataset into a folder. Its methods may be called from several threads.
#[derive(Debug)]
pub struct DatasetWriter {
    dir: PathBuf,
    notes: Option<Mutex<File>>,
}

impl DatasetWriter {
    /// Prepares a folder: it must not exist, be empty, or be a dataset of this program, which is then replaced.
    pub fn create(dir: &Path) -> Result<Self, DatasetError> {
        claim(dir)?;
        for file in ["transforms.json", NOTES] {
            missing_is_fine(dir, fs::remove_file(dir.join(file)))?;
        }
        for folder in ["images", "depth", "masks"] {
            missing_is_fine(dir, fs::remove_dir_all(dir.join(folder)))?;
        }
        Ok(Self { dir: dir.to_owned(), notes: None })
    }

    /// Prepares a folder as [`Self::create`] does, but continues an interrupted dataset of the same `identity` (one
    /// line): written files stay, and their notes are returned. An incomplete line ends the notes.
    pub fn go_on<T: DeserializeOwned>(dir: &Path, identity: &str) -> Result<(Self, Vec<T>), DatasetError> {
        claim(dir)?;
        let path = dir.join(NOTES);
        let io = |source| DatasetError::Io { path: path.clone(), source };
        let text = match fs::read(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            read => read.map_err(io)?,
        };
        let (mut notes, mut whole) = (Vec::new(), 0);
        for (i, line) in text.split_inclusive(|b| *b == b'\n').enumerate() {
            match line.strip_suffix(b"\n") {
                Some(line) if i == 0 && line == identity.as_bytes() => {}
                Some(line) if i > 0 => match serde_json::from_slice(line) {
                    Ok(note) => notes.push(note),
                    Err(_) => break,
                },
                _ => break,
            }
            whole += line.len();
        }
        if whole == 0 {
            Self::create(dir)?;
            fs::write(&path, format!("{identity}\n")).map_err(io)?;
            whole = identity.len() + 1;
        }
        let file = OpenOptions::new().append(true).open(&path).map_err(io)?;
        file.set_len(whole as u64).map_err(io)?;
        Ok((Self { dir: dir.to_owned(), notes: Some(Mutex::new(file)) }, notes))
    }

    /// Records that a part is finished, for [`Self::go_on`].
    pub fn note<T: Serialize>(&self, note: &T) -> Result<(), DatasetError> {
        let Some(notes) = &self.notes else { return Ok(()) };
        let path = self.dir.join(NOTES);
        let mut line = serde_json::to_vec(note).map_err(|source| DatasetError::Json { path: path.clone(), source })?;
        line.push(b'\n');
        let written = notes.lock().unwrap_or_else(PoisonError::into_inner).write_all(&line);
        written.map_err(|source| DatasetError::Io { path, source })
    }

    fn place(&self, file_path: &str) -> Result<PathBuf, DatasetError> {
        let inside = Path::new(file_path).components().all(|c| matches!(c, Component::Normal(_)));
        if !inside || file_path.is_empty() {
            return Err(DatasetError::Image {
                path: PathBuf::from(file_path),
                problem: "must stay inside the dataset folder: no leading `/` and no `..`".to_owned(),
            });
        }
        let path = self.dir.join(file_path);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(|source| DatasetError::Io { path: parent.to_owned(), source })?;
        }
        Ok(path)
    }

    /// Writes an image; `file_path` is relative to the dataset's folder.
    pub fn write_image(&self, file_path: &str, image: &Image) -> Result<(), DatasetError> {
        image.save_png(&self.place(file_path)?)
    }

    /// Writes depth in metres as a 16-bit grey PNG in millimetres; values that are not finite or beyond 65.535 m become
    /// 0.
    pub fn write_depth(
        &self,
        file_path: &str,
        depth_m: &[f32],
        width_px: u32,
        height_px: u32,
    ) -> Result<(), DatasetError> {
        let bytes: Vec<u8> = depth_m
            .iter()
            .flat_map(|d| {
                let mm = (d * 1000.0).round();
                let value = if (0.0..=65535.0).contains(&mm) { mm as u16 } else { 0 };
                // The encoder takes samples in native byte order.
                value.to_ne_bytes()
            })
            .collect();
        write_png(&self.place(file_path)?, &bytes, width_px, height_px, ExtendedColorType::L16)
    }

    /// Writes a mask as an 8-bit grey PNG, 255 for true.
    pub fn write_mask(
        &self,
        file_path: &str,
        mask: &[bool],
        width_px: u32,
        height_px: u32,
    ) -> Result<(), DatasetError> {
        let bytes: Vec<u8> = mask.iter().map(|&m| if m { 255 } else { 0 }).collect();
        write_png(&self.place(file_path)?, &bytes, width_px, height_px, ExtendedColorType::L8)
    }

    /// Writes `transforms.json` atomically. Intrinsics are at top level if all frames share them.
    pub fn finish(self, frames: &[FrameRecord], scenario: Option<&ScenarioInfo>) -> Result<(), DatasetError> {
        let shared = frames
            .first()
            .map(|f| Intrinsics::of(&f.camera))
            .filter(|first| frames.iter().all(|f| Intrinsics::of(&f.camera) == *first));
        let file = TransformsFile {
            frames: frames
                .iter()
                .map(|f| FrameFile {
                    file_path: &f.file_path,
                    transform_matrix: &f.camera.world_from_camera,
                    scene_id: scenario.zip(f.branch_and_timestamp).and_then(|(s, (b, t))| s.state(b, t)),
                    branch: f.branch_and_timestamp.map(|(b, _)| b),
                    timestamp: f.branch_and_timestamp.map(|(_, t)| t),
                    view_id: f.view,
                    observability: f.observability,
                    visible_fraction: f.visible_fraction.map(|v| (f64::from(v) * 1e4).round() / 1e4),
                    actor_px: f.actor_px,
                    view_kind: f.view_kind.as_deref(),
                    depth_file_path: f.depth_file_path.as_deref(),
                    mask_path: f.mask_path.as_deref(),
                    mask_file_path: f.mask_file_path.as_deref(),
                    alike_states: f.alike_states.as_deref(),
                    intrinsics: if shared.is_some() { None } else { Some(Intrinsics::of(&f.camera)) },
                })
                .collect(),
            intrinsics: shared,
            scenario: scenario.map(ScenarioFile::of),
        };
        let path = self.dir.join("transforms.json");
        let partial = self.dir.join("transforms.json.partial");
        let json = serde_json::to_vec(&file).map_err(|source| DatasetError::Json { path: path.clone(), source })?;
        fs::write(&partial, json).map_err(|source| DatasetError::Io { path: partial.clone(), source })?;
        fs::rename(&partial, &path).map_err(|source| DatasetError::Io { path, source })?;
        missing_is_fine(&self.dir, fs::remove_file(self.dir.join(NOTES)))
    }
}

/// Claims a folder: it must not exist, be empty, or be claimed already.
fn claim(dir: &Path) -> Result<(), DatasetError> {
    let io = |source| DatasetError::Io { path: dir.to_owned(), source };
    if dir.exists() {
        if !dir.is_dir() {
            return Err(DatasetError::NotAFolder { path: dir.to_owned() });
        }
        let empty = fs::read_dir(dir).map_err(io)?.next().is_none();
        if !empty && !dir.join(MARKER).is_file() {
            return Err(DatasetError::NotOurs { path: dir.to_owned() });
        }
    }
    fs::create_dir_all(dir).map_err(io)?;
    fs::write(dir.join(MARKER), "Written by carff; `carff dataset render` may write this folder again.\n").map_err(io)
}

fn missing_is_fine(dir: &Path, removed: std::io::Result<()>) -> Result<(), DatasetError> {
    match removed {
        Err(source) if source.kind() != ErrorKind::NotFound => Err(DatasetError::Io { path: dir.to_owned(), source }),
        _ => Ok(()),
    }
}

#[derive(Clone, Copy, PartialEq, Serialize)]
struct Intrinsics {
    w: u32,
    h: u32,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    camera_angle_x: f64,
}

impl Intrinsics {
    fn of(camera: &PinholeCamera) -> Self {
        Self {
            w: camera.width_px,
            h: camera.height_px,
            fl_x: camera.fl_x_px,
            fl_y: camera.fl_y_px,
            cx: camera.cx_px,
            cy: camera.cy_px,
            camera_angle_x: 2.0 * (f64::from(camera.width_px) / 2.0 / camera.fl_x_px).atan(),
        }
    }
}

#[derive(Serialize)]
struct TransformsFile<'a> {
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    intrinsics: Option<Intrinsics>,
    frames: Vec<FrameFile<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    scenario: Option<ScenarioFile<'a>>,
}

#[derive(Serialize)]
struct FrameFile<'a> {
    file_path: &'a str,
    transform_matrix: &'a [[f64; 4]; 4],
    #[serde(skip_serializing_if = "Option::is_none")]
    scene_id: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    branch: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    timestamp: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    view_id: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    observability: Option<Observability>,
    #[serde(skip_serializing_if = "Option::is_none")]
    visible_fraction: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    actor_px: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    alike_states: Option<&'a [usize]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    view_kind: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_file_path: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask_path: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask_file_path: Option<&'a str>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    intrinsics: Option<Intrinsics>,
}

#[derive(Serialize)]
struct ScenarioFile<'a> {
    name: &'a str,
    units: &'static str,
    up: &'static str,
    bounds: [[f64; 3]; 2],
    branches: &'a [String],
    timestamps: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    step_s: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    bev_view: Option<usize>,
    states: Vec<StateFile<'a>>,
    hazard_branches: &'a [usize],
    #[serde(skip_serializing_if = "is_zero")]
    hazard_from_timestamp: usize,
    actions: Actions<'a>,
    candidates: &'a [Candidate],
    static_boxes: &'a [NamedBox],
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_zero(number: &usize) -> bool {
    *number == 0
}

#[derive(Serialize)]
struct StateFile<'a> {
    scene_id: usize,
    branch: usize,
    timestamp: usize,
    boxes: &'a [NamedBox],
}

#[derive(Serialize)]
struct Actions<'a> {
    hazard: &'a str,
    clear: &'a str,
}

impl<'a> ScenarioFile<'a> {
    fn of(scenario: &'a ScenarioInfo) -> Self {
        Self {
            name: &scenario.name,
            units: "metres",
            up: "+Z",
            bounds: scenario.bounds,
            branches: &scenario.branches,
            timestamps: scenario.timestamps,
            step_s: scenario.step_s,
            bev_view: scenario.bev_view,
            states: scenario
                .states
                .iter()
                .enumerate()
                .map(|(scene_id, s)| StateFile { scene_id, branch: s.branch, timestamp: s.timestamp, boxes: &s.boxes })
                .collect(),
            hazard_branches: &scenario.hazard_branches,
            hazard_from_timestamp: scenario.hazard_from_timestamp,
            actions: Actions { hazard: &scenario.hazard_action, clear: &scenario.clear_action },
            candidates: &scenario.candidates,
            static_boxes: &scenario.static_boxes,
        }
    }
}
