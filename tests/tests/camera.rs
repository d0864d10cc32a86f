//! Tests of the camera process with unusable images.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_dataset::Image;
use carff_messages::{Health, Stage};
use carff_tests::{TestGraph, eventually, image_set};
use carff_transport::{Node, topics};
use std::path::Path;

/// Unreadable and wrong-sized images of a folder are named, counted as errors and never shown; the others are shown.
#[test]
fn a_folder_with_bad_images() {
    let images = tempfile::tempdir().unwrap();
    let path = |name: &str| images.path().join(name);
    Image::filled(16, 8, [10, 10, 10]).save_png(&path("a.png")).unwrap();
    std::fs::write(path("b.png"), "no image").unwrap();
    Image::filled(8, 8, [50, 50, 50]).save_png(&path("c.png")).unwrap();
    Image::filled(16, 8, [90, 90, 90]).save_png(&path("d.png")).unwrap();
    let rest = format!(
        "frame_rate_hz = 5.0\n[camera]\nsource = \"folder\"\nfolder = \"{}\"\nframes_per_timestamp = 3\n\
         [camera.noise]\nsigma = 0.0\ngain_sigma = 0.0\nchannel_gain_sigma = 0.0\nchannel_offset_sigma = 0.0\n",
        images.path().display()
    );
    let graph = TestGraph::new(Path::new("none"), Path::new("none"), &rest);
    let node = Node::open(graph.run(), "test").unwrap();
    let mut frames = node.receiver(&topics::FRAME).unwrap();
    let mut healths = node.receiver(topics::health(Stage::Camera)).unwrap();
    let camera = graph.stage(Stage::Camera);
    let mut shown = Vec::new();
    let mut health: Option<Health> = None;
    let done = eventually(|| {
        while let Some(frame) = frames.next().unwrap() {
            assert_eq!((frame.width_px, frame.height_px), (16, 8));
            shown.push(frame.bytes()[0]);
        }
        while let Some(latest) = healths.next().unwrap() {
            health = Some(*latest);
        }
        health.is_some_and(|h| h.published >= 6 && h.state == carff_messages::HealthState::Done.code())
    });
    let finished = camera.end();
    assert!(done, "{}", finished.text);
    finished.assert_success();
    assert!(finished.text.contains("b.png") && finished.text.contains("c.png"), "{}", finished.text);
    assert_eq!(health.unwrap().errors, 2, "{}", finished.text);
    assert_eq!(shown, [10, 10, 10, 90, 90, 90]);
}

/// A dataset with unreadable images, or with images of another size than its description, ends the camera with an error
/// that names the image: no drive is shown without it.
#[test]
fn drives_with_bad_images() {
    let set = tempfile::tempdir().unwrap();
    let spoil = |write: &dyn Fn(&Path)| {
        image_set(set.path());
        for entry in std::fs::read_dir(set.path().join("images")).unwrap() {
            write(&entry.unwrap().path());
        }
    };
    let camera = || {
        let graph =
            TestGraph::new(set.path(), Path::new("none"), "[camera]\nsplit_seed = 1\ndrives = 4\nlinger_ms = 0\n");
        let finished = graph.stage(Stage::Camera).end();
        assert!(!finished.text.contains("panicked at"), "{}", finished.text);
        finished
    };
    spoil(&|path| std::fs::write(path, "no image").unwrap());
    let unreadable = camera();
    assert_eq!(unreadable.status.code(), Some(1), "{}", unreadable.text);
    assert!(unreadable.text.contains("ERROR") && unreadable.text.contains(".png"), "{}", unreadable.text);
    spoil(&|path| Image::filled(4, 4, [0; 3]).save_png(path).unwrap());
    let wrong_sized = camera();
    assert_eq!(wrong_sized.status.code(), Some(1), "{}", wrong_sized.text);
    assert!(wrong_sized.text.contains("4x4") && wrong_sized.text.contains("8x8"), "{}", wrong_sized.text);
}

/// Free drives are rendered during the run: every frame of each drive is published with its truth, at distinct poses.
#[test]
fn free_drives_are_published() {
    let scenario = carff_tests::project_root().join("configs/scenarios/approaching-intersection");
    let rest = format!(
        "scenario = \"{}\"\nframe_rate_hz = 5.0\n[camera]\nsource = \"free-drives\"\ndrives = 2\n\
         frames_per_timestamp = 1\n",
        scenario.display()
    );
    let graph = TestGraph::new(Path::new("none"), Path::new("none"), &rest);
    let node = Node::open(graph.run(), "test").unwrap();
    let mut frames = node.receiver(&topics::FRAME).unwrap();
    let camera = graph.stage(Stage::Camera);
    let mut shown = Vec::new();
    let done = eventually(|| {
        while let Some(frame) = frames.next().unwrap() {
            let meta = &*frame;
            let view = meta.dataset_view;
            shown.push((view.drive, view.timestamp, view.branch, meta.world_from_camera.map(f64::to_bits)));
        }
        shown.len() >= 6
    });
    let finished = camera.end();
    assert!(done, "{}", finished.text);
    finished.assert_success();
    let truth: Vec<_> = shown.iter().map(|(drive, timestamp, branch, _)| (*drive, *timestamp, *branch)).collect();
    assert_eq!(truth, [(0, 0, 0), (0, 1, 0), (0, 2, 0), (1, 0, 1), (1, 1, 1), (1, 2, 1)]);
    for (i, (.., pose)) in shown.iter().enumerate() {
        assert!(shown[..i].iter().all(|(.., other)| other != pose));
    }
}
