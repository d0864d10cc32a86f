//! Scenarios as data, the ray tracer that renders their images, and free drives through them.
//!
//! A scenario is a TOML file with static objects, actors per branch, and cameras. This crate does not depend on models,
//! on the dataset's readers, or on processes.
//!
//! ```no_run
//! use carff_scenes::{Detail, Scenario};
//! # fn main() -> Result<(), carff_scenes::ScenarioError> {
//! let scenario = Scenario::load("configs/scenarios/approaching-intersection.toml".as_ref())?;
//! let camera = scenario.cameras()[0].camera;
//! let rendering = scenario.render(0, 2, &camera, Detail::default())?;
//! rendering.image.save_png("view.png".as_ref())?;
//! # Ok(())
//! # }
//! ```

mod bystanders;
mod cameras;
mod closed_loop;
pub mod config;
mod error;
mod free_drives;
mod free_views;
mod lanes;
mod materials;
mod movers;
mod path;
mod scenario;
mod scenery;
mod shapes;
mod tracer;
mod unknown_views;
mod variations;
mod watches;

pub use cameras::ScenarioCamera;
pub use closed_loop::{ClosedLoop, Episode};
pub use error::ScenarioError;
pub use free_drives::{FRAMES_PER_TIMESTAMP, FreeDrive, FreeFrame};
pub use free_views::{FreePose, FreeView};
pub use scenario::{
    ActorView, Detail, Extras, FULL_FRACTION, FULL_PIXELS, NONE_FRACTION, NONE_MEAN_DIFFERENCE, Rendering, Scenario,
};
pub use unknown_views::{IN_SIGHT_PX, UnknownView, VISIBLE_DIFFERENCE, is_in_sight};
