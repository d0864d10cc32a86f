//! Lines and one status line on the terminal; only plain lines if the output is not a terminal.

use crate::log_line;
use carff_config::LogFormat;
use std::io::{IsTerminal, Write};
use std::sync::{Mutex, OnceLock};

/// The terminal. Lines may come from several threads.
#[derive(Debug)]
pub struct Terminal {
    live: bool,
    colour: bool,
    status: Mutex<String>,
    /// Format of the log; text until it is set.
    format: OnceLock<LogFormat>,
}

impl Terminal {
    /// Creates the terminal from the process's streams. `NO_COLOR` turns colours off.
    pub fn new() -> Self {
        let live = std::io::stdout().is_terminal() && std::io::stderr().is_terminal();
        let colour = live && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
        Self { live, colour, status: Mutex::default(), format: OnceLock::new() }
    }

    /// Prints a line on standard output.
    pub fn line(&self, text: &str) {
        let status = self.lock();
        self.clear();
        // A closed pipe (`| head`) must not end the run in the middle.
        let _ = writeln!(std::io::stdout(), "{text}");
        self.draw(&status);
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
        self.note(&log_line::formatted(format, &jiff::Timestamp::now().to_string(), source, said));
    }

    /// Prints a line on standard error that is not part of the log.
    pub fn note(&self, text: &str) {
        let status = self.lock();
        self.clear();
        let _ = writeln!(std::io::stderr(), "{text}");
        self.draw(&status);
    }

    /// Sets the status line; empty removes it.
    pub fn status(&self, text: String) {
        let mut status = self.lock();
        *status = text;
        self.clear();
        self.draw(&status);
    }

    /// Returns `text` in red or green if colours are enabled.
    pub fn alarm(&self, text: &str, red: bool) -> String {
        if self.colour { format!("\x1b[{}m{text}\x1b[0m", if red { 31 } else { 32 }) } else { text.to_owned() }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, String> {
        self.status.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn clear(&self) {
        if self.live {
            let _ = write!(std::io::stderr(), "\r\x1b[K");
        }
    }

    fn draw(&self, status: &str) {
        if self.live && !status.is_empty() {
            // No wider than the narrowest usual terminal, because a wrapped line cannot be erased.
            let text: String = status.chars().take(118).collect();
            let _ = write!(std::io::stderr(), "{text}");
            let _ = std::io::stderr().flush();
        }
    }
}

impl Default for Terminal {
    fn default() -> Self {
        Self::new()
    }
}
