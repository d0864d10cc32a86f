//! Namespaces: each run has its own folder and prefix in shared memory, so that runs never see each other.

use crate::folder::{self, runtime_dir};
use crate::space::SHARED_MEMORY_DIR;
use crate::{CleanupError, RunNameError, Service};
use iceoryx2::node::NodeView;
use iceoryx2::prelude::{CallbackProgression, Config, FileName, NodeState, Path as IoxPath, SemanticString};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Maximum length of a run name: longer names would make the paths of wake-up sockets exceed the system's 107 bytes.
const MAX_NAME_BYTES: usize = 24;

/// Longest wait for another thread or process that is also cleaning up.
pub(crate) const CLEANUP_PATIENCE: Duration = Duration::from_millis(500);

/// Number of attempts to read the list of nodes, and the pause in between.
const LIST_TRIES: u32 = 10;
const LIST_PAUSE: Duration = Duration::from_millis(2);

/// A run of a graph: its name, which is part of its file names, and its id, which is in every header.
///
/// ```
/// use carff_transport::Run;
/// let run = Run::new("crossing-2", 0x5eed)?;
/// assert!(run.folder().ends_with("crossing-2"));
/// assert!(Run::new("with/slash", 1).is_err());
/// # Ok::<(), carff_transport::RunNameError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Run {
    dir: PathBuf,
    name: String,
    id: u64,
}

impl Run {
    /// Creates a run from name and id, in the folder of this user's new runs. All processes of a run must use the same
    /// values.
    pub fn new(name: &str, id: u64) -> Result<Self, RunNameError> {
        Self::within(&runtime_dir(), name, id)
    }

    /// Creates a run in one of [`crate::runtime_dirs`].
    pub fn within(dir: &Path, name: &str, id: u64) -> Result<Self, RunNameError> {
        let fits = (1..=MAX_NAME_BYTES).contains(&name.len())
            && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
        if fits {
            Ok(Self { dir: dir.to_owned(), name: name.to_owned(), id })
        } else {
            Err(RunNameError { name: name.to_owned() })
        }
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the id.
    pub fn id(&self) -> u64 {
        self.id
    }

    /// Returns the folder of the run's small files. It exists while the run does.
    pub fn folder(&self) -> PathBuf {
        self.dir.join(&self.name)
    }

    /// Returns the folder that contains the run's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Makes the files of a living run young again, also those next to its folder: its record, its log and the copy of
    /// its graph file. Call it about once an hour: some cleaners of temporary files go by age only.
    pub fn refresh(&self) {
        folder::refresh(&self.folder());
        let begin = format!("{}.", self.name);
        let beside = std::fs::read_dir(&self.dir).into_iter().flatten().flatten();
        beside
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&begin))
            .for_each(|entry| folder::refresh(&entry.path()));
    }

    /// Returns true if a process that has joined the run and is alive cannot be found any more, because a cleaner has
    /// removed the run's folder or files in it. Then no other process can join.
    pub fn has_lost(&self, pid: u32) -> bool {
        !self.folder().is_dir() || living_processes(self).is_ok_and(|living| !living.contains(&pid))
    }

    /// Returns the processes that map the run's shared memory, also if its folder is gone.
    pub fn mapping_processes(&self) -> Vec<u32> {
        folder::mapping_processes(&self.shared_memory_prefix())
    }

    /// Returns the prefix of the run's files in shared memory.
    pub fn shared_memory_prefix(&self) -> String {
        format!("carff{:08x}_", fnv1a(self.folder().as_os_str().as_encoded_bytes()) as u32)
    }

    /// Returns the run's current files in shared memory.
    pub fn shared_memory_files(&self) -> std::io::Result<Vec<PathBuf>> {
        let prefix = self.shared_memory_prefix();
        let mut files = Vec::new();
        for entry in std::fs::read_dir(SHARED_MEMORY_DIR)? {
            let entry = entry?;
            if entry.file_name().to_string_lossy().starts_with(&prefix) {
                files.push(entry.path());
            }
        }
        Ok(files)
    }

    /// Allocates memory for all of the run's files in shared memory at their full size. Otherwise the system allocates
    /// each page at its first write, and ends the writer (SIGBUS) if no memory is left.
    pub fn reserve_shared_memory(&self) -> std::io::Result<()> {
        for path in self.shared_memory_files()? {
            // A removed file needs no memory, and another user's file is not this run's.
            let Ok(file) = std::fs::OpenOptions::new().read(true).write(true).open(&path) else { continue };
            let bytes = file.metadata()?.len();
            if bytes > 0 {
                rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, bytes)?;
            }
        }
        Ok(())
    }

    pub(crate) fn config(&self) -> Result<Config, String> {
        let mut config = Config::default();
        config.global.prefix =
            FileName::new(self.shared_memory_prefix().as_bytes()).map_err(|e| format!("prefix: {e:?}"))?;
        let folder = self.folder();
        let folder = IoxPath::new(folder.as_os_str().as_encoded_bytes()).map_err(|e| format!("folder: {e:?}"))?;
        config.global.set_root_path(&folder);
        Ok(config)
    }
}

