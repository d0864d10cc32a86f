//! Recordings of runs as MCAP files: writing while a graph runs, reading message by message, and the standard robotics
//! schemas of images, calibrations and boxes for other tools.
//!
//! A recording contains each message's form ([`carff_messages::forms`]) as JSON on the channel of its topic, with its
//! JSON Schema. It also contains protobuf channels for other tools:
//!
//! | channel | schema | content |
//! |---|---|---|
//! | `camera/image`, `renderer/CAMERA/stepN/hypothesisM/image` | `foxglove.RawImage` | images, stored only here |
//! | `camera/calibration`, `renderer/CAMERA/calibration` | `foxglove.CameraCalibration` | intrinsics |
//! | `camera/pose`, `renderer/CAMERA/pose` | `foxglove.FrameTransform` | world space from camera space |
//! | `prober/boxes/stepN` | `foxglove.SceneUpdate` | the probed places, with their probability |
//! | `log` | `foxglove.Log` | changes of a stage's health and of the action, and the lines of the run's log |
//!
//! Log times are the wall-clock times of publication. Stamps in protobuf messages are the wall-clock times of capture;
//! of a log entry, that of publication. The forms' headers contain the monotonic times. The metadata record `carff`
//! contains the run, its graph file, its folders and its origin.

mod about;
mod bag;
mod cdr;
mod channels;
mod images;
mod queue;
mod reader;
mod rotation;
mod standard;
mod summary;
mod transforms;
mod writer;

pub use about::RecordingAbout;
pub use channels::{Encoded, Format, MessageEncoder};
pub use images::{ImageError, ImageOrigin, ImageReader};
pub use queue::{QueueCounts, RecordingQueue};
pub use reader::{Entry, Reader};
pub use rotation::{RotatingWriter, RotationLimits};
pub use standard::LogLine;
pub use transforms::Transforms;
pub use writer::Writer;

use carff_messages::forms::FormError;
use std::path::PathBuf;

/// Reason why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be opened, read or written.
    #[error("{path}: {source}; check that the path is right, who may read and write it, and the free space")]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file is not an MCAP file, or is damaged.
    #[error("{path} is damaged, or is not an MCAP file: {cause}; record it again, or repair it with `mcap recover`")]
    Mcap {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        cause: String,
    },
    /// The file is an MCAP file of another program.
    #[error(
        "{path} is not a recording of this program: it has neither its metadata nor its topics; its topics: {channels}"
    )]
    Foreign {
        /// Path of the file.
        path: PathBuf,
        /// Topics of the file.
        channels: String,
    },
    /// The recording has another format.
    #[error("{path} is a recording in another format: read it with the version of `carff` that wrote it")]
    Format {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file has messages of several runs, whose frames have the same numbers.
    #[error("{path} has messages of two runs ({:016x} and {:016x}): use their recordings from before the merge", run_ids[0], run_ids[1])]
    Runs {
        /// Path of the file.
        path: PathBuf,
        /// Ids of the first run, and of the other one.
        run_ids: [u64; 2],
    },
    /// Topics are missing.
    #[error("{path} has no messages on `{missing}`; its topics: {present}")]
    Missing {
        /// Path of the file.
        path: PathBuf,
        /// Names of the missing topics.
        missing: String,
        /// Topics of the file.
        present: String,
    },
    /// No channel contains images.
    #[error(
        "{path} contains no images that this program reads; {channels}. It reads sensor_msgs/msg/Image and \
         CompressedImage of ROS 2 in CDR, and foxglove.RawImage and CompressedImage in protobuf"
    )]
    NoImages {
        /// Path of the file or folder.
        path: PathBuf,
        /// Channels of the file.
        channels: String,
    },
    /// Several channels contain images.
    #[error("{path} has images on several channels: name one with `camera.topic`: `{channels}`")]
    SeveralImages {
        /// Path of the file or folder.
        path: PathBuf,
        /// Names of these channels.
        channels: String,
    },
    /// The named channel contains no images.
    #[error("{path} has no images on `{topic}`; its channels with images: `{channels}`")]
    NoSuchImages {
        /// Path of the file or folder.
        path: PathBuf,
        /// Name of the channel.
        topic: String,
        /// Names of the channels with images.
        channels: String,
    },
    /// The calibration in the recording cannot be used.
    #[error("{path}: its calibration cannot be used: {cause}; set `camera.calibration`")]
    Calibration {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        cause: String,
    },
    /// The file has no poses of the camera.
    #[error("{path}: no pose of the camera frame `{frame}` is known; {found}")]
    Poses {
        /// Path of the file or folder.
        path: PathBuf,
        /// Coordinate frame of the images.
        frame: String,
        /// The poses and transforms that the file has.
        found: String,
    },
    /// A message of the file cannot be read.
    #[error("{path}, channel `{channel}`, message {sequence}: {cause}")]
    Message {
        /// Path of the file.
        path: PathBuf,
        /// Name of the channel.
        channel: String,
        /// Number of the message on its topic.
        sequence: u32,
        /// Description of the error.
        cause: String,
    },
    /// The output file exists.
    #[error("{path} exists: use another name, or remove it")]
    Exists {
        /// Path of the file.
        path: PathBuf,
    },
}

impl RecordingError {
    fn mcap(path: &std::path::Path, error: mcap::McapError) -> Self {
        match error {
            mcap::McapError::Io(source) => Self::Io { path: path.to_owned(), source },
            error => Self::Mcap { path: path.to_owned(), cause: error.to_string() },
        }
    }
}

impl From<carff_dataset::RawError> for MessageError {
    fn from(error: carff_dataset::RawError) -> Self {
        Self(error.to_string())
    }
}

impl From<FormError> for MessageError {
    fn from(error: FormError) -> Self {
        Self(error.to_string())
    }
}

/// Reason why a message cannot be read.
struct MessageError(String);

#[cfg(test)]
mod tests;
