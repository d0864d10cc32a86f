//! The channels for other tools, as these read them.

use super::*;
use carff_messages::{Occupancy, UnknownBox, Unknowns};
use foxglove::Decode;
use foxglove::messages::log::Level;
use foxglove::messages::{CameraCalibration, FrameTransform, Grid, Log, RawImage, SceneUpdate, Timestamp};
use std::collections::{BTreeMap, BTreeSet};

const LATE_NS: u64 = 900_000_000;

/// Returns a recording's messages: channel, log time, data.
fn recorded(messages: &[(TopicId, OwnedMessage)], places: &[Place]) -> Vec<(String, u64, Vec<u8>)> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut writer = Writer::create(&path, &about(), places).unwrap();
    for (topic, message) in messages {
        writer.write(*topic, message.as_message()).unwrap();
    }
    writer.finish().unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let stream = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    stream.map(|m| (m.channel.topic.clone(), m.log_time, m.data.to_vec())).collect()
}

fn wall_ns(at: Option<Timestamp>) -> u64 {
    at.map(|at| u64::from(at.sec()) * 1_000_000_000 + u64::from(at.nsec())).unwrap()
}

/// Returns a header whose message is published long after the capture.
fn late(frame_id: u64, step: u32) -> Header {
    let header = header(frame_id).at_step(step);
    Header { publish_time_ns: header.capture_time_ns + LATE_NS, ..header }
}

fn view(frame_id: u64, step: u32, hypothesis: u32, kind: u32) -> (TopicId, OwnedMessage) {
    let message = messages(frame_id).swap_remove(3).1;
    let mut meta = *message.as_message().get::<ViewMeta>().unwrap();
    (meta.header, meta.hypothesis, meta.kind) = (late(frame_id, step), hypothesis, kind);
    let grey = (frame_id + u64::from(10 * step + 20 * hypothesis + 100 * kind)) as u8;
    (TopicId::VIEW, OwnedMessage::new(Box::new(meta), vec![grey; 12]))
}

/// Each camera, step and hypothesis has its own image channel and each camera its own coordinate frame. Stamps are the
/// times of capture, log times those of publication.
#[test]
fn channels_do_not_mix_sources() {
    let mut sent = vec![];
    for frame in 0..3 {
        sent.push(messages(frame).swap_remove(0));
        for (step, hypothesis, kind) in (1..3).flat_map(|s| (0..2).flat_map(move |h| (0..2).map(move |k| (s, h, k)))) {
            sent.push(view(frame, step, hypothesis, kind));
        }
    }
    let captured = |frame: u64| header(frame).capture_time_ns + about().wall_offset_ns;
    let mut images: BTreeMap<String, Vec<(u64, u64, u8)>> = BTreeMap::new();
    let mut stamps = Vec::new();
    for (channel, log_ns, data) in recorded(&sent, &[]) {
        if channel.ends_with("/image") {
            let image = RawImage::decode(&data[..]).unwrap();
            let camera = channel.split("/step").next().unwrap();
            assert_eq!(image.frame_id, camera.trim_end_matches("/image"));
            images.entry(channel).or_default().push((wall_ns(image.timestamp), log_ns, image.data[0]));
        } else if channel.ends_with("/calibration") {
            let calibration = CameraCalibration::decode(&data[..]).unwrap();
            assert_eq!(format!("{}/calibration", calibration.frame_id), channel);
            stamps.push(wall_ns(calibration.timestamp));
        } else if channel.ends_with("/pose") {
            let pose = FrameTransform::decode(&data[..]).unwrap();
            assert_eq!(format!("{}/pose", pose.child_frame_id), channel);
            stamps.push(wall_ns(pose.timestamp));
        }
    }
    assert!(stamps.iter().all(|stamp| (0..3).any(|frame| *stamp == captured(frame))), "{stamps:?}");
    assert_eq!(stamps.len(), 2 * 3 * 9);
    assert_eq!(images.len(), 9, "{images:?}");
    for (channel, found) in images {
        for ((stamp, log_ns, grey), frame) in found.iter().zip(0..) {
            assert_eq!(*stamp, captured(frame), "{channel}");
            let late_ns = if channel == "camera/image" { 500 } else { LATE_NS };
            assert_eq!(*log_ns, captured(frame) + late_ns, "{channel}");
            if channel == "renderer/free/step2/hypothesis1/image" {
                assert_eq!(u64::from(*grey), frame + 140, "{channel}");
            }
        }
        assert_eq!(found.len(), 3, "{channel}");
    }
}

fn belief(frame_id: u64, step: u32) -> (TopicId, OwnedMessage) {
    let mut belief = Belief::empty(late(frame_id, step), 2);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (2, 3, 1, 1);
    belief.state_probability[..2].copy_from_slice(&[0.3, 0.6]);
    belief.component_weights[0] = 1.0;
    (TopicId::BELIEF, OwnedMessage::new(Box::new(belief), Vec::new()))
}

