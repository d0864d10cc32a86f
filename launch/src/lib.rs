//! The `carff` command's parts: starting a graph, watching it, recording what it does, and data sets.
//! What the stages compute lives in the stages.

pub mod ablate;
pub mod bridge;
pub mod dataset;
pub mod doctor;
pub mod eval;
pub mod export;
mod film;
mod filmstrip;
pub mod health;
pub mod launch;
mod log_line;
pub mod metrics;
pub mod monitor;
pub mod planning;
pub mod probe;
mod process;
pub mod record;
pub mod replay;
pub mod report;
pub mod schema;
mod service_manager;
pub mod shell;
pub mod soak;
mod spans;
pub mod supervise;
pub mod terminal;
pub mod train;
pub mod view;
mod vitals;
