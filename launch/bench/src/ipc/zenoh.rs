//! Payloads by zenoh, with its shared memory on: the two ends are a program of their own, tests/zenoh-peer.
//!
//! So none of zenoh's crates is one of this program's.

use super::{Pair, Size, Waiting, times_us};
use crate::helper::{PATIENCE, end_by};
use anyhow::{Context, bail, ensure};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

/// What the program is called.
const PROGRAM: &str = "carff-zenoh-peer";

/// The program: the one that was asked for, or the one beside this program. Where there is none, says so.
pub(crate) fn program(asked: Option<&Path>) -> anyhow::Result<Option<PathBuf>> {
    if let Some(path) = asked {
        ensure!(path.is_file(), "{} is not there: `make bench-peer` builds it", path.display());
        return Ok(Some(path.to_owned()));
    }
    let beside = std::env::current_exe().context("cannot find this program")?.with_file_name(PROGRAM);
    if beside.is_file() {
        return Ok(Some(beside));
    }
    println!("zenoh is left out: {} is not there; `make bench-peer` builds it\n", beside.display());
    Ok(None)
}

/// The sending process, which starts the receiving one.
pub(crate) struct ZenohPair {
    child: Child,
    commands: ChildStdin,
    answers: ChildStdout,
}

impl ZenohPair {
    pub(crate) fn start(program: &Path, folder: &Path) -> anyhow::Result<Self> {
        let mut child = Command::new(program)
            .arg("send")
            .arg(folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        let commands = child.stdin.take().context("the peer has no standard input")?;
        let answers = child.stdout.take().context("the peer has no standard output")?;
        Ok(Self { child, commands, answers })
    }

    /// Has the sender do something, and sleeps until it has answered with so many bytes.
    fn ask(&mut self, command: &str, answer: &mut [u8]) -> anyhow::Result<()> {
        let asked = writeln!(self.commands, "{command}").and_then(|()| self.answers.read_exact(answer));
        match asked {
            Err(e) if matches!(e.kind(), ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe) => {
                bail!("zenoh's sending process has ended: {}", self.child.wait()?)
            }
            other => Ok(other?),
        }
    }
}

impl Pair for ZenohPair {
    fn name(&self) -> &'static str {
        "zenoh"
    }

    fn title(&self) -> &'static str {
        "zenoh, shared memory"
    }

    fn open(&mut self, size: Size) -> anyhow::Result<()> {
        self.ask(&format!("open {}", size.bytes()), &mut [0])
    }

    fn run(&mut self, count: usize, waiting: Waiting, pause_us: u64) -> anyhow::Result<Vec<f64>> {
        let mut times = vec![0; count * size_of::<u64>()];
        self.ask(&format!("run {count} {} {pause_us}", waiting.name()), &mut times)?;
        Ok(times_us(&times))
    }
}

impl Drop for ZenohPair {
    fn drop(&mut self) {
        let _ = writeln!(self.commands, "end");
        end_by(&mut self.child, Instant::now() + PATIENCE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A program that was asked for must be there; the error says how to build it. None asked for, none beside: none.
    #[test]
    fn program_is_found_or_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(PROGRAM);
        assert!(program(Some(&path)).unwrap_err().to_string().contains("make bench-peer"));
        std::fs::write(&path, "").unwrap();
        assert_eq!(program(Some(&path)).unwrap(), Some(path));
        assert_eq!(program(None).unwrap(), None);
    }

    /// A program that ends at once is an error that says so, whichever of the two pipes notices first.
    #[test]
    fn an_ended_program_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let mut pair = ZenohPair::start(Path::new("true"), folder.path()).unwrap();
        assert!(pair.open(Size::near(64)).unwrap_err().to_string().contains("has ended"));
    }
}
