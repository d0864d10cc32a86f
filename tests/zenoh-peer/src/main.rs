//! Sends and receives payloads by zenoh's shared memory, for `carff bench ipc`.
//!
//! `carff-zenoh-peer send FOLDER` starts the receiving process and reads commands from standard input. It answers `open
//! BYTES` with a dot, and `run COUNT sleeping|busy PAUSE_US` with the times (nanoseconds, u64). `end` ends it. As for
//! the other transports, the time starts before the sender requests memory, and ends after the receiver has read the
//! last byte. The receiver acknowledges through a pipe, which is not part of the time.
//!
//! The protocol repeats that of launch/bench/src/ipc. A common library would tie this package's lock file to the main
//! one, and the separate lock file keeps zenoh's crates out of the workspace.
//!
//! The two processes use a Unix socket in the folder and shared memory. They neither search for others nor listen on a
//! network. zenoh's own threads sleep until the socket wakes them, and then need a core. A polling process therefore
//! yields its core after every check: otherwise zenoh takes milliseconds on a machine with few cores.

mod receiver;
mod sender;

use anyhow::{Context, bail};
use rustix::process::{Signal, set_parent_process_death_signal};
use rustix::time::{ClockId, clock_gettime};
use std::path::Path;
use zenoh::{Config, Session, Wait};

fn main() -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot watch the parent process")?;
    let args: Vec<_> = std::env::args_os().skip(1).collect();
    match &args[..] {
        [role, folder] if role == "send" => sender::run(Path::new(folder)),
        [role, folder] if role == "receive" => receiver::run(Path::new(folder)),
        _ => bail!("this is the other program of `carff bench ipc`, which starts it; usage: send|receive FOLDER"),
    }
}

/// Way in which the receiver waits for a payload, and the sender for its acknowledgement.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Waiting {
    /// Sleeps until it is woken.
    Sleeping,
    /// Polls, and yields its core between two checks.
    Busy,
}

impl Waiting {
    fn parse(word: &str) -> anyhow::Result<Self> {
        match word {
            "sleeping" => Ok(Self::Sleeping),
            "busy" => Ok(Self::Busy),
            _ => bail!("unknown way of waiting: {word}"),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Sleeping => "sleeping",
            Self::Busy => "busy",
        }
    }
}

/// The end that opens a session.
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    /// Listens on the socket.
    Receiver,
    /// Connects after the receiver listens.
    Sender,
}

/// Opens a session with only the other end, with shared memory and zenoh's low-latency transport.
fn session(folder: &Path, end: End) -> anyhow::Result<Session> {
    let socket = folder.join("zenoh.socket");
    let socket = socket.to_str().context("the folder's path is not UTF-8")?;
    let here = format!("[{:?}]", format!("unixsock-stream/{socket}"));
    let (listen, connect) = match end {
        End::Receiver => (here.as_str(), "[]"),
        End::Sender => ("[]", here.as_str()),
    };
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"peer\""),
        ("listen/endpoints", listen),
        ("connect/endpoints", connect),
        ("connect/timeout_ms", "10000"),
        ("connect/exit_on_failure", "true"),
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
        // These two settings exclude each other.
        ("transport/unicast/qos/enabled", "false"),
        ("transport/unicast/lowlatency", "true"),
        ("transport/shared_memory/enabled", "true"),
        ("transport/shared_memory/mode", "\"init\""),
        // Payloads are in shared memory from the start, so that zenoh must not copy them there.
        ("transport/shared_memory/transport_optimization/enabled", "false"),
    ] {
        config.insert_json5(key, value).map_err(anyhow::Error::from_boxed).with_context(|| format!("setting {key}"))?;
    }
    zenoh::open(config).wait().map_err(anyhow::Error::from_boxed).context("cannot open a zenoh session")
}

/// Returns the key of payloads of one size.
fn key(bytes: usize) -> String {
    format!("carff/bench/payload/{bytes}")
}

/// Returns the time of the clock that all processes of a machine share, nanoseconds.
fn monotonic_now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
