//! Descriptions of images: the camera's frames and the renderer's views. The bytes are in the payload.

use crate::check::{at_most, finite, finite_f64, in_range, within};
use crate::{
    Header, ImageMeta, Invalid, LATENT_DIM, MAX_IMAGE_BYTES, MAX_SAMPLES, MAX_SIDE_PX, MAX_STATES, Observability,
    ViewKind, message,
};
use iceoryx2::prelude::ZeroCopySend;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// An ideal pinhole camera's intrinsics, pixels.
///
/// ```
/// use carff_messages::Intrinsics;
/// // 128 x 128 pixels with a field of view of 90 degrees.
/// let intrinsics = Intrinsics { fl_x_px: 64.0, fl_y_px: 64.0, cx_px: 64.0, cy_px: 64.0 };
/// // A point 2 m ahead and 1 m to the right is in column 96.
/// assert_eq!(intrinsics.cx_px + intrinsics.fl_x_px * 1.0 / 2.0, 96.0);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[type_name("carff.Intrinsics.v1")]
pub struct Intrinsics {
    /// Focal length along x.
    pub fl_x_px: f64,
    /// Focal length along y.
    pub fl_y_px: f64,
    /// Principal point, x.
    pub cx_px: f64,
    /// Principal point, y.
    pub cy_px: f64,
}

impl Intrinsics {
    fn check(&self) -> Result<(), Invalid> {
        finite_f64("intrinsics", [&self.fl_x_px, &self.fl_y_px, &self.cx_px, &self.cy_px])?;
        for value in [self.fl_x_px, self.fl_y_px] {
            if value <= 0.0 {
                return Err(Invalid::OutOfRange {
                    field: "intrinsics.fl_px",
                    value,
                    min: f64::MIN_POSITIVE,
                    max: f64::MAX,
                });
            }
        }
        Ok(())
    }
}

/// Position of a frame in a dataset: the truth, only for reports. No stage of the decision path reads it.
///
/// ```
/// use carff_messages::DatasetView;
/// let view = DatasetView { known: 1, view: 61, branch: 0, timestamp: 2, ..DatasetView::UNKNOWN };
/// assert!(view.is_known() && !DatasetView::UNKNOWN.is_known());
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("carff.DatasetView.v1")]
pub struct DatasetView {
    /// 1 if the other fields are known, else 0.
    pub known: u32,
    /// Index of the camera pose.
    pub view: i32,
    /// The hidden branch.
    pub branch: i32,
    /// Time step of the branch.
    pub timestamp: i32,
    /// Number of the drive in this run.
    pub drive: i32,
    /// Number of earlier frames of this drive.
    pub frame_in_drive: i32,
    /// Code of an [`Observability`].
    pub observability: i32,
    /// 1 for the last frame of a time step, whose decision is counted; else 0.
    pub last_of_timestamp: u32,
}

impl DatasetView {
    /// Value of a frame without a dataset.
    pub const UNKNOWN: Self = Self {
        known: 0,
        view: -1,
        branch: -1,
        timestamp: -1,
        drive: -1,
        frame_in_drive: -1,
        observability: -1,
        last_of_timestamp: 0,
    };

    /// Reports whether the rest is known.
    pub fn is_known(&self) -> bool {
        self.known == 1
    }

    /// Reports whether this is the last frame of a time step, when a decision on it counts.
    pub fn is_last_of_timestamp(&self) -> bool {
        self.last_of_timestamp == 1
    }

    fn check(&self) -> Result<(), Invalid> {
        at_most("dataset_view.known", self.known.into(), 1)?;
        at_most("dataset_view.last_of_timestamp", self.last_of_timestamp.into(), 1)?;
        Observability::of_code(self.observability)?;
        for (field, value) in [
            ("dataset_view.view", self.view),
            ("dataset_view.branch", self.branch),
            ("dataset_view.timestamp", self.timestamp),
            ("dataset_view.drive", self.drive),
            ("dataset_view.frame_in_drive", self.frame_in_drive),
        ] {
            in_range(field, value.into(), -1, i32::MAX.into())?;
        }
        Ok(())
    }
}

