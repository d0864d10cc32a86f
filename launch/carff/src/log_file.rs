//! Files of lines that a run writes: with a limited size, where one earlier file is kept, and read as they grow.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Result, Seek, SeekFrom, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Size at which a new file begins, bytes.
const LIMIT_BYTES: u64 = 4 << 20;

/// Returns the path of the earlier file.
pub(crate) fn earlier(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".1");
    name.into()
}

/// A file of lines with a limited size, such as the log of a run.
#[derive(Debug)]
pub(crate) struct LogFile {
    path: PathBuf,
    file: File,
    bytes: u64,
}

impl LogFile {
    /// Creates the file; those of an earlier run are replaced.
    pub(crate) fn create(path: &Path) -> Result<Self> {
        match std::fs::remove_file(earlier(path)) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
            _ => Self::begin(path),
        }
    }

    fn begin(path: &Path) -> Result<Self> {
        let file = OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(path)?;
        Ok(Self { path: path.to_owned(), file, bytes: 0 })
    }

    /// Adds a line, or several at once.
    pub(crate) fn line(&mut self, text: &str) -> Result<()> {
        if self.bytes >= LIMIT_BYTES {
            std::fs::rename(&self.path, earlier(&self.path))?;
            *self = Self::begin(&self.path)?;
        }
        self.bytes += text.len() as u64 + 1;
        writeln!(self.file, "{text}")
    }
}

/// Reads the log file of a run as it grows, also across the start of the next file.
#[derive(Debug)]
pub(crate) struct LogTail {
    path: PathBuf,
    file: File,
    /// Start of a line whose end is not written yet.
    begun: Vec<u8>,
}

impl LogTail {
    /// Opens the file, to read it from its start.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        Ok(Self { path: path.to_owned(), file: File::open(path)?, begun: Vec::new() })
    }

    /// Opens the file, to read what is written from now on.
    #[cfg_attr(not(feature = "recording"), allow(dead_code, reason = "recorder and bridge use it"))]
    pub(crate) fn open_at_end(path: &Path) -> Result<Self> {
        let mut tail = Self::open(path)?;
        tail.file.seek(SeekFrom::End(0))?;
        Ok(tail)
    }

    /// Returns the lines written since the last call, with their ends.
    pub(crate) fn read(&mut self) -> Result<String> {
        let mut text = std::mem::take(&mut self.begun);
        // Looked up before the last lines are read: nothing is written to a file that has another name.
        let current = std::fs::metadata(&self.path).map(|m| m.ino());
        self.file.read_to_end(&mut text)?;
        if current.is_ok_and(|inode| self.file.metadata().is_ok_and(|m| m.ino() != inode)) {
            self.file = File::open(&self.path)?;
            self.file.read_to_end(&mut text)?;
        }
        let end = text.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
        self.begun = text.split_off(end);
        Ok(String::from_utf8_lossy(&text).into_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Old lines go to one earlier file, so that a log of any length fits into twice the limit. A new log has none.
    #[test]
    fn a_log_is_limited() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.log");
        let mut log = LogFile::create(&path).unwrap();
        let line = "x".repeat(1 << 20);
        (0..11).for_each(|_| log.line(&line).unwrap());
        let size = |path: &Path| path.metadata().unwrap().len();
        assert!(size(&path) <= LIMIT_BYTES + (1 << 21) && size(&earlier(&path)) >= LIMIT_BYTES);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
        LogFile::create(&path).unwrap();
        assert!(size(&path) == 0 && !earlier(&path).exists());
    }

    /// A reader gets every line once and whole, also across the start of the next file.
    #[test]
    fn a_log_is_read_as_it_grows() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.log");
        let mut log = LogFile::create(&path).unwrap();
        log.line("before").unwrap();
        let (mut all, mut new) = (LogTail::open(&path).unwrap(), LogTail::open_at_end(&path).unwrap());
        assert_eq!((all.read().unwrap().as_str(), new.read().unwrap().as_str()), ("before\n", ""));
        write!(log.file, "half").unwrap();
        assert_eq!(new.read().unwrap(), "");
        log.line(" a line").unwrap();
        log.line(&"x".repeat(LIMIT_BYTES as usize)).unwrap();
        log.line("in the next file").unwrap();
        let read = new.read().unwrap();
        assert!(read.starts_with("half a line\nx") && read.ends_with("x\nin the next file\n"), "{}", read.len());
        assert_eq!(all.read().unwrap(), read);
        assert_eq!(new.read().unwrap(), "");
    }
}
