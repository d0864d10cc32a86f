//! The typed layer over iceoryx2: topics with their limits, sending, receiving, waiting, and cleaning up.
//!
//! `carff-messages` defines the messages; the stages process them.
//!
//! A process opens one [`Node`] in a [`Run`], for each thread that sends or receives. Every topic is one row of the table in [`topics`]. Sending stamps the
//! header and wakes the receivers that wait. Receiving drops and counts invalid messages, and gives access to valid
//! ones in the sender's memory. A [`Waiter`] sleeps until one of several inputs has a message, a time, or a stop.
//!
//! ```
//! use carff_messages::{Gaussian, Header, Posterior};
//! use carff_transport::{Node, Run, Stop, Waiter, Woken, monotonic_now_ns, topics};
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let name = format!("doc-{}", std::process::id());
//! let run = Run::new(&name, 1)?;
//! let node = Node::open(&run, "example")?;
//! let mut input = node.receiver(&topics::POSTERIOR)?;
//! let mut output = node.publisher(&topics::POSTERIOR)?;
//!
//! let header = Header::of_frame(7, monotonic_now_ns(), 42);
//! output.send(Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 })?;
//!
//! let waiter = Waiter::new(Stop::new()?);
//! assert_eq!(waiter.wait_until(&[&input], monotonic_now_ns() + 1_000_000_000)?, Woken::Input);
//! let posterior = input.newest()?.expect("it was sent above");
//! assert_eq!(posterior.header.frame_id, 7);
//! # drop(posterior);
//! # drop((input, output, node));
//! # carff_transport::remove_run_leftovers(&run)?;
//! # Ok(())
//! # }
//! ```

mod counters;
mod descriptors;
mod error;
mod folder;
mod in_use;
mod log;
mod node;
mod payload;
mod publisher;
mod receiver;
mod registry;
mod retry;
mod run;
mod space;
mod stop;
mod topic;
pub mod topics;
mod untyped;
mod wait;

pub use counters::Counters;
pub use error::{CleanupError, OpenError, ReceiveError, RunNameError, SendError, WaitError};
pub use folder::{mapping_processes, runtime_dir, runtime_dirs};
pub use in_use::{Member, OpenTopic, Ports};
pub use node::{Node, make_private_dir};
pub use payload::{ImagePayload, Payload};
pub use publisher::{ImageLoan, Publisher};
pub use receiver::{Receiver, Sample};
pub use registry::{AnyPublisher, AnyReceiver, AnyTopic, Received, TopicId, UnknownTopic, graph_bytes};
pub use run::{Run, cleanup_dead, living_nodes, living_processes, remove_run_leftovers, run_id_of};
pub use space::{SHARED_MEMORY_DIR, check_space};
pub use stop::{INTERRUPTED, Stop, exit_on_signals, is_interrupted};
pub use topic::{Topic, TopicLimits};
pub use untyped::HeaderOnly;
pub use wait::{Input, Waiter, Woken};

/// Version of iceoryx2, which all processes of a run must use.
pub const TRANSPORT_VERSION: &str = "0.10.0";

/// Returns the present time of the clock that all headers use: `CLOCK_MONOTONIC`, nanoseconds, the same in all
/// processes of a machine.
pub fn monotonic_now_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// The variant of iceoryx2 in use: between processes, with nodes and ports that belong to one thread. The mutexes of the
/// other variant take a quarter of a message's time.
pub(crate) type Service = iceoryx2::prelude::ipc::Service;
