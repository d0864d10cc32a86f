//! The table of the camera: the source of its images, their calibration, and their pose.

use crate::ConfigError;
use crate::error::Source;
use carff_dataset::sensor::SensorNoise;
use carff_dataset::{CalibrationError, CameraCalibration};
use schemars::JsonSchema;
use serde::de::value::MapAccessDeserializer;
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::PathBuf;

/// The source of camera images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CameraSource {
    /// Drives through a dataset.
    #[default]
    Drives,
    /// Drives through the scenario itself (`run.scenario`), rendered during the run. The ego moves, and no pose is a
    /// pose of the dataset.
    FreeDrives,
    /// The images of a folder, in the order of their names.
    Folder,
    /// Another process, in any language, publishes the frames.
    External,
    /// The images of an MCAP recording (`camera.file`): of ROS 2 or Foxglove.
    Mcap,
    /// An MP4 file with H.264 video (`camera.file`).
    Video,
    /// A network camera (`camera.url`). Its program is built by `make camera-rtsp`.
    Rtsp,
    /// A `GStreamer` pipeline (`camera.pipeline`). Its program is built by `make camera-gst`.
    Pipeline,
}

impl CameraSource {
    /// Returns true if the frames come from a dataset or a scenario, so that their truth is known.
    pub fn has_truth(self) -> bool {
        matches!(self, Self::Drives | Self::FreeDrives)
    }

    /// Name of the program of the camera stage; `None` if another process publishes the frames.
    pub fn program(self) -> Option<&'static str> {
        match self {
            Self::External => None,
            Self::Rtsp => Some("carff-camera-rtsp"),
            Self::Pipeline => Some("carff-camera-gst"),
            _ => Some("carff-camera"),
        }
    }
}

/// The poses that drives are taken from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PoseChoice {
    /// Training poses, without the calibration poses.
    #[default]
    Trained,
    /// Held-out poses, which training never saw.
    Unseen,
}

/// The times of recorded images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FramePace {
    /// As they were recorded.
    #[default]
    Recorded,
    /// At `run.frame_rate_hz`.
    FrameRate,
}

/// A pose: four rows of four numbers, as `transform_matrix` in a dataset. The camera's axes are OpenGL's (x right, y
/// up, -z forward), and metres.
pub type Pose = [[f64; 4]; 4];

/// The calibration of a camera: a table of the graph file, or the path of a ROS `camera_info` YAML file.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum CalibrationChoice {
    /// Path of the file.
    File(PathBuf),
    /// The values.
    Table(CameraCalibration),
}

impl<'de> Deserialize<'de> for CalibrationChoice {
    /// Reads a text as a path and a table as values, so that errors name the table's keys.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Choice;
        impl<'de> Visitor<'de> for Choice {
            type Value = CalibrationChoice;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("the path of a camera_info file, or a table")
            }

            fn visit_str<E>(self, path: &str) -> Result<CalibrationChoice, E> {
                Ok(CalibrationChoice::File(path.into()))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<CalibrationChoice, A::Error> {
                CameraCalibration::deserialize(MapAccessDeserializer::new(map)).map(CalibrationChoice::Table)
            }
        }
        deserializer.deserialize_any(Choice)
    }
}

