//! Ownership of a run: its locked record, and the removal of an earlier owner's leftovers.

use crate::RunRecord;
use carff_transport::{
    CleanupError, OpenError, Run, living_processes, make_private_dir, monotonic_now_ns, remove_run_leftovers,
};
use rustix::fs::{FlockOperation, OFlags, flock};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Longest wait for processes of an earlier owner, nanoseconds: the stages of a killed launcher end by themselves after
/// a moment.
const ORPHAN_PATIENCE_NS: u64 = 2_000_000_000;
/// Interval between two checks of these processes.
const ORPHAN_LOOK: Duration = Duration::from_millis(20);

/// Number of attempts to take a lock.
const LOOKS: u32 = 5;

/// Returns true if a process holds the lock of this record, in any namespace of processes.
pub(crate) fn is_held(record: &Path) -> bool {
    File::open(record).is_ok_and(|file| flock(&file, FlockOperation::NonBlockingLockShared).is_err())
}

/// Reason why a run cannot be owned.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another process owns the run.
    #[error("run `{run}` is already running{}: stop it, or use another name with {option}", who(.holder.as_deref()))]
    Held {
        /// Name of the run.
        run: String,
        /// Record of its owner, if it can be read.
        holder: Option<Box<RunRecord>>,
        /// Option that names a run.
        option: &'static str,
    },
    /// Processes of an earlier owner have not ended.
    #[error(
        "processes {living:?} of an earlier launch of run `{run}` are still alive: stop them, or use another name \
         with {option}"
    )]
    Orphans {
        /// Name of the run.
        run: String,
        /// Process ids of these processes.
        living: Vec<u32>,
        /// Option that names a run.
        option: &'static str,
    },
    /// The record cannot be opened or written.
    #[error("cannot write {path}: {source}")]
    Record {
        /// Path of the record.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The folder of all runs cannot be used.
    #[error(transparent)]
    Folder(#[from] OpenError),
    /// Leftovers of an earlier owner cannot be removed.
    #[error(transparent)]
    Cleanup(#[from] CleanupError),
}

fn who(holder: Option<&RunRecord>) -> String {
    holder.map(|h| format!(" (process {}, graph {})", h.pid, h.graph)).unwrap_or_default()
}

/// The lock of a running run. The system frees it when the process ends in any way.
#[derive(Debug)]
pub struct RunLock {
    path: PathBuf,
    _file: File,
}

impl RunLock {
    /// Takes the lock of a run in the folder of all runs ([`carff_transport::runtime_dir`]) and writes the record, or
    /// returns an error that names the holder. `option` is this program's option that names a run.
    pub fn take(folder: &Path, run: &str, record: &RunRecord, option: &'static str) -> Result<Self, LockError> {
        make_private_dir(folder)?;
        let path = RunRecord::path(folder, run);
        let failed = |source| LockError::Record { path: path.clone(), source };
        loop {
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .custom_flags(OFlags::NOFOLLOW.bits() as i32)
                .open(&path)
                .map_err(failed)?;
            // Probes look at a lock by taking it for a moment.
            let is_free = (0..LOOKS).any(|look| {
                std::thread::sleep(ORPHAN_LOOK * look.min(1));
                flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok()
            });
            if !is_free {
                let holder = std::fs::read(&path).ok().and_then(|bytes| RunRecord::from_bytes(&bytes)).map(Box::new);
                return Err(LockError::Held { run: run.to_owned(), holder, option });
            }
            // An earlier holder may have removed the file in between: then this lock is on a deleted file.
            let same =
                std::fs::metadata(&path).is_ok_and(|named| file.metadata().is_ok_and(|held| named.ino() == held.ino()));
            if same {
                let bytes = record.to_bytes().map_err(|e| failed(std::io::Error::other(e)))?;
                file.set_len(0).and_then(|()| file.write_all(&bytes)).map_err(failed)?;
                return Ok(Self { path, _file: file });
            }
        }
    }

    /// Checks that no process of an earlier owner of the run is alive, and removes its leftovers.
    pub fn sweep(&self, run: &Run, option: &'static str) -> Result<(), LockError> {
        let patience_ns = monotonic_now_ns() + ORPHAN_PATIENCE_NS;
        loop {
            // Processes whose folder a cleaner of temporary files has removed still map the shared memory.
            let mut living = if run.folder().is_dir() { living_processes(run)? } else { Vec::new() };
            living.extend(run.mapping_processes());
            living.sort_unstable();
            living.dedup();
            living.retain(|&pid| pid != std::process::id());
            if living.is_empty() {
                break;
            }
            if monotonic_now_ns() >= patience_ns {
                return Err(LockError::Orphans { run: run.name().to_owned(), living, option });
            }
            std::thread::sleep(ORPHAN_LOOK);
        }
        Ok(remove_run_leftovers(run)?)
    }
}

impl Drop for RunLock {
    fn drop(&mut self) {
        // While the lock is held, this process may remove the name.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A second taker gets an error with the holder of the lock and the option for another name. After a drop the lock
    /// is free, and no file is left. While it is held, the record is readable.
    #[test]
    fn one_owner_for_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let (graph, dataset, checkpoint) = ("g.toml".to_owned(), "d".to_owned(), "c".to_owned());
        let record = RunRecord { pid: 4711, run_id: 1, graph, dataset, checkpoint, started_unix_s: 0 };
        let take = |run: &str| RunLock::take(folder.path(), run, &record, "--run");
        let held = take("a").unwrap();
        let written = std::fs::read(RunRecord::path(folder.path(), "a")).unwrap();
        assert_eq!(RunRecord::from_bytes(&written).as_ref(), Some(&record));
        let error = take("a").unwrap_err().to_string();
        assert!(
            error.contains("`a` is already running") && error.contains("4711") && error.contains("--run"),
            "{error}"
        );
        let other = take("b").unwrap();
        drop(held);
        drop(take("a").unwrap());
        drop(other);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
