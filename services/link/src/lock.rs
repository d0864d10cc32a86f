//! One process for a run: the record of it, locked.
//!
//! The same as the launcher's (launch/src/lock.rs), written again here: that one lives with the whole program, which this
//! package is apart from.

use anyhow::{Context, bail, ensure};
use carff_observe::RunRecord;
use carff_transport::{Run, living_processes, make_private_dir, monotonic_now_ns, remove_run_leftovers};
use rustix::fs::{FlockOperation, OFlags, flock};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How long processes of an earlier run of this name are given to end.
const PATIENCE_NS: u64 = 3_000_000_000;

/// Held while the run runs. The system frees it when the process ends, however it ends.
#[derive(Debug)]
pub struct RunLock {
    path: PathBuf,
    _file: File,
}

impl RunLock {
    /// Takes the lock of a run in a folder, or says that somebody holds it.
    pub fn take(folder: &Path, run: &str, record: &RunRecord) -> anyhow::Result<Self> {
        make_private_dir(folder)?;
        let path = RunRecord::path(folder, run);
        loop {
            let mut file = OpenOptions::new()
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .custom_flags(OFlags::NOFOLLOW.bits() as i32)
                .open(&path)
                .with_context(|| format!("cannot open {}", path.display()))?;
            if flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
                bail!("run `{run}` is already running here: stop it, or give this one another name with --as");
            }
            // Whoever held it before may have removed the file in between: then this lock is on a file without a name.
            let same =
                std::fs::metadata(&path).is_ok_and(|named| file.metadata().is_ok_and(|held| named.ino() == held.ino()));
            if same {
                file.set_len(0)?;
                file.write_all(&record.to_bytes()?)?;
                return Ok(Self { path, _file: file });
            }
        }
    }
}

impl Drop for RunLock {
    fn drop(&mut self) {
        // While the lock is held, the name is ours to remove.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Removes what an earlier run of this name left, once its processes have ended. Only for whoever holds the lock.
pub fn sweep(run: &Run) -> anyhow::Result<()> {
    let patience_ns = monotonic_now_ns() + PATIENCE_NS;
    while run.folder().is_dir() {
        let living = living_processes(run)?;
        if living.is_empty() {
            break;
        }
        ensure!(
            monotonic_now_ns() < patience_ns,
            "processes {living:?} of an earlier run `{}` still live: stop them, or give this one another name with --as",
            run.name()
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(remove_run_leftovers(run)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A second taker is refused; once the lock is dropped it can be taken, and no file is left.
    #[test]
    fn one_process_for_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let (graph, dataset, checkpoint) = ("g.toml".to_owned(), "d".to_owned(), "c".to_owned());
        let record = RunRecord { pid: 4711, run_id: 1, graph, dataset, checkpoint, started_unix_s: 0 };
        let held = RunLock::take(folder.path(), "a", &record).unwrap();
        let written = std::fs::read(RunRecord::path(folder.path(), "a")).unwrap();
        assert_eq!(RunRecord::from_bytes(&written).as_ref(), Some(&record));
        let refused = RunLock::take(folder.path(), "a", &record).unwrap_err().to_string();
        assert!(refused.contains("`a` is already running") && refused.contains("--as"), "{refused}");
        drop(held);
        drop(RunLock::take(folder.path(), "a", &record).unwrap());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
