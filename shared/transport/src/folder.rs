//! The folder of this user's runs: its place, its protection from cleaners of temporary files, and its loss.

use rustix::fs::{FlockOperation, flock};
use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::SystemTime;

/// Longest path of the folder: the paths of wake-up sockets in it must fit into the system's 107 bytes.
const MAX_BYTES: usize = 30;
/// The folder of a service that systemd starts.
const SERVICE_DIR: &str = "/run/carff";

/// Returns the folder of this user's new runs: the first usable one of [`runtime_dirs`]. It stays the same for the life
/// of the process.
pub fn runtime_dir() -> PathBuf {
    static DIR: LazyLock<PathBuf> = LazyLock::new(|| {
        let dirs = runtime_dirs();
        dirs.iter().find(|dir| is_usable(dir)).or(dirs.last()).cloned().unwrap_or_default()
    });
    DIR.clone()
}

/// Returns all folders in which a run of this user may be, in the order of preference: `$RUNTIME_DIRECTORY`,
/// `$XDG_RUNTIME_DIR/carff`, `$TMPDIR/carff-UID`, `/run/carff`, `/tmp/carff-UID`. A path of more than 30 bytes is left
/// out, because the paths of sockets are limited.
pub fn runtime_dirs() -> Vec<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let of_user = format!("carff-{}", rustix::process::getuid().as_raw());
    let service = folder("RUNTIME_DIRECTORY").map(|dirs| first_of_list(&dirs));
    let dirs = [
        service,
        folder("XDG_RUNTIME_DIR").map(|dir| dir.join("carff")),
        folder("TMPDIR").map(|dir| dir.join(&of_user)),
        Some(SERVICE_DIR.into()),
        Some(Path::new("/tmp").join(&of_user)),
    ];
    let mut found: Vec<PathBuf> = Vec::new();
    for dir in dirs.into_iter().flatten() {
        if dir.is_absolute() && dir.as_os_str().len() <= MAX_BYTES && !found.contains(&dir) {
            found.push(dir);
        }
    }
    found
}

/// systemd separates several folders by colons.
fn first_of_list(dirs: &Path) -> PathBuf {
    dirs.to_string_lossy().split(':').next().unwrap_or_default().into()
}

/// Returns true if the folder is this user's and writable, or can be created.
fn is_usable(dir: &Path) -> bool {
    let writable = |dir: &Path| rustix::fs::access(dir, rustix::fs::Access::WRITE_OK).is_ok();
    match std::fs::symlink_metadata(dir) {
        Ok(found) => found.is_dir() && found.uid() == rustix::process::getuid().as_raw() && writable(dir),
        // Only systemd creates the folder of a service.
        Err(_) => dir != Path::new(SERVICE_DIR) && dir.parent().is_some_and(writable),
    }
}

/// A shared lock on a folder. Cleaners of temporary files that respect locks (systemd-tmpfiles) leave the folder and
/// everything in it.
#[derive(Debug)]
pub(crate) struct Kept(#[allow(dead_code, reason = "closing the file releases the lock")] Option<File>);

impl Kept {
    /// Locks a folder. Without the lock, the folder only is less protected.
    pub(crate) fn new(dir: &Path) -> Self {
        let file = File::open(dir).ok();
        Self(file.filter(|file| flock(file, FlockOperation::NonBlockingLockShared).is_ok()))
    }
}

/// Sets the times of a file, or of a folder and everything in it, to now: cleaners go by age.
pub(crate) fn refresh(path: &Path) {
    let now = SystemTime::now();
    let times = std::fs::FileTimes::new().set_accessed(now).set_modified(now);
    // A file that ends in the meantime, and a socket, which cannot be opened, need no new time.
    let _ = File::open(path).and_then(|file| file.set_times(times));
    if path.is_dir() {
        std::fs::read_dir(path).into_iter().flatten().flatten().for_each(|entry| refresh(&entry.path()));
    }
}

/// Returns the processes of this user that map a file of shared memory with this prefix, also if no folder names them.
pub fn mapping_processes(prefix: &str) -> Vec<u32> {
    let wanted = format!("{}/{prefix}", crate::SHARED_MEMORY_DIR);
    let mut pids: Vec<u32> = std::fs::read_dir("/proc")
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| entry.file_name().to_str()?.parse().ok())
        .filter(|pid| std::fs::read_to_string(format!("/proc/{pid}/maps")).is_ok_and(|maps| maps.contains(&wanted)))
        .collect();
    pids.sort_unstable();
    pids
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A refreshed folder and its files are new, however old they were.
    #[test]
    fn refreshing_makes_young() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("a/b");
        std::fs::create_dir(dir.path().join("a")).unwrap();
        std::fs::write(&file, "x").unwrap();
        let old = std::fs::FileTimes::new().set_modified(SystemTime::UNIX_EPOCH);
        for path in [&file, &dir.path().join("a")] {
            File::open(path).unwrap().set_times(old).unwrap();
        }
        refresh(dir.path());
        for path in [&file, &dir.path().join("a")] {
            assert!(path.metadata().unwrap().modified().unwrap() > SystemTime::UNIX_EPOCH, "{}", path.display());
        }
    }

    /// A locked folder refuses an exclusive lock, as cleaners take it, until the lock is dropped.
    #[test]
    fn a_kept_folder_is_locked() {
        let dir = tempfile::tempdir().unwrap();
        let cleaner = File::open(dir.path()).unwrap();
        let kept = Kept::new(dir.path());
        assert!(flock(&cleaner, FlockOperation::NonBlockingLockExclusive).is_err());
        drop(kept);
        assert!(flock(&cleaner, FlockOperation::NonBlockingLockExclusive).is_ok());
    }

    /// A folder that another user could own, and a place that cannot be written, are not usable.
    #[test]
    fn usable_folders() {
        let dir = tempfile::tempdir().unwrap();
        assert!(is_usable(dir.path()) && is_usable(&dir.path().join("new")));
        let link = dir.path().join("link");
        std::os::unix::fs::symlink(dir.path(), &link).unwrap();
        assert!(!is_usable(&link) && !is_usable(&dir.path().join("missing/new")));
    }
}
