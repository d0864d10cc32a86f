//! Datasets and checkpoints for tests.

use crate::{Process, program, programs, project_root, shipped_checkpoint};
use carff_dataset::Image;
use rustix::fs::{FlockOperation, flock};
use serde_json::json;
use std::hash::Hasher;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Renders the shipped scenario's dataset once per build of `carff`, and keeps it in the target folder.
pub fn scenario_set() -> PathBuf {
    let scenario = project_root().join("configs/scenarios/approaching-intersection.toml");
    let mut hasher = std::collections::hash_map::DefaultHasher::new();
    for file in [program("carff"), scenario.clone()] {
        hasher.write(&std::fs::read(file).unwrap());
    }
    let folder = programs().join("carff-tests");
    std::fs::create_dir_all(&folder).unwrap();
    // Test programs run in parallel too: one renders, the others wait for it.
    let lock = std::fs::File::create(folder.join("lock")).unwrap();
    flock(&lock, FlockOperation::LockExclusive).unwrap();
    let set = folder.join(format!("set-{:016x}", hasher.finish()));
    if !set.is_dir() {
        for entry in std::fs::read_dir(&folder).unwrap().flatten().filter(|e| e.path().is_dir()) {
            std::fs::remove_dir_all(entry.path()).unwrap();
        }
        let partial = folder.join("partial");
        let mut render = Command::new(program("carff"));
        render.args(["dataset", "render"]).arg(scenario).arg("--out").arg(&partial);
        Process::start(&mut render).end().assert_success();
        std::fs::rename(partial, &set).unwrap();
    }
    set
}

/// Writes a small dataset of plain images: two branches x two time steps x 20 poses of 8 x 8 pixels, half of the poses
/// blind and half of them clear.
pub fn image_set(folder: &Path) {
    let images = folder.join("images");
    std::fs::create_dir_all(&images).unwrap();
    let mut frames = Vec::new();
    for (branch, timestamp, view) in
        (0..2_u32).flat_map(|b| (0..2_u32).flat_map(move |t| (0..20_u32).map(move |v| (b, t, v))))
    {
        let name = format!("b{branch}_t{timestamp}_v{view}.png");
        Image::filled(8, 8, [view as u8, branch as u8, timestamp as u8]).save_png(&images.join(&name)).unwrap();
        frames.push(json!({
            "file_path": format!("images/{name}"),
            "transform_matrix": [[1.0, 0.0, 0.0, view], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]],
            "scene_id": branch * 2 + timestamp, "branch": branch, "timestamp": timestamp, "view_id": view,
            "observability": if view % 2 == 0 { "full" } else { "none" },
        }));
    }
    let set = json!({
        "w": 8, "h": 8, "fl_x": 7.0, "fl_y": 7.0, "cx": 4.0, "cy": 4.0,
        "frames": frames,
        "scenario": {
            "name": "plain", "bounds": [[-1, -1, 0], [1, 1, 2]], "branches": ["with", "without"], "timestamps": 2,
            "bev_view": 0, "states": [{"scene_id": 0}, {"scene_id": 1}, {"scene_id": 2}, {"scene_id": 3}],
            "hazard_branches": [0], "actions": {"hazard": "halt", "clear": "advance"},
        },
    });
    std::fs::write(folder.join("transforms.json"), set.to_string()).unwrap();
}

/// Copies the shipped checkpoint, with a changed manifest.
pub fn copy_checkpoint(folder: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    std::fs::create_dir_all(folder).unwrap();
    for entry in std::fs::read_dir(shipped_checkpoint()).unwrap().flatten().filter(|e| e.path().is_file()) {
        std::fs::copy(entry.path(), folder.join(entry.file_name())).unwrap();
    }
    let path = folder.join("manifest.json");
    let mut manifest = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    change(&mut manifest);
    std::fs::write(path, manifest.to_string()).unwrap();
}
