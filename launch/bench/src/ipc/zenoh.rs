//! Measures zenoh with shared memory through the program `tests/zenoh-peer`.
//!
//! The separate program keeps zenoh's crates out of this one.

use super::{Pair, Size, Waiting, times_us};
use crate::helper::{PATIENCE, end_by};
use anyhow::{Context, bail, ensure};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

/// Name of the program.
const PROGRAM: &str = "carff-zenoh-peer";

/// Returns the requested program, or the one in this program's folder. Prints a line if the latter does not exist.
pub(crate) fn program(asked: Option<&Path>) -> anyhow::Result<Option<PathBuf>> {
    if let Some(path) = asked {
        ensure!(path.is_file(), "{} does not exist; build it with `make bench-peer`", path.display());
        return Ok(Some(path.to_owned()));
    }
    let default = std::env::current_exe().context("cannot find this program")?.with_file_name(PROGRAM);
    if default.is_file() {
        return Ok(Some(default));
    }
    println!("zenoh is left out: {} does not exist; build it with `make bench-peer`\n", default.display());
    Ok(None)
}

/// The sending process, which starts the receiving process.
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

    /// Sends a command to the sender, and sleeps until its answer is complete.
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

    /// A requested program must exist: the error names the command that builds it. The default program may be missing.
    #[test]
    fn program_is_found_or_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(PROGRAM);
        assert!(program(Some(&path)).unwrap_err().to_string().contains("make bench-peer"));
        std::fs::write(&path, "").unwrap();
        assert_eq!(program(Some(&path)).unwrap(), Some(path));
        assert_eq!(program(None).unwrap(), None);
    }

    /// A program that ends at once is reported as ended, no matter which of the two pipes detects it first.
    #[test]
    fn an_ended_program_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let mut pair = ZenohPair::start(Path::new("true"), folder.path()).unwrap();
        assert!(pair.open(Size::near(64)).unwrap_err().to_string().contains("has ended"));
    }
}
