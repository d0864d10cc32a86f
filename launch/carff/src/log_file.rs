//! A log file of limited size: one earlier file is kept.

use std::fs::{File, OpenOptions};
use std::io::{Result, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// Size at which a new file begins, bytes.
const LIMIT_BYTES: u64 = 4 << 20;

/// The log file of a run.
#[derive(Debug)]
pub(crate) struct LogFile {
    path: PathBuf,
    file: File,
    bytes: u64,
}

impl LogFile {
    /// Creates the file; an earlier one is replaced.
    pub(crate) fn create(path: &Path) -> Result<Self> {
        let file = OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(path)?;
        Ok(Self { path: path.to_owned(), file, bytes: 0 })
    }

    /// Adds a line.
    pub(crate) fn line(&mut self, text: &str) -> Result<()> {
        if self.bytes >= LIMIT_BYTES {
            std::fs::rename(&self.path, self.path.with_extension("log.1"))?;
            *self = Self::create(&self.path)?;
        }
        self.bytes += text.len() as u64 + 1;
        writeln!(self.file, "{text}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Old lines go to one earlier file, so that a log of any length fits into twice the limit.
    #[test]
    fn a_log_is_limited() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.log");
        let mut log = LogFile::create(&path).unwrap();
        let line = "x".repeat(1 << 20);
        (0..11).for_each(|_| log.line(&line).unwrap());
        let size = |path: &Path| path.metadata().unwrap().len();
        assert!(size(&path) <= LIMIT_BYTES + (1 << 21) && size(&path.with_extension("log.1")) >= LIMIT_BYTES);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
    }
}
