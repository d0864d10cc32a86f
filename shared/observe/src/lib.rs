//! Runs seen from outside: listing them, owning one, and joining one as an observer.
//!
//! Probes, recorder and viewer hold what is done with the messages of a run.
//!
//! An observer takes one of the spare subscriber slots of each topic that it opens ([`carff_transport::Limits`]); opening
//! fails when no slot is left. An observer may come and go at any time, and no stage waits for it.

mod attach;
mod lock;
mod record;

pub use attach::{AttachError, Attached, LiveRun, attach, runs};
pub use lock::{LockError, RunLock};
pub use record::RunRecord;
