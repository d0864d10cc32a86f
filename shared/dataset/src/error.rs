//! What can be wrong with a set, and where.

use std::path::PathBuf;

/// Why a set cannot be read or written. Each message names the file, and inside it the frame and the key.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder does not exist or is a file.
    #[error("{}: not a folder; a dataset is a folder with transforms.json and its images", path.display())]
    NotAFolder {
        /// The folder asked for.
        path: PathBuf,
    },
    /// The folder holds no transforms file.
    #[error(
        "{}: holds none of transforms.json, transforms_train.json, transforms_val.json, transforms_test.json",
        path.display()
    )]
    NoTransforms {
        /// The folder asked for.
        path: PathBuf,
    },
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file beyond the limits.
    #[error("{}: {bytes} bytes, at most {limit} are allowed", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// Not JSON. The source names line and column.
    #[error("{}: not valid JSON: {source}", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The parser's reason.
        source: serde_json::Error,
    },
    /// A key is missing, of the wrong type, out of range, or in conflict with another.
    #[error("{}: {place}: key `{key}`: {problem}", path.display())]
    Key {
        /// The transforms file.
        path: PathBuf,
        /// Where in the file, as in `frame 3 (images/b0_t0_v003.png)` or `scenario.states[2]`.
        place: String,
        /// The key.
        key: String,
        /// What is wrong and what is allowed.
        problem: String,
    },
    /// An image that is missing, broken, of another type or of another size than its intrinsics say.
    #[error("{}: {problem}", path.display())]
    Image {
        /// The image.
        path: PathBuf,
        /// What is wrong and what is allowed.
        problem: String,
    },
    /// A frame index that the set does not have.
    #[error("frame {index} does not exist; the set has {count} frames")]
    NoSuchFrame {
        /// Index asked for.
        index: usize,
        /// Frames in the set.
        count: usize,
    },
    /// A folder that must not be overwritten.
    #[error(
        "{}: not empty and not a set that this program wrote; give an empty folder or another name",
        path.display()
    )]
    NotOurs {
        /// The folder.
        path: PathBuf,
    },
}
