//! The forms of image descriptions.

use super::{FormError, array, code_of, index, name_of, signed};
use crate::{DatasetView, FrameMeta, Header, Intrinsics, Message, Observability, ViewKind, ViewMeta};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Position of a frame in a dataset.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DatasetViewForm {
    /// Index of the camera pose.
    pub view: Option<u32>,
    /// The hidden branch.
    pub branch: Option<u32>,
    /// Time step of the branch.
    pub timestamp: Option<u32>,
    /// Number of the drive in this run.
    pub drive: Option<u32>,
    /// Number of earlier frames of this drive.
    pub frame_in_drive: Option<u32>,
    /// Visibility of the actor or its place: `unknown`, `none`, `partial` or `full`.
    pub observability: String,
    /// True for the last frame of a time step, whose decision is counted.
    pub last_of_timestamp: bool,
}

/// Describes a camera frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FrameForm {
    /// Header, at step 0.
    pub header: Header,
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Intrinsics for this width and height.
    pub intrinsics: Intrinsics,
    /// Row-major 4x4: camera space (OpenGL axes) to world space (metres).
    pub world_from_camera: Vec<f64>,
    /// Number of the take's first frame.
    pub take_start: u64,
    /// Position in a dataset, if known.
    pub dataset_view: Option<DatasetViewForm>,
}

/// Name of an unknown observability.
const UNKNOWN: &str = "unknown";

fn observability_name(code: i32) -> String {
    Observability::try_from(code).map_or(UNKNOWN, Observability::name).to_owned()
}

fn observability_code(name: &String) -> Result<i32, FormError> {
    if name == UNKNOWN {
        Ok(Observability::UNKNOWN)
    } else {
        code_of!(Observability, "dataset_view.observability", name)
    }
}

impl From<&FrameMeta> for FrameForm {
    fn from(meta: &FrameMeta) -> Self {
        let view = &meta.dataset_view;
        Self {
            header: meta.header,
            width_px: meta.width_px,
            height_px: meta.height_px,
            intrinsics: meta.intrinsics,
            world_from_camera: meta.world_from_camera.to_vec(),
            take_start: meta.take_start,
            dataset_view: view.is_known().then(|| DatasetViewForm {
                view: index(view.view),
                branch: index(view.branch),
                timestamp: index(view.timestamp),
                drive: index(view.drive),
                frame_in_drive: index(view.frame_in_drive),
                observability: observability_name(view.observability),
                last_of_timestamp: view.is_last_of_timestamp(),
            }),
        }
    }
}

impl TryFrom<&FrameForm> for FrameMeta {
    type Error = FormError;

    fn try_from(form: &FrameForm) -> Result<Self, FormError> {
        let dataset_view = match &form.dataset_view {
            None => DatasetView::UNKNOWN,
            Some(view) => DatasetView {
                known: 1,
                view: signed(view.view),
                branch: signed(view.branch),
                timestamp: signed(view.timestamp),
                drive: signed(view.drive),
                frame_in_drive: signed(view.frame_in_drive),
                observability: observability_code(&view.observability)?,
                last_of_timestamp: view.last_of_timestamp.into(),
            },
        };
        let meta = Self {
            header: form.header,
            width_px: form.width_px,
            height_px: form.height_px,
            intrinsics: form.intrinsics,
            world_from_camera: array("world_from_camera", &form.world_from_camera)?,
            dataset_view,
            take_start: form.take_start,
        };
        meta.validate()?;
        Ok(meta)
    }
}

/// Describes a rendered view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ViewForm {
    /// Header, at the step of the hypothesis.
    pub header: Header,
    /// Index of the sample or component that it shows.
    pub hypothesis: u32,
    /// `birds-eye` or `free`.
    pub kind: String,
    /// The state that probing found, if it is a known one.
    pub state: Option<u32>,
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Probability of this hypothesis.
    pub probability: f32,
    /// The latent that it was rendered from.
    pub latent: Vec<f32>,
    /// Intrinsics for this width and height.
    pub intrinsics: Intrinsics,
    /// Row-major 4x4: camera space (OpenGL axes) to world space (metres).
    pub world_from_camera: Vec<f64>,
    /// Duration of the rendering, nanoseconds.
    pub stage_latency_ns: u64,
}

impl From<&ViewMeta> for ViewForm {
    fn from(meta: &ViewMeta) -> Self {
        Self {
            header: meta.header,
            hypothesis: meta.hypothesis,
            kind: name_of!(ViewKind, meta.kind),
            state: index(meta.state),
            width_px: meta.width_px,
            height_px: meta.height_px,
            probability: meta.probability,
            latent: meta.latent.to_vec(),
            intrinsics: meta.intrinsics,
            world_from_camera: meta.world_from_camera.to_vec(),
            stage_latency_ns: meta.stage_latency_ns,
        }
    }
}

impl TryFrom<&ViewForm> for ViewMeta {
    type Error = FormError;

    fn try_from(form: &ViewForm) -> Result<Self, FormError> {
        let meta = Self {
            header: form.header,
            hypothesis: form.hypothesis,
            kind: code_of!(ViewKind, "kind", form.kind)?,
            state: signed(form.state),
            width_px: form.width_px,
            height_px: form.height_px,
            probability: form.probability,
            latent: array("latent", &form.latent)?,
            intrinsics: form.intrinsics,
            world_from_camera: array("world_from_camera", &form.world_from_camera)?,
            stage_latency_ns: form.stage_latency_ns,
        };
        meta.validate()?;
        Ok(meta)
    }
}
