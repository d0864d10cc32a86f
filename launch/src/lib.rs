//! The parts of the `carff` command that start graphs or compute with models: launch, replay, soak, training,
//! evaluation and datasets. The crate `carff` contains the commands that observe a run.

pub mod ablate;
#[cfg(feature = "import")]
pub mod backbone;
pub mod dataset;
pub mod doctor;
pub mod eval;
pub mod health;
pub mod launch;
pub mod monitor;
pub mod planning;
mod process;
#[cfg(feature = "recording")]
pub mod replay;
pub mod report;
pub mod schema;
mod service_manager;
pub mod shell;
#[cfg(feature = "recording")]
pub mod soak;
pub mod supervise;
pub mod train;
