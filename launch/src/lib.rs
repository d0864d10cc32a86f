//! The `carff` command's parts that start graphs or compute with models: launching and watching a graph, replays, soaks,
//! training and judging, datasets. What the stages compute lives in the stages; what looks at a run, in `carff`.

pub mod ablate;
pub mod backbone;
pub mod dataset;
pub mod doctor;
pub mod eval;
mod filmstrip;
pub mod health;
pub mod launch;
pub mod monitor;
pub mod planning;
mod process;
pub mod replay;
pub mod report;
pub mod schema;
mod service_manager;
pub mod shell;
pub mod soak;
pub mod supervise;
pub mod train;
