//! Recordings of runs as MCAP files: writing while a graph runs, reading message by message, and the standard robotics
//! schemas of images, calibrations and boxes for other tools.
//!
//! A recording contains each message's form ([`carff_messages::forms`]) as JSON on the channel of its topic, with its
//! JSON Schema. It also contains protobuf channels for other tools: `camera/image` and `renderer/image`
//! (`foxglove.RawImage`, which also store the images), `camera/calibration` (`foxglove.CameraCalibration`),
//! `camera/pose` (`foxglove.FrameTransform`) and `prober/boxes` (`foxglove.SceneUpdate`). Log times are wall-clock
//! times; the forms' headers contain the monotonic times. The metadata record `carff` contains the run, its graph file
//! and its folders.

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

/// Reason why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be opened, read or written.
    #[error("{path}: {source}")]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file is not an MCAP file, or is damaged.
    #[error("{path} is damaged, or is not an MCAP file: {cause}")]
    Mcap {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error.
        cause: String,
    },
    /// The file is an MCAP file of another program.
    #[error("{path} is not a recording of this program: it has no metadata `carff`")]
    Foreign {
        /// Path of the file.
        path: PathBuf,
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

impl From<FormError> for MessageError {
    fn from(error: FormError) -> Self {
        Self(error.to_string())
    }
}

/// Reason why a message cannot be read.
struct MessageError(String);

#[cfg(test)]
mod tests;
