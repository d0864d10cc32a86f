//! The sending process, which starts and controls the receiving process.

use super::{Pair, Sender, Size, Transport, Waiting, times_us};
use crate::helper::{PATIENCE, end_by};
use anyhow::{Context, bail, ensure};
use carff_transport::{Stop, monotonic_now_ns};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fs::{OFlags, fcntl_setfl};
use std::io::{ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// A receiving process and the sender to it.
pub(crate) struct Driver {
    transport: Transport,
    folder: PathBuf,
    sender: Option<Box<dyn Sender>>,
    payload: Vec<u8>,
    child: Child,
    commands: ChildStdin,
    answers: ChildStdout,
    stop: Stop,
}

impl Driver {
    pub(crate) fn start(transport: Transport, folder: &Path, stop: &Stop) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find this program")?;
        let mut child = Command::new(&program)
            .args(["bench", "ipc-peer", transport.name()])
            .arg(folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        let commands = child.stdin.take().context("the peer has no standard input")?;
        let answers = child.stdout.take().context("the peer has no standard output")?;
        fcntl_setfl(&answers, OFlags::NONBLOCK).context("cannot watch the peer")?;
        Ok(Self {
            transport,
            folder: folder.to_owned(),
            sender: None,
            payload: Vec::new(),
            child,
            commands,
            answers,
            stop: stop.clone(),
        })
    }

    /// Fills `bytes` with the peer's answer.
    fn answer(&mut self, bytes: &mut [u8], waiting: Waiting) -> anyhow::Result<()> {
        let mut filled = 0;
        while filled < bytes.len() {
            match self.answers.read(&mut bytes[filled..]) {
                Ok(0) => {
                    let status = self.child.wait()?;
                    bail!("the receiving process ({}) has ended: {status}", self.transport.title());
                }
                Ok(n) => filled += n,
                Err(e) if e.kind() == ErrorKind::WouldBlock && waiting == Waiting::Busy => std::hint::spin_loop(),
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

impl Pair for Driver {
    fn name(&self) -> &'static str {
        self.transport.name()
    }

    fn title(&self) -> &'static str {
        self.transport.title()
    }

    fn open(&mut self, size: Size) -> anyhow::Result<()> {
        self.sender = None;
        writeln!(self.commands, "open {} {}", size.width_px, size.height_px)?;
        self.answer(&mut [0], Waiting::Sleeping)?;
        self.sender = Some(self.transport.sender(&self.folder, size)?);
        self.payload = (0..size.bytes()).map(|i| (i * 31) as u8).collect();
        Ok(())
    }

    fn run(&mut self, count: usize, waiting: Waiting, pause_us: u64) -> anyhow::Result<Vec<f64>> {
        writeln!(self.commands, "run {count} {}", waiting.name())?;
        self.answer(&mut [0], waiting)?;
        for _ in 0..count {
            ensure!(!self.stop.is_stopped(), "interrupted");
            if pause_us > 0 {
                std::thread::sleep(Duration::from_micros(pause_us));
            }
            let sender = self.sender.as_mut().context("no sender is open")?;
            self.payload[..size_of::<u64>()].copy_from_slice(&monotonic_now_ns().to_le_bytes());
            sender.send(&self.payload, waiting)?;
            self.answer(&mut [0], waiting)?;
        }
        let mut times = vec![0; count * size_of::<u64>()];
        self.answer(&mut times, Waiting::Sleeping)?;
        Ok(times_us(&times))
    }
}

impl Drop for Driver {
    fn drop(&mut self) {
        self.sender = None;
        let _ = writeln!(self.commands, "end");
        // After an interrupt it waits for a payload, and reads no command.
        let patience = if self.stop.is_stopped() { Duration::ZERO } else { PATIENCE };
        end_by(&mut self.child, Instant::now() + patience);
    }
}
