//! Files that a program writes at its end, and their check at its start.

use std::fs::{OpenOptions, create_dir_all, remove_file};
use std::io::{Error, Result};
use std::path::Path;

/// Checks that a file can be written, and creates its folder. A file that exists is not changed.
///
/// # Errors
///
/// Names the path if the folder or the file cannot be written.
pub fn check_writable(path: &Path) -> Result<()> {
    let attempt = || {
        if let Some(folder) = path.parent() {
            create_dir_all(folder)?;
        }
        let existed = path.exists();
        OpenOptions::new().append(true).create(true).open(path)?;
        if existed { Ok(()) } else { remove_file(path) }
    };
    attempt().map_err(|e: Error| Error::new(e.kind(), format!("cannot write {}: {e}", path.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check creates the folder and no file, changes no file, and names a path that cannot be written.
    #[test]
    fn a_path_is_checked() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("new/report.json");
        check_writable(&path).unwrap();
        assert!(path.parent().unwrap().is_dir() && !path.exists());
        std::fs::write(&path, "kept").unwrap();
        check_writable(&path).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "kept");
        for wrong in [path.join("below-a-file"), dir.path().to_owned(), "/proc/nowhere/report.json".into()] {
            let error = check_writable(&wrong).unwrap_err().to_string();
            assert!(error.contains(&*wrong.to_string_lossy()), "{error}");
        }
    }
}
