//! Sends and receives payloads by zenoh's shared memory, for `carff bench ipc`.
//!
//! `carff-zenoh-peer send FOLDER` starts the receiving process and does what its standard input says: `open BYTES`,
//! answered by a dot; `run COUNT sleeping|busy PAUSE_US`, answered by the times, in nanoseconds, as 64-bit words;
//! `end`. As with all that is compared, the time is from before the sender asks for memory to after the receiver has
//! read the last byte, and the receiver acknowledges by a pipe, which is not part of the time.
//!
//! The protocol is that of launch/bench/src/ipc, written again here: a library for both would tie this package's lock file
//! to the main one, which it is apart from so that zenoh's crates are nobody's but its own.
//!
//! The two processes speak by a Unix socket in the folder and by shared memory; neither looks for others nor listens
//! on a network. While the two spin, zenoh's own threads still sleep until the socket wakes them, and need a core then:
//! so here one that spins offers its core after every look, without which zenoh takes milliseconds where cores are few.

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

/// How the receiver waits for a payload, and the sender for its acknowledgement.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Waiting {
    /// It sleeps and is woken.
    Sleeping,
    /// It spins, and lets others run between two looks.
    Busy,
}

impl Waiting {
    fn parse(word: &str) -> anyhow::Result<Self> {
        match word {
            "sleeping" => Ok(Self::Sleeping),
            "busy" => Ok(Self::Busy),
            _ => bail!("no such way of waiting: {word}"),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Sleeping => "sleeping",
            Self::Busy => "busy",
        }
    }
}

/// Which of the two ends opens a session.
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    /// It listens on the socket.
    Receiver,
    /// It connects, once the receiver listens.
    Sender,
}

/// A session with the other end alone, with shared memory on, and zenoh's transport that is made for short times.
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
        // The two exclude each other.
        ("transport/unicast/qos/enabled", "false"),
        ("transport/unicast/lowlatency", "true"),
        ("transport/shared_memory/enabled", "true"),
        ("transport/shared_memory/mode", "\"init\""),
        // Payloads lie in shared memory from the start: nothing is to be copied there behind our back.
        ("transport/shared_memory/transport_optimization/enabled", "false"),
    ] {
        config.insert_json5(key, value).map_err(anyhow::Error::from_boxed).with_context(|| format!("setting {key}"))?;
    }
    zenoh::open(config).wait().map_err(anyhow::Error::from_boxed).context("cannot open a zenoh session")
}

/// The key under which payloads of one size go.
fn key(bytes: usize) -> String {
    format!("carff/bench/payload/{bytes}")
}

/// The clock that all processes of a machine share, nanoseconds.
fn monotonic_now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