/// Describes a camera frame: RGB, 8 bit, rows from the top (height x width x 3 bytes).
///
/// ```
/// use carff_messages::{DatasetView, FrameMeta, Header, ImageMeta, Intrinsics, Message};
/// let meta = FrameMeta {
///     header: Header::of_frame(7, 1_000, 42),
///     width_px: 128,
///     height_px: 96,
///     intrinsics: Intrinsics { fl_x_px: 110.0, fl_y_px: 110.0, cx_px: 64.0, cy_px: 48.0 },
///     // The camera is 1.6 m above the origin and looks along -z.
///     world_from_camera: [
///         1.0, 0.0, 0.0, 0.0, //
///         0.0, 1.0, 0.0, 1.6, //
///         0.0, 0.0, 1.0, 0.0, //
///         0.0, 0.0, 0.0, 1.0,
///     ],
///     dataset_view: DatasetView::UNKNOWN,
///     take_start: 0,
/// };
/// assert!(meta.validate().is_ok());
/// assert_eq!(meta.image_bytes(), 128 * 96 * 3);
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("carff.FrameMeta.v2")]
pub struct FrameMeta {
    /// Header, at step 0.
    pub header: Header,
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Intrinsics for this width and height.
    pub intrinsics: Intrinsics,
    /// Row-major 4x4: camera space (OpenGL axes) to world space (metres).
    pub world_from_camera: [f64; 16],
    /// Position in a dataset, for reports.
    pub dataset_view: DatasetView,
    /// Number of the take's first frame. The frames of a take follow each other without a cut: a memory of earlier
    /// frames holds within a take only.
    pub take_start: u64,
}

impl FrameMeta {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        image_size(self.width_px, self.height_px)?;
        self.intrinsics.check()?;
        finite_f64("world_from_camera", &self.world_from_camera)?;
        at_most("take_start", self.take_start, self.header.frame_id)?;
        self.dataset_view.check()
    }
}

message!(FrameMeta);

impl ImageMeta for FrameMeta {
    fn size_px(&self) -> [u32; 2] {
        [self.width_px, self.height_px]
    }
}

/// Describes a rendered view: RGB, 8 bit, rows from the top (height x width x 3 bytes).
///
/// ```
/// use carff_messages::{Header, ImageMeta, Intrinsics, Message, ViewKind, ViewMeta};
/// let header = Header::of_frame(7, 1_000, 42).at_step(1);
/// let intrinsics = Intrinsics { fl_x_px: 60.0, fl_y_px: 60.0, cx_px: 32.0, cy_px: 24.0 };
/// let kind = ViewKind::ALL[0].code();
/// let view = ViewMeta { header, kind, state: 2, width_px: 64, height_px: 48, intrinsics, ..ViewMeta::default() };
/// assert_eq!((view.validate(), view.image_bytes()), (Ok(()), 64 * 48 * 3));
/// ```
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("carff.ViewMeta.v1")]
pub struct ViewMeta {
    /// Header, at the step of the hypothesis.
    pub header: Header,
    /// Index of the sample or component that it shows.
    pub hypothesis: u32,
    /// Code of a [`ViewKind`].
    pub kind: u32,
    /// The state that probing found; -1 for none of the known ones.
    pub state: i32,
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Probability of this hypothesis, 0..=1.
    pub probability: f32,
    /// The latent that it was rendered from.
    pub latent: [f32; LATENT_DIM],
    /// Intrinsics for this width and height.
    pub intrinsics: Intrinsics,
    /// Row-major 4x4: camera space (OpenGL axes) to world space (metres).
    pub world_from_camera: [f64; 16],
    /// Duration of the rendering, nanoseconds.
    pub stage_latency_ns: u64,
}

impl ViewMeta {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        at_most("hypothesis", self.hypothesis.into(), MAX_SAMPLES as u64)?;
        ViewKind::try_from(self.kind)?;
        in_range("state", self.state.into(), -1, MAX_STATES as i64 - 1)?;
        image_size(self.width_px, self.height_px)?;
        within("probability", [&self.probability], 0.0, 1.0)?;
        finite("latent", &self.latent)?;
        self.intrinsics.check()?;
        finite_f64("world_from_camera", &self.world_from_camera)
    }
}

message!(ViewMeta);

impl ImageMeta for ViewMeta {
    fn size_px(&self) -> [u32; 2] {
        [self.width_px, self.height_px]
    }
}

fn image_size(width_px: u32, height_px: u32) -> Result<(), Invalid> {
    in_range("width_px", width_px.into(), 1, MAX_SIDE_PX.into())?;
    in_range("height_px", height_px.into(), 1, MAX_SIDE_PX.into())?;
    at_most("width_px * height_px * 3", u64::from(width_px) * u64::from(height_px) * 3, MAX_IMAGE_BYTES as u64)
}
