//! Helper processes of a measurement, and the processor time of any process.

use anyhow::{Context, ensure};
use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};
use std::io::{Read, Write};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// Output of a helper that is ready.
const READY: &[u8] = b".";
/// Time limit for the end of a helper.
pub(crate) const PATIENCE: Duration = Duration::from_secs(3);
/// Clock ticks per second in the system's processor times: fixed on Linux.
const TICKS_PER_S: f64 = 100.0;

/// A helper process of this program. Dropping ends it.
pub(crate) struct Helper {
    child: Child,
    answers: ChildStdout,
}

impl Helper {
    /// Starts `carff bench` with these arguments, without waiting until it is ready.
    pub(crate) fn start(args: &[String]) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("cannot find this program")?;
        let mut child = Command::new(&program)
            .arg("bench")
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", program.display()))?;
        let answers = child.stdout.take().context("the process has no standard output")?;
        Ok(Self { child, answers })
    }

    /// Waits until the process reports that it is ready.
    pub(crate) fn wait_ready(&mut self) -> anyhow::Result<()> {
        let mut byte = [0];
        let read = self.answers.read(&mut byte)?;
        ensure!(byte[..read] == *READY, "a process of the measurement ended before it was ready");
        Ok(())
    }

    /// Returns the processor time of its living threads, seconds. It is finer than [`cpu_seconds`].
    pub(crate) fn cpu_seconds(&self) -> f64 {
        let threads = std::fs::read_dir(format!("/proc/{}/task", self.child.id())).into_iter().flatten().flatten();
        let nanoseconds = threads.filter_map(|thread| {
            let stat = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
            stat.split_whitespace().next()?.parse::<f64>().ok()
        });
        nanoseconds.sum::<f64>() / 1e9
    }

    /// Asks the process to end, and returns the rest of its output.
    pub(crate) fn finish(mut self) -> anyhow::Result<String> {
        ask_to_end(&self.child);
        let mut said = String::new();
        self.answers.read_to_string(&mut said)?;
        let status = self.child.wait()?;
        ensure!(status.success(), "a process of the measurement failed: {status}");
        Ok(said)
    }
}

impl Drop for Helper {
    fn drop(&mut self) {
        // After a wait, its number may belong to another process.
        if matches!(self.child.try_wait(), Ok(Some(_))) {
            return;
        }
        ask_to_end(&self.child);
        end_by(&mut self.child, Instant::now() + PATIENCE);
    }
}

/// Asks a process to end whose end was not awaited yet.
pub(crate) fn ask_to_end(child: &Child) {
    if let Some(pid) = Pid::from_raw(child.id() as i32) {
        // It fails if the process has already ended, which is the aim.
        let _ = kill_process(pid, Signal::TERM);
    }
}

/// Waits until a deadline for the end of a process, and then kills it.
pub(crate) fn end_by(child: &mut Child, deadline: Instant) {
    while matches!(child.try_wait(), Ok(None)) {
        if Instant::now() >= deadline {
            let _ = child.kill();
            let _ = child.wait();
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Ends this helper when its parent dies.
pub(crate) fn end_with_parent() -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot watch the parent process")
}

/// Reports from this helper that it is ready.
pub(crate) fn say_ready() -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    out.write_all(READY)?;
    Ok(out.flush()?)
}

/// Returns the processor time of a process, user and system, seconds; 0 if the process does not exist.
pub(crate) fn cpu_seconds(pid: u32) -> f64 {
    let of = || {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        // The process's name may contain anything. After its bracket, user and system time are the 12th and 13th.
        let (_, rest) = stat.rsplit_once(')')?;
        Some(rest.split_whitespace().skip(11).take(2).filter_map(|v| v.parse::<f64>().ok()).sum::<f64>())
    };
    of().unwrap_or(0.0) / TICKS_PER_S
}