/// Boxes have unique ids although places share a name, and steps have their own channels. Boxes expire after their
/// publication, however late that is, and their labels show the probability.
#[test]
fn boxes_are_all_shown() {
    let place = |occupied_in: [bool; 2]| Place { occupied_in: occupied_in.into(), ..places()[0].clone() };
    let places = [place([true, false]), place([false, true]), place([true, true])];
    let sent: Vec<_> = (0..4).flat_map(|frame| [belief(frame, 1), belief(frame, 2)]).collect();
    let mut ids: BTreeMap<String, BTreeSet<(String, String)>> = BTreeMap::new();
    for (channel, log_ns, data) in recorded(&sent, &places) {
        if !channel.starts_with("prober/boxes") {
            continue;
        }
        let entities = SceneUpdate::decode(&data[..]).unwrap().entities;
        assert_eq!(entities.len(), 3);
        for (entity, label) in entities.iter().zip(["30 %", "60 %", "90 %"]) {
            ids.entry(entity.id.clone()).or_default().insert((channel.clone(), entity.texts[0].text.clone()));
            assert!(entity.texts[0].text.ends_with(label), "{}", entity.texts[0].text);
            assert_eq!(wall_ns(entity.timestamp) + LATE_NS, log_ns);
            let lifetime = entity.lifetime.unwrap();
            let expires_ns =
                wall_ns(entity.timestamp) + lifetime.sec() as u64 * 1_000_000_000 + u64::from(lifetime.nsec());
            assert_eq!(expires_ns, log_ns + 1_000_000_000);
        }
    }
    // Two steps with three places; each id belongs to one channel and one place.
    assert_eq!(ids.len(), 6, "{ids:?}");
    assert!(ids.values().all(|uses| uses.len() == 1), "{ids:?}");
    assert_eq!(ids.values().flatten().map(|(channel, _)| channel).collect::<BTreeSet<_>>().len(), 2);
}

/// Boxes of something unknown replace those of the image before, and a comparison without any removes them.
#[test]
fn unknown_boxes_replace_the_earlier_ones() {
    let unknowns = |frame_id: u64, probabilities: &[f32]| {
        let mut unknowns = Unknowns::of_frame(late(frame_id, 0));
        unknowns.box_count = probabilities.len() as u64;
        for (unknown, &probability) in unknowns.boxes.iter_mut().zip(probabilities) {
            *unknown = UnknownBox { center: [1.0, 2.0, 0.5], half_size: [1.0; 3], probability, place: -1 };
        }
        (TopicId::UNKNOWN, OwnedMessage::new(Box::new(unknowns), Vec::new()))
    };
    let sent = [unknowns(0, &[0.9, 0.25]), unknowns(1, &[])];
    let updates: Vec<SceneUpdate> = recorded(&sent, &[])
        .into_iter()
        .filter(|(channel, ..)| channel == "prober/boxes/unknown")
        .map(|(_, _, data)| SceneUpdate::decode(&data[..]).unwrap())
        .collect();
    let shown = updates.iter().map(|u| (u.deletions.len(), u.entities.len())).collect::<Vec<_>>();
    assert_eq!(shown, [(1, 2), (1, 0)]);
    let [first, second] = &updates[0].entities[..] else { panic!("two boxes") };
    assert_eq!([first, second].map(|e| e.texts[0].text.as_str()), ["unknown: 90 %", "unknown: 25 %"]);
    assert_ne!(first.id, second.id);
    assert_eq!(first.cubes[0].size, Some(foxglove::messages::Vector3 { x: 2.0, y: 2.0, z: 2.0 }));
}

/// An occupancy grid is a Foxglove grid: one byte a cell, along x, then along y, at its place in the world; each step has
/// its own channel.
#[test]
fn grids_are_grids() {
    let mut occupancy = Occupancy::empty(late(0, 2));
    (occupancy.columns, occupancy.rows, occupancy.cell_m, occupancy.low_corner_m) = (3, 2, 0.5, [-17.0, -19.0]);
    occupancy.probability[..6].copy_from_slice(&[0.0, 1.0, 0.5, 0.2, 0.0, 0.0]);
    let sent = [(TopicId::OCCUPANCY, OwnedMessage::new(Box::new(occupancy), Vec::new()))];
    let grids: Vec<Grid> = recorded(&sent, &[])
        .into_iter()
        .filter(|(channel, ..)| channel == "prober/grid/step2")
        .map(|(_, _, data)| Grid::decode(&data[..]).unwrap())
        .collect();
    let [grid] = &grids[..] else { panic!("one grid") };
    assert_eq!((grid.column_count, grid.row_stride, grid.cell_stride), (3, 3, 1));
    assert_eq!(grid.data[..], [0, 255, 128, 51, 0, 0]);
    let corner = grid.pose.as_ref().and_then(|pose| pose.position).unwrap();
    assert_eq!((corner.x, corner.y, grid.cell_size.unwrap().x), (-17.0, -19.0, 0.5));
}

/// The log has an entry for each change of the action and of a stage's health, with its source and level.
#[test]
fn changes_are_logged() {
    let action = |frame_id: u64, action: u32, reason: u32| {
        let message = messages(frame_id).swap_remove(4).1;
        let sent = *message.as_message().get::<Action>().unwrap();
        (TopicId::ACTION, OwnedMessage::new(Box::new(Action { action, reason, ..sent }), Vec::new()))
    };
    let [advance, halt] = [1, 0];
    let sent = [action(0, advance, 0), action(1, advance, 0), action(2, halt, 0), action(3, halt, 2)];
    let logs: Vec<Log> = recorded(&sent, &[])
        .into_iter()
        .filter(|(channel, ..)| channel == "log")
        .map(|(_, log_ns, data)| {
            let log = Log::decode(&data[..]).unwrap();
            assert_eq!((wall_ns(log.timestamp), log.name.as_str()), (log_ns, "controller"));
            log
        })
        .collect();
    let levels: Vec<i32> = logs.iter().map(|log| log.level).collect();
    let [info, warning] = [Level::Info, Level::Warning].map(i32::from);
    assert_eq!(levels, [info, info, warning], "{logs:?}");
    assert!(logs[1].message.contains("frame 2") && logs[1].message.contains("hazard 0.250"), "{logs:?}");
}
