//! The graph file: one typed, documented configuration per stage; and the soak file. Nothing is started here.
//!
//! The doc of each field is the user's doc: what it means, its unit, what is allowed, and the default.
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
//! A relative path in a graph file is looked for in the current directory; where it is not there, it is taken from
//! the root of the project: the first folder above the graph file that holds a `configs` folder.

mod checkpoint;
mod error;
mod graph;
mod soak;

pub use checkpoint::{CheckpointPlanning, CheckpointPlanningError};
pub use error::ConfigError;
pub use graph::{
    CameraConfig, CameraSource, ControllerConfig, EncoderConfig, ForecasterConfig, GraphConfig, LauncherConfig,
    LogConfig, LogFormat, LogLevel, NoiseConfig, OverloadConfig, PoseChoice, ProberConfig, Quality, RealtimeConfig,
    RendererConfig, RestartConfig, RestartPolicy, Rule, RunConfig, Sampling, StageRealtime, ThreadsConfig, ViewChoice,
    WhenLost,
};
pub use soak::{Contract, Kind, Pace, SoakConfig, Weights};
