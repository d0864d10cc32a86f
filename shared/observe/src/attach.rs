//! Lists living runs, and joins one of them.

use crate::RunRecord;
use carff_transport::{Node, OpenError, Run, RunNameError, runtime_dir};
use std::path::{Path, PathBuf};

/// A run with a living launcher.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LiveRun {
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
        living(&runtime_dir(), &self.name).is_some_and(|run| run.run_id == self.run_id)
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

/// Returns the living runs of this user, by name.
pub fn runs() -> Result<Vec<LiveRun>, AttachError> {
    let folder = runtime_dir();
    let entries = match std::fs::read_dir(&folder) {
        Ok(entries) => entries,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(source) => return Err(AttachError::Folder { path: folder, source }),
    };
    let mut runs: Vec<LiveRun> = entries
        .flatten()
        .filter_map(|entry| living(&folder, entry.file_name().to_str()?.strip_suffix(".run")?))
        .collect();
    runs.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(runs)
}

/// Joins the named run, or the only living one, as `node_name`.
pub fn attach(run: Option<&str>, node_name: &str) -> Result<Attached, AttachError> {
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
    let live = living.swap_remove(index);
    let node = Node::open(&Run::new(&live.name, live.run_id)?, node_name)?;
    Ok(Attached { node, live })
}

/// Returns the run of a name if its launcher is alive. The record of a killed launcher names a process that does not
/// exist, or that is not a launcher.
fn living(folder: &Path, name: &str) -> Option<LiveRun> {
    let record = RunRecord::from_bytes(&std::fs::read(RunRecord::path(folder, name)).ok()?)?;
    let started = Path::new("/proc").join(record.pid.to_string());
    started.exists().then(|| LiveRun {
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

    fn record(pid: u32) -> RunRecord {
        let (graph, dataset, checkpoint) = ("g.toml".to_owned(), "d".to_owned(), "c".to_owned());
        RunRecord { pid, run_id: 9, graph, dataset, checkpoint, started_unix_s: 5 }
    }

    /// A record of a living launcher is a run; a record of an ended process, and garbage, are not.
    #[test]
    fn only_living_launchers_count() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, bytes: &[u8]| std::fs::write(RunRecord::path(folder.path(), name), bytes).unwrap();
        write("lives", &record(std::process::id()).to_bytes().unwrap());
        // No process has the largest number.
        write("killed", &record(u32::MAX).to_bytes().unwrap());
        write("garbage", b"?");
        assert_eq!(living(folder.path(), "lives").map(|r| r.run_id), Some(9));
        for name in ["killed", "garbage", "missing"] {
            assert_eq!(living(folder.path(), name), None, "{name}");
        }
    }
}
