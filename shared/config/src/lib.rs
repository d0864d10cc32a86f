//! The graph file and the soak file: typed, documented and checked. Nothing is started here.
//!
//! The doc of each field is the user's doc: its meaning, unit, range and default.
//!
//! ```
//! let graph = carff_config::GraphConfig::parse(
//!     r#"
//!     [run]
//!     name = "crossing"
//!     dataset = "data/approaching-intersection"
//!     checkpoint = "configs/checkpoints/approaching-intersection"
//!     "#,
//!     "crossing.toml".as_ref(),
//! )?;
//! assert_eq!(graph.run.samples, 10);
//!
//! let error = carff_config::GraphConfig::parse("[run]\nname = \"x\"\nhorizon = 9", "x.toml".as_ref()).unwrap_err();
//! assert!(error.to_string().starts_with("x.toml:1: "), "{error}");
//! # Ok::<(), carff_config::ConfigError>(())
//! ```
//!
//! A relative path in a graph file is resolved in the current directory. Where it does not exist there, it is taken
//! from the root of the project: the first folder above the graph file that holds a `configs` folder.

mod camera;
mod error;
mod graph;
mod launcher;
mod ranges;
mod soak;
mod stages;

pub use camera::{CalibrationChoice, CameraConfig, CameraSource, FramePace, Pose, PoseChoice};
pub use error::ConfigError;
pub use graph::{
    ChecksConfig, CompareImages, ControllerConfig, GraphConfig, MemoryKind, RendererConfig, RunConfig, UnknownIs,
    ViewChoice, is_stream,
};
pub use launcher::{LauncherConfig, OverloadConfig, Reduction, WhenLost};
pub use soak::{Contract, FaultKind, Pace, SoakConfig, Weights};
pub use stages::{Backend, LogFormat, LogLevel, RestartPolicy, StageConfig, StagesConfig};
