//! Runs as MCAP files: writing them while a graph runs, reading them back message by message, and the well-known
//! robotics schemas that other tools know images, calibrations and boxes by.
//!
//! A recording holds each message's form ([`carff_messages::forms`]) as JSON on the channel of its topic, with its JSON Schema;
//! besides, for other tools, `camera/image` and `renderer/image` (`foxglove.RawImage`, which also carry the images),
//! `camera/calibration` (`foxglove.CameraCalibration`), `camera/pose` (`foxglove.FrameTransform`) and `prober/boxes`
//! (`foxglove.SceneUpdate`), all protobuf. Log times are wall-clock times; the monotonic times are in the forms' headers.
//! The run, its graph file and its folders are in the metadata record `carff`.

mod about;
mod channels;
mod queue;
mod reader;
mod rotation;
mod standard;
mod writer;

pub use about::About;
pub use channels::{Channel, channels, encode};
pub use queue::{QueueCounts, RecordingQueue};
pub use reader::{Entry, Reader};
pub use rotation::{Limits, RotatingWriter};
pub use standard::{StandardMessage, standard_messages};
pub use writer::Writer;

use carff_messages::forms::FormError;
use std::path::PathBuf;

/// Why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be opened, read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no recording, or is damaged.
    #[error("{path} is damaged, or no MCAP file: {cause}")]
    Mcap {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        cause: String,
    },
    /// The file is an MCAP file, but not one of this program's.
    #[error("{path} is no recording of this program: it has no metadata `carff`")]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// A message of it cannot be read.
    #[error("{path}, channel `{channel}`, message {sequence}: {cause}")]
    Message {
        /// The file.
        path: PathBuf,
        /// The channel.
        channel: String,
        /// The message's number on its topic.
        sequence: u32,
        /// What is wrong.
        cause: String,
    },
    /// The output is there already.
    #[error("{path} exists: give another name, or remove it")]
    Exists {
        /// The file.
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

impl From<FormError> for MessageError {
    fn from(error: FormError) -> Self {
        Self(error.to_string())
    }
}

/// Why one message cannot be read.
struct MessageError(String);

#[cfg(test)]
mod tests;
