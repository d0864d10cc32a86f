//! Lists living runs, and joins one of them.

use crate::RunRecord;
use crate::lock::is_held;
use carff_transport::{Node, OpenError, Run, RunNameError, runtime_dirs};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// A run with a living launcher.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LiveRun {
    /// Folder of the user's runs that contains the run.
    pub dir: PathBuf,
    /// Name of the run.
    pub name: String,
    /// Id of the run, which is in every header.
    pub run_id: u64,
    /// Process id of the launcher.
    pub pid: u32,
    /// Path of the graph file.
    pub graph: PathBuf,
    /// Folder of the dataset.
    pub dataset: PathBuf,
    /// Folder of the trained models.
    pub checkpoint: PathBuf,
    /// Start time: seconds since 1970.
    pub started_unix_s: u64,
}

impl LiveRun {
    /// Returns true if its launcher is alive and still has this run.
    pub fn is_alive(&self) -> bool {
        living(&self.dir, &self.name).is_some_and(|run| run.run_id == self.run_id)
    }

    /// Returns true if the record or files of the run are gone although the launcher maps the run's shared memory: then
    /// nobody can join it.
    pub fn has_lost_files(&self) -> bool {
        let Ok(run) = Run::within(&self.dir, &self.name, self.run_id) else { return false };
        (!self.is_alive() || run.has_lost(self.pid)) && run.mapping_processes().contains(&self.pid)
    }
}

/// Reason why a run cannot be joined.
#[derive(Debug, thiserror::Error)]
pub enum AttachError {
    /// No graph is running.
    #[error("no graph is running: start one with `carff launch` (as the same user: other users' runs are hidden)")]
    NoRun,
    /// No run of this name is alive.
    #[error("no run `{name}` is alive; there {}", there_are(.living))]
    NoSuchRun {
        /// The requested name.
        name: String,
        /// Names of the living runs.
        living: Vec<String>,
    },
    /// Several runs are alive, and none was named.
    #[error("several graphs are running ({}): name one with --run", .living.join(", "))]
    Several {
        /// Names of the living runs.
        living: Vec<String>,
    },
    /// The name is not valid for a run.
    #[error(transparent)]
    Name(#[from] RunNameError),
    /// The folder of all runs cannot be read.
    #[error("cannot read {path}: {source}")]
    Folder {
        /// Path of the folder.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The transport could not join.
    #[error(transparent)]
    Open(#[from] OpenError),
}

fn there_are(names: &[String]) -> String {
    match names {
        [] => "is none".to_owned(),
        [one] => format!("is `{one}`"),
        many => format!("are {}", many.join(", ")),
    }
}

/// A run that has been joined. Dropping it leaves the run.
#[derive(Debug)]
pub struct Attached {
    /// Membership in the run, which opens topics.
    pub node: Node,
    /// The joined run.
    pub live: LiveRun,
}

/// Returns the living runs of this user in all [`runtime_dirs`], by name.
pub fn runs() -> Result<Vec<LiveRun>, AttachError> {
    let mut runs: Vec<LiveRun> = Vec::new();
    for folder in runtime_dirs() {
        match std::fs::read_dir(&folder) {
            Ok(entries) => runs.extend(
                entries
                    .flatten()
                    .filter_map(|entry| living(&folder, entry.file_name().to_str()?.strip_suffix(".run")?)),
            ),
            // Folders of other users, and folders that do not exist, contain no run of this user.
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::PermissionDenied) => {}
            Err(source) => return Err(AttachError::Folder { path: folder, source }),
        }
    }
    runs.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(runs)
}

/// Joins the named run, or the only living one, as `node_name`.
///
/// ```no_run
/// use carff_transport::topics;
/// let attached = carff_observe::attach(Some("crossing"), "my-probe")?;
/// let mut actions = attached.node.receiver(&topics::ACTION)?;
/// if let Some(action) = actions.newest()? {
///     println!("hazard {:.2}", action.hazard_probability);
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn attach(run: Option<&str>, node_name: &str) -> Result<Attached, AttachError> {
    let live = find(run)?;
    let node = Node::open(&Run::within(&live.dir, &live.name, live.run_id)?, node_name)?;
    Ok(Attached { node, live })
}

/// Returns the named run, or the only living one.
pub fn find(run: Option<&str>) -> Result<LiveRun, AttachError> {
    let mut living = runs()?;
    let names = || living.iter().map(|r| r.name.clone()).collect();
    let index = match (run, living.len()) {
        (Some(name), _) => living
            .iter()
            .position(|r| r.name == name)
            .ok_or_else(|| AttachError::NoSuchRun { name: name.to_owned(), living: names() })?,
        (None, 0) => return Err(AttachError::NoRun),
        (None, 1) => 0,
        (None, _) => return Err(AttachError::Several { living: names() }),
    };
    Ok(living.swap_remove(index))
}

/// Returns the run of a name if a launcher holds the lock of its record: process ids mean nothing in another namespace
/// or after a restart.
fn living(folder: &Path, name: &str) -> Option<LiveRun> {
    let path = RunRecord::path(folder, name);
    let record = RunRecord::from_bytes(&std::fs::read(&path).ok()?)?;
    is_held(&path).then(|| LiveRun {
        dir: folder.to_owned(),
        name: name.to_owned(),
        run_id: record.run_id,
        pid: record.pid,
        graph: record.graph.into(),
        dataset: record.dataset.into(),
        checkpoint: record.checkpoint.into(),
        started_unix_s: record.started_unix_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RunLock;

    fn record(pid: u32) -> RunRecord {
        let (graph, dataset, checkpoint) = ("g.toml".to_owned(), "d".to_owned(), "c".to_owned());
        RunRecord { pid, run_id: 9, graph, dataset, checkpoint, started_unix_s: 5 }
    }

    /// A locked record is a run, with any process id; a record without a lock is not, even if a process of its id
    /// lives; garbage is not.
    #[test]
    fn only_locked_records_count() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| RunRecord::path(folder.path(), name);
        // No process has the largest number, as if it lived in another namespace.
        let lock = RunLock::take(folder.path(), "lives", &record(u32::MAX), "--run").unwrap();
        std::fs::write(path("stale"), record(std::process::id()).to_bytes().unwrap()).unwrap();
        std::fs::write(path("garbage"), b"?").unwrap();
        assert_eq!(living(folder.path(), "lives").map(|r| r.run_id), Some(9));
        for name in ["stale", "garbage", "missing"] {
            assert_eq!(living(folder.path(), name), None, "{name}");
        }
        drop(lock);
        assert_eq!(living(folder.path(), "lives"), None);
    }
}
