//! Errors of reading and writing datasets.

use std::path::PathBuf;

/// Reason why a dataset cannot be read or written. Each message names the file, and inside it the frame and the key.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder does not exist or is a file.
    #[error("{}: not a folder; a dataset is a folder with transforms.json and its images", path.display())]
    NotAFolder {
        /// The requested folder.
        path: PathBuf,
    },
    /// The folder has no transforms file.
    #[error(
        "{}: contains none of transforms.json, transforms_train.json, transforms_val.json, transforms_test.json; name a \
         folder that does, or make one with `carff dataset render` or `import`",
        path.display()
    )]
    NoTransforms {
        /// The requested folder.
        path: PathBuf,
    },
    /// The operating system reported an error.
    #[error(
        "{}: {source}; check that the path is right, who may read and write it, and the free space",
        path.display()
    )]
    Io {
        /// Path of the file or folder.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A file exceeds the limit.
    #[error("{}: {bytes} bytes, at most {limit} are allowed; split the dataset, or scale its images", path.display())]
    TooLarge {
        /// Path of the file.
        path: PathBuf,
        /// Size of the file.
        bytes: u64,
        /// Maximum size.
        limit: u64,
    },
    /// The file is not JSON. The source names line and column.
    #[error("{}: not valid JSON: {source}; correct the file, or make it again", path.display())]
    Json {
        /// Path of the file.
        path: PathBuf,
        /// Error of the parser.
        source: serde_json::Error,
    },
    /// A key is missing, of the wrong type, out of range, or in conflict with another one.
    #[error("{}: {place}: key `{key}`: {problem}", path.display())]
    Key {
        /// Path of the transforms file.
        path: PathBuf,
        /// Place in the file, as in `frame 3 (images/b0_t0_v003.png)` or `scenario.states[2]`.
        place: String,
        /// Name of the key.
        key: String,
        /// The error and the allowed values.
        problem: String,
    },
    /// An image is missing, broken, of another type, or of another size than its intrinsics.
    #[error("{}: {problem}", path.display())]
    Image {
        /// Path of the image.
        path: PathBuf,
        /// The error and the allowed values.
        problem: String,
    },
    /// Several images or masks are missing or broken.
    #[error("{} images or masks cannot be used:{}", .0.len(), listed(.0))]
    Several(Vec<DatasetError>),
    /// The dataset has no frame of this index.
    #[error("frame {index} does not exist; the dataset has {count} frames, counted from 0")]
    NoSuchFrame {
        /// Requested index.
        index: usize,
        /// Number of frames in the dataset.
        count: usize,
    },
    /// The folder must not be overwritten.
    #[error(
        "{}: not empty and not a dataset that this program wrote; use an empty folder or another name",
        path.display()
    )]
    NotOurs {
        /// Path of the folder.
        path: PathBuf,
    },
}

impl DatasetError {
    /// Returns `Ok` without errors, and an error that lists them otherwise.
    pub(crate) fn of_all(mut errors: Vec<Self>) -> Result<(), Self> {
        match errors.len() {
            0 => Ok(()),
            1 => Err(errors.remove(0)),
            _ => Err(Self::Several(errors)),
        }
    }
}

/// Returns one line for each of the first errors, and the number of further ones.
fn listed(errors: &[DatasetError]) -> String {
    let shown = errors.iter().take(20).map(|error| format!("\n  {error}"));
    let more =
        (errors.len() > 20).then(|| format!("\n  and {} more; `carff dataset check` lists all", errors.len() - 20));
    shown.chain(more).collect()
}
