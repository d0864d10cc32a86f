//! A folder of images without poses.

use std::path::{Path, PathBuf};

/// Returns the PNG files of a folder, in the order of their names: the index of a file is the `view` of its frames.
///
/// # Errors
///
/// If the folder cannot be read.
pub fn image_files(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder)?.collect::<Result<Vec<_>, _>>()?;
    let mut files: Vec<PathBuf> = entries.into_iter().map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")));
    files.sort();
    Ok(files)
}
