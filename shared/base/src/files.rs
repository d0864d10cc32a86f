//! Files that a program writes at its end, and their check at its start.

use std::fs::{OpenOptions, canonicalize, create_dir_all, metadata, remove_file};
use std::io::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

/// Checks that a file can be written, and creates its folder. A file that exists is not changed; a pipe or a device is
/// not opened.
///
/// # Errors
///
/// Names the path if the folder or the file cannot be written.
pub fn check_writable(path: &Path) -> Result<()> {
    let attempt = || {
        if let Some(folder) = path.parent() {
            create_dir_all(folder)?;
        }
        match metadata(path) {
            // Opening a pipe waits for its reader.
            Ok(found) if !found.is_file() && !found.is_dir() => Ok(()),
            Ok(_) => OpenOptions::new().append(true).open(path).map(drop),
            Err(_) => {
                OpenOptions::new().append(true).create(true).open(path)?;
                // A link remains; only the file that it names was created here.
                remove_file(canonicalize(path)?)
            }
        }
    };
    attempt().map_err(|e: Error| Error::new(e.kind(), format!("cannot write {}: {e}", path.display())))
}

/// Checks that the files that a command writes differ from each other and from those that it reads. Pipes and devices
/// may be the same.
///
/// # Errors
///
/// Names the file that would be overwritten.
pub fn check_distinct<'a>(
    read: impl IntoIterator<Item = &'a Path>,
    written: impl IntoIterator<Item = &'a Path>,
) -> Result<()> {
    let mut seen: Vec<PathBuf> = read.into_iter().filter_map(identity).collect();
    for path in written {
        let Some(file) = identity(path) else { continue };
        if seen.contains(&file) {
            let why = format!("{} would overwrite a file of the same command: name another file", path.display());
            return Err(Error::new(ErrorKind::AlreadyExists, why));
        }
        seen.push(file);
    }
    Ok(())
}

/// Returns the path of a file without links, also if the file does not exist; `None` for anything but a file.
fn identity(path: &Path) -> Option<PathBuf> {
    if let Ok(found) = metadata(path) {
        return found.is_file().then(|| canonicalize(path).ok())?;
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Some(canonicalize(folder).ok()?.join(path.file_name()?))
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
        // A link to a file that is yet to be written remains, and its file is not left behind.
        let link = dir.path().join("link.json");
        std::os::unix::fs::symlink("new/later.json", &link).unwrap();
        check_writable(&link).unwrap();
        assert!(link.is_symlink() && !link.exists());
        // Neither a pipe without a reader nor a device is opened.
        let pipe = dir.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        check_writable(&pipe).unwrap();
        check_writable(Path::new("/dev/full")).unwrap();
        for wrong in [path.join("below-a-file"), dir.path().to_owned(), "/proc/nowhere/report.json".into()] {
            let error = check_writable(&wrong).unwrap_err().to_string();
            assert!(error.contains(&*wrong.to_string_lossy()), "{error}");
        }
    }

    /// A file that is read, or written twice, is named, also by a link or another path; devices may repeat.
    #[test]
    fn files_are_distinct() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        std::fs::write(path("run.mcap"), "").unwrap();
        std::os::unix::fs::symlink("run.mcap", path("link")).unwrap();
        std::fs::create_dir(path("sub")).unwrap();
        let checked = |written: &[&str]| {
            let written: Vec<PathBuf> = written.iter().map(|name| path(name)).collect();
            check_distinct([&*path("run.mcap")], written.iter().map(PathBuf::as_path))
        };
        checked(&["film.mp4", "trace.json", "sub/film.mp4", "none/film.mp4"]).unwrap();
        checked(&["/dev/null", "/dev/null"]).unwrap();
        for same in [&["run.mcap"][..], &["film.mp4", "link"], &["sub/../run.mcap"], &["new", "sub/../new"]] {
            let error = checked(same).unwrap_err().to_string();
            assert!(error.contains(same.last().unwrap()) && error.contains("name another file"), "{error}");
        }
    }
}
