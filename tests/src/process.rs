//! A watched program: its output, its exit status, and its end if it hangs.

use crate::{WATCHDOG, eventually};
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// A running program. Dropping it kills it.
#[derive(Debug)]
pub struct Process {
    child: Child,
    text: Arc<Mutex<String>>,
    readers: Vec<JoinHandle<()>>,
}

/// A program that has ended.
#[derive(Clone, Debug)]
pub struct Finished {
    /// Exit status of the program.
    pub status: ExitStatus,
    /// Complete output: standard output and error in their order of arrival.
    pub text: String,
}

impl Process {
    /// Starts a program, and reads its output so that it never blocks.
    pub fn start(command: &mut Command) -> Self {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap_or_else(|e| panic!("cannot start {command:?}: {e}"));
        let text = Arc::new(Mutex::new(String::new()));
        let stdout = read(child.stdout.take().unwrap(), text.clone());
        let stderr = read(child.stderr.take().unwrap(), text.clone());
        Self { child, text, readers: vec![stdout, stderr] }
    }

    /// Returns its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns its output so far.
    pub fn text(&self) -> String {
        self.text.lock().unwrap().clone()
    }

    /// Waits until its output satisfies a condition; fails if it ends before, or at the watchdog's limit.
    pub fn wait_for(&mut self, what: &str, mut holds: impl FnMut(&str) -> bool) {
        let mut ended = false;
        let seen = eventually(|| {
            // Read in this order, so that the last output of an ended program is included.
            ended = self.child.try_wait().unwrap().is_some();
            if ended {
                self.readers.drain(..).for_each(|reader| reader.join().unwrap());
            }
            holds(&self.text()) || ended
        });
        let text = self.text();
        assert!(seen, "no {what} within {WATCHDOG:?}:\n{text}");
        assert!(holds(&text), "it ended without {what}:\n{text}");
    }

    /// Returns true if it has a handler for a signal.
    pub fn catches(&self, signal: Signal) -> bool {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.id())).unwrap_or_default();
        let caught = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigCgt:")?.trim(), 16).ok());
        caught.unwrap_or(0) & (1 << (signal.as_raw() - 1)) != 0
    }

    /// Sends a signal to it.
    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_raw(self.child.id() as i32).unwrap(), signal).unwrap();
    }

    /// Waits for its end; fails at the watchdog's limit.
    pub fn end(mut self) -> Finished {
        let ended = eventually(|| self.child.try_wait().unwrap().is_some());
        if !ended {
            self.child.kill().unwrap();
        }
        let status = self.child.wait().unwrap();
        // Its own children may still hold its output.
        assert!(ended, "it did not end within {WATCHDOG:?}:\n{}", self.text());
        self.readers.drain(..).for_each(|reader| reader.join().unwrap());
        let text = self.text();
        Finished { status, text }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Both fail if it has already ended, which is fine.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Finished {
    /// Fails unless it ended with success.
    #[track_caller]
    pub fn assert_success(&self) {
        assert!(self.status.success(), "{}:\n{}", self.status, self.text);
    }

    /// Fails unless it ended with exit code 1 and one line that starts with `error:` and contains all these words; a
    /// panic does not count.
    #[track_caller]
    pub fn assert_one_error(&self, words: &[&str]) {
        assert_eq!(self.status.code(), Some(1), "{}:\n{}", self.status, self.text);
        let errors: Vec<&str> = self.text.lines().filter(|line| line.starts_with("error:")).collect();
        assert_eq!(errors.len(), 1, "one error is expected:\n{}", self.text);
        for word in words {
            assert!(errors[0].contains(word), "`{word}` is missing in: {}\nin all:\n{}", errors[0], self.text);
        }
        assert!(!self.text.contains("panicked at"), "{}", self.text);
    }
}

fn read(stream: impl Read + Send + 'static, text: Arc<Mutex<String>>) -> JoinHandle<()> {
    std::thread::spawn(move || {
        let mut line = Vec::new();
        let mut stream = BufReader::new(stream);
        while stream.read_until(b'\n', &mut line).is_ok_and(|n| n > 0) {
            text.lock().unwrap().push_str(&String::from_utf8_lossy(&line));
            line.clear();
        }
    })
}
