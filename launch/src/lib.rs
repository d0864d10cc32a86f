//! The `carff` command's parts: starting a graph, watching it, recording what it does, and data sets.
//! What the stages compute lives in the stages.

pub mod ablate;
pub mod dataset;
pub mod eval;
mod filmstrip;
pub mod health;
pub mod launch;
pub mod lock;
pub mod monitor;
pub mod planning;
mod process;
pub mod report;
pub mod run_record;
pub mod soak;
pub mod supervise;
pub mod terminal;
pub mod train;
