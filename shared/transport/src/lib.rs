//! The typed layer over iceoryx2: topics with their limits, sending, receiving, waiting, and cleaning up.
//! What the messages mean lives in `carff-messages`; what a stage does with them lives in the stages.
//!
//! A process opens one [`Node`] in a [`Run`]. Every topic is one row of the table in [`topics`]. Sending stamps the
//! header and wakes whoever waits. Receiving validates, drops and counts what is not valid, and gives access to the
//! sender's memory in place. A [`Waiter`] sleeps until one of several inputs has something, a time, or a stop.
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
//! output.send(Posterior { header, gaussian: Gaussian::standard(), stage_latency_ns: 0 })?;
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
mod in_use;
mod node;
mod publisher;
mod receiver;
mod run;
mod space;
pub mod topics;
mod wait;

pub use counters::Counters;
pub use error::{CleanupError, OpenError, ReceiveError, RunNameError, SendError, WaitError};
pub use in_use::{Member, OpenTopic, Ports};
pub use node::{Node, make_private_dir};
pub use publisher::{PictureLoan, PicturePublisher, Publisher};
pub use receiver::{Picture, PictureReceiver, Receiver, Sample};
pub use run::{Run, cleanup_dead, living_processes, remove_run_leftovers, run_id_of, runtime_dir};
pub use space::{SHARED_MEMORY_DIR, check_space};
pub use topics::{Limits, PictureTopic, Topic};
pub use wait::{Input, Stop, Waiter, Woken};

/// Now, on the clock that all headers use: `CLOCK_MONOTONIC`, nanoseconds. The same in all processes of a machine.
pub fn monotonic_now_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// The flavour of iceoryx2 that is used: between processes, ports usable from several threads.
pub(crate) type Service = iceoryx2::prelude::ipc_threadsafe::Service;