/// The images that the camera stage publishes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CameraConfig {
    /// `drives` through the dataset, `free-drives` through the scenario, the images of a `folder`, another process
    /// (`external`), a recording (`mcap`), a film (`video`), a network camera (`rtsp`), or a `GStreamer` pipeline.
    /// Default `drives`.
    pub source: CameraSource,
    /// The folder, when `source` is `folder`. Default: `images` in the dataset.
    pub folder: Option<PathBuf>,
    /// The recording or the film, when `source` is `mcap` or `video`. A folder stands for the recordings in it.
    pub file: Option<PathBuf>,
    /// The channel of the images, when `source` is `mcap`. Default: the only one with images.
    pub topic: Option<String>,
    /// Address of the network camera, when `source` is `rtsp`, for example `rtsp://user:password@10.0.0.7/stream`.
    pub url: Option<String>,
    /// `GStreamer` pipeline, when `source` is `pipeline`. It ends in an `appsink`, which the stage configures.
    pub pipeline: Option<String>,
    /// Times of the frames, when `source` is `mcap` or `video`: as `recorded`, or at the `frame-rate` of the run.
    /// Default `recorded`.
    pub pace: FramePace,
    /// Calibration of a real camera: the path of a ROS `camera_info` YAML file, or a table. Images are rectified, cropped
    /// and scaled to the field of view that the checkpoint was trained for. Default: images are used unchanged.
    pub calibration: Option<CalibrationChoice>,
    /// Pose of a fixed camera in the world. Default: the origin.
    pub world_from_camera: Option<Pose>,
    /// Pose of the camera on the vehicle; the vehicle's pose comes from the topic `ego/pose`, and is the origin until the
    /// first one. Default: none.
    pub vehicle_from_camera: Option<Pose>,
    /// Drives, half of them with the hazard, 1 to 100000. Default 60.
    #[schemars(range(min = 1, max = 100_000))]
    pub drives: u32,
    /// Frames per time step of a drive, 1 to 1000. Default 6.
    #[schemars(range(min = 1, max = 1000))]
    pub frames_per_timestamp: u32,
    /// Sensor noise, drawn anew for each frame of a dataset, a scenario or a folder.
    pub noise: SensorNoise,
    /// The poses that `drives` are taken from: `trained` (the paper's setting) or `unseen`. Default `trained`.
    pub poses: PoseChoice,
    /// Seed of the split into trained and held-out poses. Default: the seed that the checkpoint records.
    pub split_seed: Option<u64>,
    /// Starts again at the end until the run is stopped. Free drives continue with new drives instead. Default false.
    pub repeat: bool,
    /// Time that the stage waits after the last frame, so that the other stages can finish it, milliseconds, 0 to
    /// 60000. Default 500.
    #[schemars(range(min = 0, max = 60_000))]
    pub linger_ms: u64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            source: CameraSource::Drives,
            folder: None,
            file: None,
            topic: None,
            url: None,
            pipeline: None,
            pace: FramePace::Recorded,
            calibration: None,
            world_from_camera: None,
            vehicle_from_camera: None,
            drives: 60,
            frames_per_timestamp: 6,
            noise: SensorNoise::default(),
            poses: PoseChoice::Trained,
            split_seed: None,
            repeat: false,
            linger_ms: 500,
        }
    }
}

impl CameraConfig {
    /// Reports whether two images of a still scene differ: by the noise that the stage adds, or by a real sensor's.
    pub fn has_noise(&self) -> bool {
        match self.source {
            CameraSource::Drives | CameraSource::FreeDrives | CameraSource::Folder => self.noise.sigma > 0.0,
            _ => true,
        }
    }

    /// Returns the paths of the table.
    pub(crate) fn paths_mut(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let calibration = match &mut self.calibration {
            Some(CalibrationChoice::File(path)) => Some(path),
            _ => None,
        };
        self.folder.iter_mut().chain(&mut self.file).chain(calibration)
    }

    /// Checks the rules that a single range cannot express.
    pub(crate) fn check(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        let needed = match self.source {
            CameraSource::Mcap if self.file.is_none() => Some(("mcap", "camera.file", "the recording")),
            CameraSource::Video if self.file.is_none() => Some(("video", "camera.file", "the MP4 file")),
            CameraSource::Rtsp if self.url.is_none() => Some(("rtsp", "camera.url", "the camera's address")),
            CameraSource::Pipeline if self.pipeline.is_none() => {
                Some(("pipeline", "camera.pipeline", "the GStreamer pipeline"))
            }
            _ => None,
        };
        if let Some((name, key, what)) = needed {
            let allowed = format!("`{name}` with `{key}`, {what}");
            return Err(source.range("camera.source", format!("\"{name}\""), allowed));
        }
        if self.calibration.is_some() && (self.source.has_truth() || self.source == CameraSource::External) {
            let allowed = "no calibration for `drives` and `free-drives`, which need none, and `external`, whose process \
                           rectifies its images itself";
            return Err(source.range("camera.calibration", "set".to_owned(), allowed.to_owned()));
        }
        if let Some(CalibrationChoice::Table(table)) = &self.calibration {
            table.check().map_err(|error| match error {
                CalibrationError::Value { key, value, allowed } => {
                    source.range(&format!("camera.calibration.{key}"), value, allowed.to_owned())
                }
                other => source.range("camera.calibration", other.to_string(), "a valid calibration".to_owned()),
            })?;
        }
        if self.world_from_camera.is_some() && self.vehicle_from_camera.is_some() {
            let allowed = "either this or `camera.world_from_camera`".to_owned();
            return Err(source.range("camera.vehicle_from_camera", "set".to_owned(), allowed));
        }
        for (key, pose) in [
            ("camera.world_from_camera", &self.world_from_camera),
            ("camera.vehicle_from_camera", &self.vehicle_from_camera),
        ] {
            if let Some(pose) = pose.as_ref().filter(|pose| !carff_base::geometry::is_rigid(pose)) {
                let allowed = "four rows of four numbers: a rotation and a translation over the row 0 0 0 1";
                return Err(source.range(key, format!("{pose:?}"), allowed.to_owned()));
            }
        }
        Ok(())
    }
}
