//! Judges the file system of shared memory.

use super::size::size;
use crate::doctor::finding::{Area, Finding};
use std::path::PathBuf;

/// The file system of shared memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SharedMemory {
    /// The folder.
    pub folder: PathBuf,
    /// Type of its file system; `None` if it is not mounted.
    pub file_system: Option<String>,
    /// True if this user can create files in it.
    pub writable: bool,
    /// Size, bytes.
    pub size_bytes: u64,
    /// Free space, bytes.
    pub free_bytes: u64,
}

/// Compares shared memory with the needs of a graph.
pub fn shared_memory(memory: &SharedMemory, needed_bytes: u64) -> Vec<Finding> {
    let folder = memory.folder.display();
    let area = Area::SharedMemory;
    let Some(file_system) = &memory.file_system else {
        return vec![Finding::error(
            area,
            "folder",
            format!("{folder} does not exist"),
            "processes cannot exchange images",
            format!("sudo mount -t tmpfs -o size=512m,mode=1777 tmpfs {folder}"),
        )];
    };
    let mut findings = Vec::new();
    findings.push(if !memory.writable {
        Finding::error(
            area,
            "rights",
            format!("this user cannot write to {folder}"),
            "processes cannot exchange images",
            format!("sudo chmod 1777 {folder}"),
        )
    } else if file_system == "tmpfs" {
        Finding::ok(area, "rights", format!("{folder} is writable, and is tmpfs"))
    } else {
        Finding::warning(
            area,
            "rights",
            format!("{folder} is {file_system}, not tmpfs"),
            "images go to a disk: the loop stalls while the disk is busy",
            format!("sudo mount -t tmpfs -o size=512m,mode=1777 tmpfs {folder}"),
        )
    });
    let found = format!(
        "{} free of {}; a graph needs up to {}",
        size(memory.free_bytes),
        size(memory.size_bytes),
        size(needed_bytes)
    );
    let advice = format!(
        "sudo mount -o remount,size={}m {folder}; a container has 64 MB by default: start it with --shm-size=512m",
        (2 * needed_bytes).next_power_of_two().max(512 << 20) >> 20
    );
    findings.push(if memory.free_bytes < needed_bytes {
        Finding::error(area, "size", found, "`carff launch` refuses to start: full shared memory kills stages", advice)
    } else if memory.free_bytes < 2 * needed_bytes {
        Finding::warning(area, "size", found, "a second graph or a viewer may not find enough space", advice)
    } else {
        Finding::ok(area, "size", found)
    });
    findings
}

#[cfg(test)]
mod tests {
    use super::super::testing::{MIB, assert_level, levels};
    use super::*;
    use crate::doctor::finding::Level;

    /// Shared memory must exist, be writable, be in memory, and have space for the graph; the advice is a command.
    #[test]
    fn shared_memory_in_every_state() {
        let good = SharedMemory {
            folder: "/dev/shm".into(),
            file_system: Some("tmpfs".to_owned()),
            writable: true,
            size_bytes: 1024 * MIB,
            free_bytes: 1024 * MIB,
        };
        let check = |memory: &SharedMemory| levels(&shared_memory(memory, 50 * MIB));
        assert_eq!(check(&good), [("rights", Level::Ok), ("size", Level::Ok)]);
        let missing = SharedMemory { file_system: None, ..good.clone() };
        assert_eq!(check(&missing), [("folder", Level::Error)]);
        let foreign = SharedMemory { writable: false, ..good.clone() };
        assert_eq!(check(&foreign)[0], ("rights", Level::Error));
        let disk = SharedMemory { file_system: Some("ext4".to_owned()), ..good.clone() };
        assert_eq!(check(&disk)[0], ("rights", Level::Warning));
        for (free, level) in [(40, Level::Error), (60, Level::Warning), (100, Level::Ok)] {
            let findings = shared_memory(&SharedMemory { free_bytes: free * MIB, ..good.clone() }, 50 * MIB);
            assert_level(&findings[1], level);
        }
        let small = shared_memory(&SharedMemory { free_bytes: 0, ..good }, 600 * MIB);
        assert!(small[1].advice.contains("size=2048m") && small[1].advice.contains("--shm-size"), "{small:?}");
    }
}
