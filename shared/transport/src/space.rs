//! Checks the free space of shared memory, because writing beyond it ends in SIGBUS, and the limit of open files.

use crate::OpenError;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::path::Path;

/// Folder of shared memory.
pub const SHARED_MEMORY_DIR: &str = "/dev/shm";

/// Upper bound for the rest of a topic (connections, wake-ups).
pub(crate) const MANAGEMENT_BYTES: u64 = 1 << 20;

/// Checks that `folder` (usually `/dev/shm`) is writable and has `needed_bytes` free for `what`.
pub fn check_space(folder: &Path, what: &str, needed_bytes: u64) -> Result<(), OpenError> {
    let not_writable =
        |source: rustix::io::Errno| OpenError::NotWritable { path: folder.to_owned(), source: source.into() };
    rustix::fs::access(folder, rustix::fs::Access::WRITE_OK).map_err(not_writable)?;
    let stat = rustix::fs::statvfs(folder).map_err(not_writable)?;
    let free_bytes = stat.f_bavail.saturating_mul(stat.f_frsize);
    if free_bytes < needed_bytes {
        return Err(OpenError::SharedMemoryFull {
            path: folder.to_owned(),
            what: what.to_owned(),
            needed_bytes,
            free_bytes,
        });
    }
    Ok(())
}

/// Files that a process of a graph opens, with a margin: 80 were measured for six stages.
const OPEN_FILES: u64 = 256;
/// Open files that a process allows itself if the system permits it.
const WANTED_OPEN_FILES: u64 = 4096;

/// Raises the soft limit of open files, and checks it. iceoryx2 would report the lack of a file as an internal error.
pub(crate) fn check_open_files() -> Result<(), OpenError> {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let wanted = WANTED_OPEN_FILES.min(maximum.unwrap_or(u64::MAX));
    let limit = match current {
        Some(soft) if soft < wanted => {
            // Without the permission, the present limit decides.
            let raised = setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum });
            if raised.is_ok() { wanted } else { soft }
        }
        soft => soft.unwrap_or(u64::MAX),
    };
    if limit < OPEN_FILES { Err(OpenError::OpenFiles { limit, needed: OPEN_FILES }) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Too little space and a missing folder are errors with a remedy; enough space is not an error.
    #[test]
    fn says_what_is_wrong() {
        let folder = tempfile::tempdir().unwrap();
        assert!(check_space(folder.path(), "topic `x`", 1).is_ok());
        let full = check_space(folder.path(), "topic `x`", u64::MAX).unwrap_err();
        assert!(matches!(full, OpenError::SharedMemoryFull { needed_bytes: u64::MAX, .. }));
        assert!(full.to_string().contains("--shm-size"), "{full}");
        let missing = check_space(&folder.path().join("none"), "topic `x`", 1).unwrap_err();
        assert!(matches!(missing, OpenError::NotWritable { .. }));
    }
}
