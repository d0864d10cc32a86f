//! Lines and one status line on the terminal; only plain lines if the output is not a terminal.

use crate::log_file::LogFile;
use crate::log_line;
use carff_config::LogFormat;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{ErrorKind, IsTerminal, Write};
use std::path::Path;
use std::sync::{Mutex, OnceLock, PoisonError};

/// Drawings of the status line per second.
const STATUS_HZ: u8 = 5;

/// The terminal. Lines may come from several threads.
#[derive(Debug)]
pub struct Terminal {
    /// The status line, as wide as the terminal; hidden if the output is not a terminal.
    status: ProgressBar,
    colour: bool,
    /// Format of the log; text until it is set.
    format: OnceLock<LogFormat>,
    /// File of the log, where one was requested.
    log: Mutex<Option<LogFile>>,
    /// The first error of standard output, other than a closed pipe.
    failed: OnceLock<std::io::Error>,
}

impl Terminal {
    /// Creates the terminal from the process's streams. `NO_COLOR` and a dumb terminal turn colours off.
    pub fn new() -> Self {
        let dumb = std::env::var_os("TERM").is_none_or(|term| term == "dumb");
        let live = std::io::stdout().is_terminal() && std::io::stderr().is_terminal() && !dumb;
        let target = if live { ProgressDrawTarget::stderr_with_hz(STATUS_HZ) } else { ProgressDrawTarget::hidden() };
        let status = ProgressBar::with_draw_target(None, target);
        status.set_style(ProgressStyle::with_template("{wide_msg}").unwrap_or_else(|_| ProgressStyle::default_bar()));
        let colour = live && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
        Self { status, colour, format: OnceLock::new(), log: Mutex::default(), failed: OnceLock::new() }
    }

    /// Prints a line on standard output.
    pub fn line(&self, text: &str) {
        // An error must not end the run in the middle: `check` reports it.
        if let Err(error) = self.status.suspend(|| writeln!(std::io::stdout(), "{text}"))
            && error.kind() != ErrorKind::BrokenPipe
        {
            let _ = self.failed.set(error);
        }
    }

    /// Returns the first error of standard output. A closed pipe (`| head`) is not an error.
    pub fn check(self: std::sync::Arc<Self>) -> std::io::Result<()> {
        std::sync::Arc::into_inner(self).and_then(|mut terminal| terminal.failed.take()).map_or(Ok(()), Err)
    }

    /// Also writes the log to a file from now on.
    pub fn log_to(&self, path: &Path) -> std::io::Result<()> {
        *self.log.lock().unwrap_or_else(PoisonError::into_inner) = Some(LogFile::create(path)?);
        Ok(())
    }

    /// Sets the log's format, once.
    pub fn set_log_format(&self, format: LogFormat) {
        // A process runs one graph, so there is no second choice.
        let _ = self.format.set(format);
    }

    /// Prints a line of the log on standard error: its source (a stage or `launcher`) and its text, which starts with a
    /// level or is a JSON object.
    pub fn log(&self, source: &str, said: &str) {
        let format = self.format.get().copied().unwrap_or_default();
        let line = log_line::formatted(format, &jiff::Timestamp::now(), source, said);
        // A full disk must not disturb the run.
        let _ = self.log.lock().unwrap_or_else(PoisonError::into_inner).as_mut().map(|log| log.line(&line));
        self.note(&line);
    }

    /// Prints a line on standard error that is not part of the log.
    pub fn note(&self, text: &str) {
        // Without standard error nothing can be reported.
        let _ = self.status.suspend(|| writeln!(std::io::stderr(), "{text}"));
    }

    /// Sets the status line; empty removes it. It is cut at the terminal's width.
    pub fn status(&self, text: String) {
        if text.is_empty() {
            self.status.finish_and_clear();
            self.status.reset();
        } else if self.status.message() != text {
            self.status.set_message(text);
        }
    }

    /// Returns `text` in red or green if colours are enabled.
    pub fn alarm(&self, text: &str, red: bool) -> String {
        if self.colour { format!("\x1b[{}m{text}\x1b[0m", if red { 31 } else { 32 }) } else { text.to_owned() }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.status.finish_and_clear();
    }
}

impl Default for Terminal {
    fn default() -> Self {
        Self::new()
    }
}
