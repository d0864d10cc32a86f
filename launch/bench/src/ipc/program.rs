//! Measures a transport through a program of its own: zenoh through `tests/zenoh-peer`, dora through `tests/dora-peer`.
//!
//! The separate programs keep zenoh's crates, and Python, out of this one.

use super::{Label, Pair, Size, Waiting, times_us};
use crate::helper::{PATIENCE, end_by};
use anyhow::{Context, bail, ensure};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

/// Name of zenoh's program.
const PROGRAM: &str = "carff-zenoh-peer";

/// Name of zenoh in keys of figures and in tables.
pub(crate) const ZENOH: Label = ("zenoh", "zenoh, shared memory");
/// Name of dora in keys of figures and in tables.
pub(crate) const DORA: Label = ("dora", "dora, Python nodes");

/// Returns zenoh's requested program, or the one in this program's folder. Prints a line if the latter does not exist.
pub(crate) fn zenoh(asked: Option<&Path>) -> anyhow::Result<Option<PathBuf>> {
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
pub(crate) struct ProgramPair {
    label: Label,
    child: Child,
    commands: ChildStdin,
    answers: ChildStdout,
}

impl ProgramPair {
    /// Starts a program with its arguments.
    pub(crate) fn start(label: Label, program: &[impl AsRef<Path>], folder: &Path) -> anyhow::Result<Self> {
        let (program, args) = program.split_first().context("no program is given")?;
        let mut child = Command::new(program.as_ref())
            .args(args.iter().map(AsRef::as_ref))
            .arg("send")
            .arg(folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.as_ref().display()))?;
        let commands = child.stdin.take().context("the peer has no standard input")?;
        let answers = child.stdout.take().context("the peer has no standard output")?;
        Ok(Self { label, child, commands, answers })
    }

    /// Sends a command to the sender, and sleeps until its answer is complete.
    fn ask(&mut self, command: &str, answer: &mut [u8]) -> anyhow::Result<()> {
        let asked = writeln!(self.commands, "{command}").and_then(|()| self.answers.read_exact(answer));
        match asked {
            Err(e) if matches!(e.kind(), ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe) => {
                bail!("the sending process of {} has ended: {}", self.label.0, self.child.wait()?)
            }
            other => Ok(other?),
        }
    }
}

impl Pair for ProgramPair {
    fn name(&self) -> &'static str {
        self.label.0
    }

    fn title(&self) -> &'static str {
        self.label.1
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

impl Drop for ProgramPair {
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
        assert!(zenoh(Some(&path)).unwrap_err().to_string().contains("make bench-peer"));
        std::fs::write(&path, "").unwrap();
        assert_eq!(zenoh(Some(&path)).unwrap(), Some(path));
        assert_eq!(zenoh(None).unwrap(), None);
    }

    /// A program that ends at once is reported as ended, no matter which of the two pipes detects it first.
    #[test]
    fn an_ended_program_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        for (label, program) in [(ZENOH, &["true"][..]), (DORA, &["sh", "-c", "exit 3"])] {
            let mut pair = ProgramPair::start(label, program, folder.path()).unwrap();
            let error = pair.open(Size::near(64)).unwrap_err().to_string();
            assert!(error.contains(label.0) && error.contains("has ended"), "{error}");
        }
        assert!(ProgramPair::start(DORA, &["/none"], folder.path()).is_err());
    }
}
