//! The sending process, which starts and controls the receiving process.

use crate::{End, Waiting, key, monotonic_now_ns, session};
use anyhow::{Context, bail, ensure};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fs::{OFlags, fcntl_setfl};
use std::io::{BufRead, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Reliability};
use zenoh::shm::{GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder};
use zenoh::{Session, Wait};

/// Number of payloads that fit into the shared memory. One is in use at a time; zenoh frees memory only when all is
/// used.
const POOL: usize = 4;
/// Minimum size of the shared memory, bytes.
const SMALLEST_POOL: usize = 1 << 16;
/// Time limit for the connection.
const PATIENCE: Duration = Duration::from_secs(10);

/// Runs until standard input ends.
pub(crate) fn run(folder: &Path) -> anyhow::Result<()> {
    let mut receiver = Receiver::start(folder)?;
    let session = session(folder, End::Sender)?;
    let mut opened: Option<Opened> = None;
    let mut answers = std::io::stdout().lock();
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["open", bytes] => {
                drop(opened.take());
                let bytes = bytes.parse()?;
                writeln!(receiver.commands, "open {bytes}")?;
                receiver.answer(&mut [0], Waiting::Sleeping)?;
                opened = Some(Opened::new(&session, bytes)?);
                answers.write_all(b".")?;
            }
            ["run", count, waiting, pause_us] => {
                let (count, waiting, pause_us) = (count.parse()?, Waiting::parse(waiting)?, pause_us.parse()?);
                let opened = opened.as_mut().context("no sender is open")?;
                answers.write_all(&measure(opened, &mut receiver, count, waiting, pause_us)?)?;
            }
            ["end"] => break,
            _ => bail!("no such command: {line}"),
        }
        answers.flush()?;
    }
    drop(opened);
    drop(session);
    drop(receiver);
    remove_leftovers()
}

/// Removes the names of the shared memory that this process still holds. zenoh's own cleanup at the end of the process
/// treats this memory as in use, and leaves it for the next program with zenoh.
fn remove_leftovers() -> anyhow::Result<()> {
    for descriptor in std::fs::read_dir("/proc/self/fd")? {
        let Ok(path) = std::fs::read_link(descriptor?.path()) else { continue };
        if path.starts_with("/dev/shm") && path.extension().is_some_and(|e| e == "zenoh") {
            // It may be removed already, because two descriptors can refer to one file.
            let _ = std::fs::remove_file(&path);
        }
    }
    Ok(())
}

/// Sends `count` payloads, each after the acknowledgement of the previous one. Returns the receiver's times unchanged.
fn measure(
    opened: &mut Opened<'_>,
    receiver: &mut Receiver,
    count: usize,
    waiting: Waiting,
    pause_us: u64,
) -> anyhow::Result<Vec<u8>> {
    writeln!(receiver.commands, "run {count} {}", waiting.name())?;
    receiver.answer(&mut [0], waiting)?;
    for _ in 0..count {
        if pause_us > 0 {
            std::thread::sleep(Duration::from_micros(pause_us));
        }
        opened.send()?;
        receiver.answer(&mut [0], waiting)?;
    }
    let mut times = vec![0; count * size_of::<u64>()];
    receiver.answer(&mut times, Waiting::Sleeping)?;
    Ok(times)
}

/// Sender of payloads of one size.
struct Opened<'a> {
    publisher: Publisher<'a>,
    memory: ShmProvider<PosixShmProviderBackend>,
    payload: Vec<u8>,
}

impl<'a> Opened<'a> {
    fn new(session: &'a Session, bytes: usize) -> anyhow::Result<Self> {
        ensure!(bytes >= size_of::<u64>(), "a payload of {bytes} bytes has no room for the time");
        let publisher = session
            .declare_publisher(key(bytes))
            .reliability(Reliability::Reliable)
            .congestion_control(CongestionControl::Block)
            .express(true)
            .wait()
            .map_err(anyhow::Error::from_boxed)
            .context("no zenoh publisher")?;
        let start = Instant::now();
        while !publisher.matching_status().wait().map_err(anyhow::Error::from_boxed)?.matching() {
            ensure!(start.elapsed() < PATIENCE, "the zenoh subscriber cannot be seen");
            std::thread::sleep(Duration::from_millis(1));
        }
        let pool = (POOL * bytes).max(SMALLEST_POOL);
        let memory = ShmProviderBuilder::default_backend(pool)
            .wait()
            .map_err(anyhow::Error::from_boxed)
            .with_context(|| format!("no {pool} bytes of shared memory for zenoh"))?;
        let payload = (0..bytes).map(|i| (i * 31) as u8).collect();
        Ok(Self { publisher, memory, payload })
    }

    fn send(&mut self) -> anyhow::Result<()> {
        self.payload[..size_of::<u64>()].copy_from_slice(&monotonic_now_ns().to_le_bytes());
        let mut loan = self
            .memory
            .alloc(self.payload.len())
            .with_policy::<GarbageCollect>()
            .wait()
            .context("no shared memory is left for zenoh")?;
        loan.copy_from_slice(&self.payload);
        self.publisher.put(loan).wait().map_err(anyhow::Error::from_boxed)
    }
}

/// The receiving process.
struct Receiver {
    child: Child,
    commands: ChildStdin,
    answers: ChildStdout,
}

impl Receiver {
    /// Starts the process, and returns when it listens.
    fn start(folder: &Path) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find this program")?;
        let mut child = Command::new(&program)
            .arg("receive")
            .arg(folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        let commands = child.stdin.take().context("the receiver has no standard input")?;
        let answers = child.stdout.take().context("the receiver has no standard output")?;
        fcntl_setfl(&answers, OFlags::NONBLOCK).context("cannot watch the receiver")?;
        let mut receiver = Self { child, commands, answers };
        receiver.answer(&mut [0], Waiting::Sleeping)?;
        Ok(receiver)
    }

    /// Fills `bytes` with the receiver's answer.
    fn answer(&mut self, bytes: &mut [u8], waiting: Waiting) -> anyhow::Result<()> {
        let mut filled = 0;
        while filled < bytes.len() {
            match self.answers.read(&mut bytes[filled..]) {
                Ok(0) => bail!("the receiving process has ended: {}", self.child.wait()?),
                Ok(n) => filled += n,
                Err(e) if e.kind() == ErrorKind::WouldBlock && waiting == Waiting::Busy => std::thread::yield_now(),
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    poll(&mut [PollFd::new(&self.answers.as_fd(), PollFlags::IN)], None)?;
                }
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e.into()),
            }
        }
        Ok(())
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        // It ends on request, unless it hangs.
        let _ = writeln!(self.commands, "end");
        for _ in 0..100 {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
