//! Images of the window and of the scene, as PNG files.

use carff_dataset::Image;
use eframe::egui::{ColorImage, Context, Event, UserData, ViewportCommand};
use std::path::{Path, PathBuf};

/// Highest number that is tried for a new file's name.
const MOST_FILES: u32 = 10_000;

/// Why an image could not be saved.
#[derive(Debug, thiserror::Error)]
pub enum ShotError {
    /// The file could not be written.
    #[error("cannot save {path}: {source}")]
    Save {
        /// Path of the file.
        path: PathBuf,
        /// Error of the image library.
        source: image::ImageError,
    },
    /// All file names are taken.
    #[error("{folder} has {MOST_FILES} screenshots: remove some")]
    Full {
        /// The folder.
        folder: PathBuf,
    },
}

/// Requests an image of the window; it arrives with one of the next frames.
pub fn request(ctx: &Context) {
    ctx.send_viewport_cmd(ViewportCommand::Screenshot(UserData::default()));
}

/// Returns the requested image of the window when it has arrived.
pub fn arrived(ctx: &Context) -> Option<std::sync::Arc<ColorImage>> {
    ctx.input(|input| {
        input.events.iter().find_map(|event| match event {
            Event::Screenshot { image, .. } => Some(image.clone()),
            _ => None,
        })
    })
}

/// Returns an unused file name in `folder`.
pub fn free_name(folder: &Path, kind: &str) -> Result<PathBuf, ShotError> {
    (1..=MOST_FILES)
        .map(|i| folder.join(format!("carff-{kind}-{i:04}.png")))
        .find(|path| !path.exists())
        .ok_or_else(|| ShotError::Full { folder: folder.to_owned() })
}

/// Saves an image of the window.
pub fn save_window(window: &ColorImage, path: &Path) -> Result<(), ShotError> {
    let [width, height] = window.size.map(|side| side as u32);
    let rgb: Vec<u8> = window.pixels.iter().flat_map(|p| [p.r(), p.g(), p.b()]).collect();
    save(&rgb, width, height, path)
}

/// Saves an image of a scene.
pub fn save_image(image: &Image, path: &Path) -> Result<(), ShotError> {
    save(&image.rgb, image.width_px, image.height_px, path)
}

fn save(rgb: &[u8], width: u32, height: u32, path: &Path) -> Result<(), ShotError> {
    image::save_buffer(path, rgb, width, height, image::ExtendedColorType::Rgb8)
        .map_err(|source| ShotError::Save { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use eframe::egui::Color32;

    /// File names are numbered in order, saved images can be read back, and an error names the file.
    #[test]
    fn saves_under_free_names() {
        let folder = tempfile::tempdir().unwrap();
        let first = free_name(folder.path(), "window").unwrap();
        save_window(&ColorImage::filled([3, 2], Color32::from_rgb(1, 2, 3)), &first).unwrap();
        assert_eq!(Image::load(&first).unwrap(), Image::filled(3, 2, [1, 2, 3]));
        let second = free_name(folder.path(), "window").unwrap();
        assert!(first.ends_with("carff-window-0001.png") && second.ends_with("carff-window-0002.png"));
        let error = save_image(&Image::filled(1, 1, [0; 3]), &folder.path().join("none/x.png")).unwrap_err();
        assert!(error.to_string().contains("none/x.png"), "{error}");
    }
}
