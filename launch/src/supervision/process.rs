//! A child process of the launcher.

use anyhow::Context;
use carff::log_line;
use carff::terminal::Terminal;
use carff_messages::Stage;
use carff_runtime::StageArgs;
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// Maximum length of a relayed line; longer lines are cut.
const MAX_LINE_BYTES: u64 = 4096;

/// A stage's process, with its log relayed.
#[derive(Debug)]
pub(crate) struct StageProcess {
    child: Child,
    relay: Option<JoinHandle<()>>,
    /// The last log line that reported an error.
    last_error: Arc<Mutex<Option<String>>>,
}

impl StageProcess {
    /// Starts the process. Call this from the main thread: the child ends with the thread that started it.
    pub(crate) fn start(
        stage: Stage,
        program: &Path,
        args: &StageArgs,
        terminal: &Arc<Terminal>,
    ) -> anyhow::Result<Self> {
        let build = match program.file_name().and_then(|name| name.to_str()) {
            Some(name @ ("carff-camera-rtsp" | "carff-camera-gst")) => format!("make {}", &name["carff-".len()..]),
            _ => "cargo build --release".to_owned(),
        };
        let mut child = Command::new(program)
            .args(args.to_command_line())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Only the launcher receives Ctrl-C; it ends the stages in order.
            .process_group(0)
            .spawn()
            .with_context(|| format!("cannot start {}; build it with `{build}`", program.display()))?;
        let last_error = Arc::new(Mutex::new(None));
        let stderr = child.stderr.take().context("the child's standard error is missing")?;
        let (terminal, noted) = (terminal.clone(), last_error.clone());
        let relay = std::thread::Builder::new().name(format!("log-{stage}")).spawn(move || {
            relay_lines(BufReader::new(stderr), |line| {
                let line = line.trim_end();
                if let (Some(error), Ok(mut noted)) = (log_line::error_in(line), noted.lock()) {
                    *noted = Some(error);
                }
                terminal.log(stage.name(), line);
            });
        })?;
        Ok(Self { child, relay: Some(relay), last_error })
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the exit status if the process has ended. Reaps it, because locks of a zombie would still count.
    pub(crate) fn ended(&mut self) -> anyhow::Result<Option<ExitStatus>> {
        let status = self.child.try_wait().context("cannot watch a stage")?;
        if status.is_some()
            && let Some(relay) = self.relay.take()
        {
            // Its last log lines are printed before its end is reported.
            let _ = relay.join();
        }
        Ok(status)
    }

    /// Returns the last error that it logged.
    pub(crate) fn last_error(&self) -> Option<String> {
        self.last_error.lock().ok()?.clone()
    }

    /// Asks the process to end.
    pub(crate) fn terminate(&self) {
        if let Some(pid) = Pid::from_raw(self.child.id() as i32) {
            // A failure means that the process has already ended.
            let _ = kill_process(pid, Signal::TERM);
            // A stopped process must continue to receive the signal.
            let _ = kill_process(pid, Signal::CONT);
        }
    }

    /// Kills the process.
    pub(crate) fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for StageProcess {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            self.kill();
        }
        if let Some(relay) = self.relay.take() {
            let _ = relay.join();
        }
    }
}

/// Calls `each` for each line, in any encoding, cut at a limit, until the end.
fn relay_lines(mut input: impl BufRead, mut each: impl FnMut(&str)) {
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut input).take(MAX_LINE_BYTES).read_until(b'\n', &mut line) {
            Ok(0) | Err(_) => return,
            Ok(_) => each(&String::from_utf8_lossy(&line)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Lines arrive one by one; long lines in pieces, broken encodings as replacement characters.
    #[test]
    fn lines_are_relayed_whatever_they_are() {
        let mut text = b"one\ntwo \xff\n".to_vec();
        text.extend(std::iter::repeat_n(b'x', MAX_LINE_BYTES as usize + 5));
        let mut lines = Vec::new();
        relay_lines(text.as_slice(), |line| lines.push(line.trim_end().to_owned()));
        assert_eq!(lines.len(), 4);
        assert_eq!((lines[0].as_str(), lines[1].as_str(), lines[3].as_str()), ("one", "two \u{fffd}", "xxxxx"));
    }
}
