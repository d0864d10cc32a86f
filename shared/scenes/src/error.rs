//! What can be wrong with a scenario, and where.

use std::path::PathBuf;

use carff_dataset::DatasetError;

/// Why a scenario cannot be loaded or rendered.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file cannot be read.
    #[error("{}: {source}{}", path.display(), carff_nearest::beside(path))]
    Io {
        /// The scenario file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A key that is unknown, missing, of the wrong type or out of range. Names line and column and shows the line.
    #[error("{}: {}", path.display(), carff_nearest::explained(&.source.to_string()))]
    Toml {
        /// The scenario file.
        path: PathBuf,
        /// Line, column, key and what is allowed.
        source: Box<toml::de::Error>,
    },
    /// Values that are well-formed each but do not fit together.
    #[error("{}:{line}: key `{key}`: {problem}", path.display())]
    Key {
        /// The scenario file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// The key.
        key: String,
        /// What is wrong and what is allowed.
        problem: String,
    },
    /// A branch or timestamp that the scenario does not have.
    #[error("there is no branch {branch} at timestamp {timestamp}; the scenario has {branches} x {timestamps}")]
    NoSuchState {
        /// Branch asked for.
        branch: usize,
        /// Timestamp asked for.
        timestamp: usize,
        /// Branches there are.
        branches: usize,
        /// Timestamps there are.
        timestamps: usize,
    },
    /// A camera that cannot take images.
    #[error("the camera is not usable: {0}")]
    Camera(#[from] carff_geometry::CameraError),
    /// No place was found for a freely drawn camera.
    #[error("{}: key `{key}`: no place in these ranges stands clear of everything; widen them", path.display())]
    NoRoom {
        /// The scenario file.
        path: PathBuf,
        /// The group of cameras.
        key: &'static str,
    },
    /// No drive of a kind was found.
    #[error(
        "{}: none of {tries} drawn drives is a {} trial: the scenario needs branches with and without a hazard, and \
         cameras that see nothing, or all, of the actor before the last timestamp",
        path.display(), kind.name()
    )]
    NoDrive {
        /// The scenario file.
        path: PathBuf,
        /// Which kind.
        kind: carff_dataset::drives::DriveKind,
        /// How many were drawn.
        tries: u32,
    },
    /// The set cannot be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The caller stopped the rendering.
    #[error("rendering was stopped; run it again to finish the set")]
    Stopped,
}
