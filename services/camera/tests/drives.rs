//! Tests of the camera's drives through a small dataset.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::geometry::PinholeCamera;
use carff_camera::{DriveSource, Source};
use carff_checkpoint::CheckpointPlanning;
use carff_config::GraphConfig;
use carff_dataset::{DatasetWriter, FrameRecord, Image, Observability, ScenarioInfo};
use carff_messages::{Header, ImageMeta, Message};
use std::path::Path;

const VIEWS: usize = 20;
const GREY: u8 = 40;

/// Writes two branches x three time steps x twenty poses; half of the poses see nothing and half everything. The grey
/// value of an image encodes its branch and time step.
fn write_dataset(folder: &Path) {
    let writer = DatasetWriter::create(folder).unwrap();
    let camera = PinholeCamera::look_at([0.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 8, 8, 60.0);
    let mut records = Vec::new();
    for (branch, timestamp) in (0..2).flat_map(|b| (0..3).map(move |t| (b, t))) {
        for view in 0..VIEWS {
            let path = format!("images/b{branch}_t{timestamp}_v{view}.png");
            let grey = GREY * (branch * 3 + timestamp + 1) as u8;
            writer.write_image(&path, &Image::filled(8, 8, [grey; 3])).unwrap();
            let mut record = FrameRecord::new(path, camera);
            (record.branch_and_timestamp, record.view) = (Some((branch, timestamp)), Some(view));
            record.observability = Some(if view % 2 == 0 { Observability::None } else { Observability::Full });
            records.push(record);
        }
    }
    let scenario = ScenarioInfo {
        name: "test".into(),
        bounds: [[-1.0; 3], [1.0; 3]],
        branches: vec!["hazard".into(), "clear".into()],
        timestamps: 3,
        step_s: None,
        bev_view: None,
        states: Vec::new(),
        candidates: Vec::new(),
        static_boxes: Vec::new(),
        hazard_branches: vec![0],
        hazard_from_timestamp: 0,
        hazard_action: "halt".into(),
        clear_action: "advance".into(),
    };
    writer.finish(&records, Some(&scenario)).unwrap();
}

fn graph() -> GraphConfig {
    let text = "[run]\nname = \"t\"\ndataset = \"d\"\ncheckpoint = \"c\"\n[camera]\nframes_per_timestamp = 2";
    GraphConfig::parse(text, "test.toml".as_ref()).unwrap()
}

/// Each drive shows its branch's time steps in order, each as often as configured, with new noise and a valid
/// description. After the last drive there is no frame. The same seed gives the same bytes.
#[test]
fn drives_show_timestamps_in_order_with_fresh_noise() {
    let folder = tempfile::tempdir().unwrap();
    write_dataset(folder.path());
    CheckpointPlanning::new(3, 0.5).save(folder.path()).unwrap();
    let shoot = || {
        let mut source = DriveSource::open(folder.path(), folder.path(), &graph(), 4).unwrap();
        let mut shots = Vec::new();
        while let Some(mut meta) = source.advance().unwrap() {
            let frame_id = shots.len() as u64;
            meta.header = Header::of_frame(frame_id, 0, 1);
            meta.validate().unwrap();
            let mut image = vec![0; meta.image_bytes()];
            source.write(frame_id, &mut image).unwrap();
            shots.push((meta.dataset_view, image));
        }
        assert_eq!(source.drives().len(), 4);
        shots
    };
    let shots = shoot();
    assert_eq!(shots.len(), 4 * 3 * 2);
    for (i, (view, image)) in shots.iter().enumerate() {
        let (drive, in_drive) = (i / 6, i % 6);
        assert_eq!(
            (view.drive, view.frame_in_drive, view.timestamp),
            (drive as i32, in_drive as i32, in_drive as i32 / 2)
        );
        assert_eq!(view.branch, drive as i32 % 2, "hazard and clear drives alternate");
        assert_eq!(view.last_of_timestamp, in_drive as u32 % 2);
        let mean = image.iter().map(|&b| f64::from(b)).sum::<f64>() / image.len() as f64;
        let wanted = f64::from(GREY) * f64::from(view.branch * 3 + view.timestamp + 1);
        assert!((mean - wanted).abs() < 20.0, "frame {i}: mean {mean}, wanted about {wanted}");
    }
    for pair in shots.chunks(2) {
        assert_ne!(pair[0].1, pair[1].1, "noise is drawn again for each frame");
    }
    assert_eq!(shots, shoot());
}

/// A broken image of a dataset stops the camera at its start, with an error that names the file.
#[test]
fn a_broken_image_is_named() {
    let folder = tempfile::tempdir().unwrap();
    write_dataset(folder.path());
    CheckpointPlanning::new(3, 0.5).save(folder.path()).unwrap();
    for view in 0..VIEWS {
        std::fs::write(folder.path().join(format!("images/b0_t1_v{view}.png")), b"no image").unwrap();
    }
    let error = DriveSource::open(folder.path(), folder.path(), &graph(), 4).unwrap_err();
    assert!(format!("{error:#}").contains("b0_t1_v"), "{error:#}");
}

/// Without a checkpoint, and without a seed in the graph file, the error names the setting.
#[test]
fn an_unknown_split_says_what_to_set() {
    let folder = tempfile::tempdir().unwrap();
    write_dataset(folder.path());
    let nowhere = folder.path().join("nowhere");
    let error = format!("{:#}", DriveSource::open(folder.path(), &nowhere, &graph(), 4).unwrap_err());
    assert!(error.contains("camera.split_seed") && error.contains("planning.json"), "{error}");
    let mut graph = graph();
    graph.camera.split_seed = Some(3);
    DriveSource::open(folder.path(), &nowhere, &graph, 4).unwrap();
}
