//! One launcher for a run: a locked file that says who.

use anyhow::{Context, bail};
use carff_observe::RunRecord;
use carff_transport::make_private_dir;
use rustix::fs::{FlockOperation, OFlags, flock};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// Held while a run runs. The system frees it when the process ends, however it ends.
#[derive(Debug)]
pub struct RunLock {
    path: PathBuf,
    _file: File,
}

impl RunLock {
    /// Takes the lock of a run in a folder, or says who holds it.
    pub fn take(folder: &Path, run: &str, record: &RunRecord) -> anyhow::Result<Self> {
        make_private_dir(folder)?;
        let path = RunRecord::path(folder, run);
        loop {
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .custom_flags(OFlags::NOFOLLOW.bits() as i32)
                .open(&path)
                .with_context(|| format!("cannot open {}", path.display()))?;
            if flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
                let holder = std::fs::read(&path).ok().and_then(|bytes| RunRecord::from_bytes(&bytes));
                match holder {
                    Some(holder) => bail!(
                        "run `{run}` is already running (process {}, graph {}): stop it, or give this one another name \
                         with --run",
                        holder.pid,
                        holder.graph
                    ),
                    None => bail!("run `{run}` is already running: stop it, or give this one another name with --run"),
                }
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A second taker is told who holds the lock; once it is dropped, it can be taken, and no file is left.
    #[test]
    fn one_launcher_for_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let record = RunRecord {
            pid: 4711,
            run_id: 1,
            graph: "g.toml".into(),
            dataset: "d".into(),
            checkpoint: "c".into(),
            started_unix_s: 0,
        };
        let held = RunLock::take(folder.path(), "a", &record).unwrap();
        let error = RunLock::take(folder.path(), "a", &record).unwrap_err().to_string();
        assert!(
            error.contains("`a` is already running") && error.contains("4711") && error.contains("--run"),
            "{error}"
        );
        let other = RunLock::take(folder.path(), "b", &record).unwrap();
        drop(held);
        drop(RunLock::take(folder.path(), "a", &record).unwrap());
        drop(other);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
