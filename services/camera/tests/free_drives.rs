//! Tests of the camera's free drives through a shipped scenario.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_camera::{FreeDriveSource, Source};
use carff_config::GraphConfig;
use carff_messages::{Header, ImageMeta, Message};
use std::path::Path;

/// Free drives show each time step in order, with its truth and a valid description; hazard and clear drives alternate.
/// Noise is drawn again for each frame. The same seed gives the same bytes. After the last drive there is no frame.
#[test]
fn free_drives_show_timestamps_in_order() {
    let scenario = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios/approaching-intersection");
    let text = format!(
        "[run]\nname = \"t\"\ndataset = \"d\"\ncheckpoint = \"c\"\nscenario = \"{}\"\n[camera]\n\
         source = \"free-drives\"\nframes_per_timestamp = 2",
        scenario.display()
    );
    let graph = GraphConfig::parse(&text, "test.toml".as_ref()).unwrap();
    let shoot = || {
        let mut source = FreeDriveSource::open(&graph, 2).unwrap();
        let mut shots = Vec::new();
        while let Some(mut meta) = source.advance().unwrap() {
            let frame_id = shots.len() as u64;
            meta.header = Header::of_frame(frame_id, 0, 1);
            meta.validate().unwrap();
            assert_eq!(meta.image_bytes(), source.max_image_bytes());
            let mut image = vec![0; meta.image_bytes()];
            source.write(frame_id, &mut image).unwrap();
            let mut other_noise = vec![0; meta.image_bytes()];
            source.write(frame_id + 1, &mut other_noise).unwrap();
            assert_ne!(image, other_noise);
            shots.push((meta, image));
        }
        shots
    };
    let shots = shoot();
    assert_eq!(shots.len(), 2 * 3 * 2);
    for (i, (meta, _)) in shots.iter().enumerate() {
        let view = meta.dataset_view;
        assert_eq!((view.known, view.view, view.drive), (1, -1, i as i32 / 6));
        assert_eq!((view.frame_in_drive, view.timestamp), (i as i32 % 6, i as i32 % 6 / 2));
        assert_eq!((view.branch, view.last_of_timestamp), (view.drive, i as u32 % 2));
    }
    let bytes = |shots: &[(carff_messages::FrameMeta, Vec<u8>)]| shots.iter().map(|s| s.1.clone()).collect::<Vec<_>>();
    assert_eq!(bytes(&shots), bytes(&shoot()));
}
