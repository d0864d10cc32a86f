//! Fixtures of the viewer's tests: the shipped checkpoint, and true images of its scenario.
#![allow(clippy::unwrap_used, reason = "a failure here fails a test")]

use carff_scenes::{Detail, Scenario};
use carff_viewer::input::ChosenImage;
use carff_viewer::models::SessionModels;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A view that hides the truck's place at the first step, and a view straight from above.
pub const HIDING_VIEW: usize = 2;
pub const ABOVE_VIEW: usize = 50;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

pub fn checkpoint() -> PathBuf {
    root().join("configs/checkpoints/approaching-intersection")
}

pub fn models() -> SessionModels {
    SessionModels::load(&checkpoint(), 1).unwrap()
}

pub fn scenario() -> Scenario {
    Scenario::load(&root().join("configs/scenarios/approaching-intersection.toml")).unwrap()
}

/// Returns the image of a state from a camera of the scenario.
pub fn image(branch: usize, timestamp: usize, view: usize) -> Arc<ChosenImage> {
    let scenario = scenario();
    let camera = scenario.cameras()[view].camera;
    let image = scenario.render(branch, timestamp, &camera, Detail::default()).unwrap().image;
    let input = ChosenImage::of_image(format!("b{branch} t{timestamp} v{view}"), image);
    Arc::new(ChosenImage { camera: Some(camera), frame: view as u64, ..(*input).clone() })
}

/// Copies the shipped checkpoint without some files; large files are linked.
pub fn copy_without(files: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(checkpoint()).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name();
        if !files.iter().any(|f| name == *f) {
            let target = entry.path().canonicalize().unwrap();
            std::os::unix::fs::symlink(target, folder.path().join(name)).unwrap();
        }
    }
    folder
}
