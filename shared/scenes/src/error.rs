//! Errors of scenarios, with their place.

use std::path::PathBuf;

use carff_dataset::DatasetError;

/// Reason why a scenario cannot be loaded or rendered.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file cannot be read.
    #[error("{}: {source}{}", path.display(), carff_base::names::beside(path))]
    Io {
        /// Path of the scenario file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A key is unknown, missing, of the wrong type or out of range. The message names line, column and text.
    #[error("{}: {}", path.display(), carff_base::names::explained(&.source.to_string()))]
    Toml {
        /// Path of the scenario file.
        path: PathBuf,
        /// Line, column, key and the allowed values.
        source: Box<toml::de::Error>,
    },
    /// Values are valid on their own but contradict each other.
    #[error("{}:{line}: key `{key}`: {problem}", path.display())]
    Key {
        /// Path of the scenario file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// Name of the key.
        key: String,
        /// The error and the allowed values.
        problem: String,
    },
    /// The scenario has no such branch or time step.
    #[error("there is no branch {branch} at timestamp {timestamp}; the scenario has {branches} x {timestamps}")]
    NoSuchState {
        /// Requested branch.
        branch: usize,
        /// Requested time step.
        timestamp: usize,
        /// Number of branches.
        branches: usize,
        /// Number of time steps.
        timestamps: usize,
    },
    /// The camera cannot take images.
    #[error("the camera is not usable: {0}")]
    Camera(#[from] carff_base::geometry::CameraError),
    /// The scenario cannot be driven through.
    #[error("{}: no closed-loop drives: {problem}", path.display())]
    NoClosedLoop {
        /// Path of the scenario file.
        path: PathBuf,
        /// The missing part.
        problem: &'static str,
    },
    /// No position was found for a random camera.
    #[error("{}: key `{key}`: no position in these ranges is free of obstacles; widen them", path.display())]
    NoRoom {
        /// Path of the scenario file.
        path: PathBuf,
        /// Key of the camera group.
        key: &'static str,
    },
    /// No drive of a kind was found.
    #[error(
        "{}: none of {tries} drawn drives is a {} trial: the scenario needs branches with and without a hazard, and \
         cameras that see none, or all, of the actor before the last timestamp",
        path.display(), kind.name()
    )]
    NoDrive {
        /// Path of the scenario file.
        path: PathBuf,
        /// Kind of the drive.
        kind: carff_dataset::drives::DriveKind,
        /// Number of drawn drives.
        tries: u32,
    },
    /// No camera pose is free of obstacles.
    #[error(
        "{}: none of {tries} random camera poses is free of obstacles; widen the cameras' ranges or lower `clearance_m`",
        path.display()
    )]
    NoPose {
        /// Path of the scenario file.
        path: PathBuf,
        /// Number of drawn poses.
        tries: u32,
    },
    /// The scenario has no appearance, bystander or closed-loop route of this name.
    #[error("{}: no `{key}` named `{name}`{}", path.display(), listed(known, name))]
    NoSuchName {
        /// Path of the scenario file.
        path: PathBuf,
        /// Key of its table: `appearance`, `bystander` or `closed_loop`.
        key: &'static str,
        /// Requested name.
        name: String,
        /// Names in the file.
        known: Vec<String>,
    },
    /// No branch can show the unknown at this time step.
    #[error("{}: {problem}", path.display())]
    NothingUnknown {
        /// Path of the scenario file.
        path: PathBuf,
        /// The missing part.
        problem: &'static str,
    },
    /// The dataset cannot be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The caller stopped the rendering.
    #[error("rendering was stopped; run it again to finish the dataset")]
    Stopped,
}

/// Returns the known names, with the nearest one.
fn listed(known: &[String], name: &str) -> String {
    if known.is_empty() {
        return "; the file has none".to_owned();
    }
    let hint = carff_base::names::hint(name, known.iter().map(String::as_str));
    format!("; there are {}{hint}", known.iter().map(|k| format!("`{k}`")).collect::<Vec<_>>().join(", "))
}
