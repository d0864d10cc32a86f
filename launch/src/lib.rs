//! The parts of the `carff` command that start graphs or compute with models: launch, replay, soak, training,
//! evaluation and datasets. The crate `carff` contains the commands that observe a run.

pub mod ablate;
#[cfg(feature = "import")]
pub mod backbone;
pub mod checkpoint;
pub mod dataset;
mod decisions;
pub mod doctor;
pub mod eval;
pub mod launch;
pub mod planning;
#[cfg(feature = "recording")]
pub mod replay;
pub mod report;
pub mod schema;
pub mod shell;
#[cfg(feature = "recording")]
pub mod soak;
pub mod supervision;
pub mod train;
