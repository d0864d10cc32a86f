//! Observation of runs: listing them, owning one, and joining one as an observer.
//!
//! Probes, recorder and viewer process the messages of a run.
//!
//! An observer takes one of the spare subscriber slots of each topic that it opens ([`carff_transport::TopicLimits`]);
//! opening fails if no slot is left. Observers may join and leave at any time, and no stage waits for them.

mod attach;
mod lock;
mod record;
mod view;

pub use attach::{AttachError, Attached, LiveRun, attach, find, runs};
pub use lock::{LockError, RunLock};
pub use record::RunRecord;
pub use view::{First, Theme, ViewArgs};
