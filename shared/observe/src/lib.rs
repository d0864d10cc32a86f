//! Runs seen from outside: which there are, who owns one, joining it, and receiving from any of its topics without
//! anybody waiting for it. What is made of the messages lives with those who look: probes, recorder, viewer.
//!
//! An observer takes one of the spare subscriber slots of each topic that it opens ([`carff_transport::Limits`]); when
//! none is left, opening says so. It may come and go at any time.

mod attach;
mod lock;
mod receive;
mod record;
mod topic;

pub use attach::{AttachError, Attached, LiveRun, attach, runs};
pub use lock::{LockError, RunLock};
pub use receive::{AnyReceiver, Received};
pub use record::RunRecord;
pub use topic::{TopicId, UnknownTopic};