/// Returns a run's id from its name and start time.
pub fn run_id_of(name: &str, start_ns: u64) -> u64 {
    let mut bytes = name.as_bytes().to_vec();
    bytes.extend_from_slice(&start_ns.to_le_bytes());
    fnv1a(&bytes)
}

/// Removes leftovers of dead processes of a living run. Returns the number of processes. Reap dead children first: a
/// zombie counts as alive.
pub fn cleanup_dead(run: &Run) -> Result<u32, CleanupError> {
    crate::log::quiet();
    let failed = |cause: String| CleanupError::List { run: run.name.clone(), cause };
    let config = run.config().map_err(failed)?;
    let mut cleaned = 0;
    for node in nodes(run, &config).map_err(failed)? {
        if let NodeState::Dead(dead) = node
            && dead.blocking_remove_stale_resources(CLEANUP_PATIENCE).is_ok()
        {
            cleaned += 1;
        }
    }
    Ok(cleaned)
}

/// Returns the living processes of a run.
pub fn living_processes(run: &Run) -> Result<Vec<u32>, CleanupError> {
    let mut living: Vec<u32> = living_nodes(run)?.into_iter().map(|(_, pid)| pid).collect();
    living.dedup();
    Ok(living)
}

/// Returns the living members of a run in order of their process: the name under which each has joined, and its
/// process. A process whose threads have nodes of one name is one member.
pub fn living_nodes(run: &Run) -> Result<Vec<(String, u32)>, CleanupError> {
    crate::log::quiet();
    let failed = |cause: String| CleanupError::List { run: run.name.clone(), cause };
    let config = run.config().map_err(failed)?;
    let living = nodes(run, &config).map_err(failed)?.into_iter().filter_map(|node| match node {
        NodeState::Alive(node) => {
            node.details().as_ref().map(|d| (d.name().as_str().to_owned(), d.process_id().value() as u32))
        }
        _ => None,
    });
    let mut living: Vec<_> = living.collect();
    living.sort_by(|a, b| (a.1, &a.0).cmp(&(b.1, &b.0)));
    living.dedup();
    Ok(living)
}

/// Returns all nodes of a run, including dead ones; empty if its folder does not exist. iceoryx2 fails if a file or the
/// folder disappears while it reads the list, which happens when processes end: then the list is read again.
pub(crate) fn nodes(run: &Run, config: &Config) -> Result<Vec<NodeState<Service>>, String> {
    let mut tries = 0;
    loop {
        let mut nodes = Vec::new();
        let listed = iceoryx2::node::Node::<Service>::list(config, |node| {
            nodes.push(node);
            CallbackProgression::Continue
        });
        tries += 1;
        match listed {
            Ok(()) => return Ok(nodes),
            Err(_) if !run.folder().is_dir() => return Ok(Vec::new()),
            Err(error) if tries == LIST_TRIES => return Err(error.to_string()),
            Err(_) => std::thread::sleep(LIST_PAUSE),
        }
    }
}

/// Removes all files of a run. Call it only when no process of the run is alive.
pub fn remove_run_leftovers(run: &Run) -> Result<(), CleanupError> {
    let gone = |path: &Path, result: std::io::Result<()>| match result {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(CleanupError::Remove { path: path.to_owned(), source })
        }
        _ => Ok(()),
    };
    let files =
        run.shared_memory_files().map_err(|source| CleanupError::Remove { path: SHARED_MEMORY_DIR.into(), source })?;
    for file in files {
        gone(&file, std::fs::remove_file(&file))?;
    }
    gone(&run.folder(), std::fs::remove_dir_all(run.folder()))
}

/// Returns the FNV-1a hash, which is stable over builds and machines.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &b| (hash ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Names that would leave the run's folder or exceed path limits are refused.
    #[test]
    fn names_are_plain_and_short() {
        for name in ["", "a/b", "..", "a b", "ü", &"x".repeat(25)] {
            assert!(Run::new(name, 0).is_err(), "{name}");
        }
        assert!(Run::new(&"x".repeat(24), 0).is_ok());
    }

    /// Two runs differ in folder and prefix; no prefix is the start of another.
    #[test]
    fn runs_are_apart() {
        let (a, b) = (Run::new("run", 0).unwrap(), Run::new("run2", 0).unwrap());
        assert_ne!(a.folder(), b.folder());
        assert_ne!(a.shared_memory_prefix(), b.shared_memory_prefix());
        assert_eq!(a.shared_memory_prefix().len(), b.shared_memory_prefix().len());
        assert_ne!(run_id_of("run", 1), run_id_of("run", 2));
    }
}
