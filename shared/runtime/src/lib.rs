//! Common parts of all stage processes: arguments, log, health, waiting, stopping, exit code. Each stage's own crate
//! contains its computation.
//!
//! A stage's `main` reads from top to bottom: open topics, report ready, then receive, compute, publish.
//!
//! ```no_run
//! use carff_messages::{Gaussian, Posterior, Stage};
//! use carff_runtime::{StageContext, frame_span};
//! use carff_transport::{monotonic_now_ns, topics};
//!
//! fn main() -> std::process::ExitCode {
//!     carff_runtime::main(Stage::Encoder, run)
//! }
//!
//! fn run(stage: &mut StageContext) -> anyhow::Result<()> {
//!     let mut frames = stage.input(&topics::FRAME)?;
//!     let mut posteriors = stage.output(&topics::POSTERIOR)?;
//!     stage.ready();
//!     while stage.wait(&[&frames])? {
//!         let Some(frame) = frames.newest()? else { continue };
//!         let started_ns = monotonic_now_ns();
//!         let _span = frame_span(&frame.header);
//!         let gaussian = Gaussian::standard(); // computed from frame.image(), read in place
//!         let header = frame.header;
//!         let stage_latency_ns = stage.worked(&header, started_ns);
//!         let take_start = frame.take_start;
//!         posteriors.send(Posterior { header, gaussian, take_start, stage_latency_ns })?;
//!     }
//!     Ok(())
//! }
//! ```
//!
//! Exit codes: 0 if it has completed its work or was asked to stop, 1 after an error (one sentence on standard error),
//! 2 for wrong arguments.

mod args;
mod camera;
mod context;
mod health;
mod overload;
mod realtime;

pub use args::{StageArgs, parse};
pub use camera::{FrameOutput, rectifier};
pub use context::{StageContext, frame_span, main, run_with};
pub use overload::{Overload, Quality};
