use super::*;
use carff_base::geometry::OrientedBox;
use carff_decision::Place;
use carff_messages::forms::{AnyMessage, OwnedMessage};
use carff_messages::{
    Action, Belief, DatasetView, FrameMeta, Gaussian, Header, Intrinsics, Posterior, ProbeResult, Reason, Rule,
    ViewMeta,
};
use carff_transport::TopicId;
use std::io::Write as _;
use std::path::Path;

fn about() -> RecordingAbout {
    RecordingAbout {
        run: "r".into(),
        run_id: u64::MAX - 1,
        graph: "g.toml".into(),
        graph_text: "[run]\nname = \"r\"\n".into(),
        dataset: "d".into(),
        checkpoint: "c".into(),
        wall_offset_ns: 1_700_000_000_000_000_000,
        states: vec!["truck, t0".into(), "no actor, t0".into()],
        origin: [("commit".to_owned(), "abc".to_owned())].into(),
    }
}

fn places() -> Vec<Place> {
    let oriented_box = OrientedBox { center: [1.0, 2.0, 0.5], half_size: [2.0, 1.0, 0.5], yaw: 0.3 };
    vec![Place { name: "actor".into(), oriented_box, occupied_in: vec![true, false] }]
}

fn header(frame_id: u64) -> Header {
    let at_ns = 1_000_000 * (frame_id + 1);
    Header { sequence: frame_id, run_id: 5, publish_time_ns: at_ns + 500, ..Header::of_frame(frame_id, at_ns, 9) }
}

/// Returns a frame's messages, all different from each other and from those of other frames.
fn messages(frame_id: u64) -> Vec<(TopicId, OwnedMessage)> {
    let meta = FrameMeta {
        header: header(frame_id),
        width_px: 4,
        height_px: 2,
        intrinsics: Intrinsics { fl_x_px: 3.3, fl_y_px: 3.4, cx_px: 2.0, cy_px: 1.0 },
        world_from_camera: [1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0],
        dataset_view: DatasetView::UNKNOWN,
        take_start: 0,
    };
    let pixels: Vec<u8> = (0..24).map(|i| (i * 7 + frame_id * 3) as u8).collect();
    let mut gaussian = Gaussian::standard();
    gaussian.mean[0] = 0.1 * frame_id as f32;
    let posterior = Posterior { header: header(frame_id), gaussian, take_start: 0, stage_latency_ns: 3 };
    let mut belief = Belief::empty(header(frame_id).at_step(1), 1);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (2, 1, 1, 1);
    belief.state_probability[..2].copy_from_slice(&[0.3, 0.6]);
    belief.component_weights[0] = 1.0;
    belief.samples[0] = ProbeResult { state: 1, confidence: 0.9, ..ProbeResult::NONE };
    let view = ViewMeta {
        header: header(frame_id).at_step(1),
        hypothesis: 0,
        kind: 0,
        state: 1,
        width_px: 2,
        height_px: 2,
        probability: 0.5,
        latent: gaussian.mean,
        intrinsics: meta.intrinsics,
        world_from_camera: meta.world_from_camera,
        stage_latency_ns: 1,
    };
    let action = Action {
        action: 1,
        sample_count: 10,
        confidence: 0.5,
        hazard_probability: 0.25,
        is_decision: 1,
        valid_until_ns: 77,
        based_on_frame: frame_id,
        latency_ns: 20,
        ..Action::halt(header(frame_id), Reason::Belief, Rule::Calibrated)
    };
    vec![
        (TopicId::FRAME, OwnedMessage::new(Box::new(meta), pixels)),
        (TopicId::POSTERIOR, OwnedMessage::new(Box::new(posterior), Vec::new())),
        (TopicId::BELIEF, OwnedMessage::new(Box::new(belief), Vec::new())),
        (TopicId::VIEW, OwnedMessage::new(Box::new(view), vec![frame_id as u8; 12])),
        (TopicId::ACTION, OwnedMessage::new(Box::new(action), Vec::new())),
    ]
}

fn same(a: AnyMessage<'_>, b: AnyMessage<'_>) -> bool {
    a.to_json().unwrap() == b.to_json().unwrap() && a.bytes() == b.bytes()
}

fn read(path: &Path) -> (Vec<Entry>, bool) {
    let mut reader = Reader::open(path).unwrap();
    let mut entries = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        entries.push(entry);
    }
    (entries, reader.is_cut_off())
}

fn matches(found: &[Entry], frames: impl Iterator<Item = u64>) -> bool {
    let expected: Vec<_> = frames.flat_map(messages).collect();
    found.len() == expected.len()
        && found
            .iter()
            .zip(&expected)
            .all(|(f, (topic, m))| f.topic == *topic && same(f.message.as_message(), m.as_message()))
}

/// A written recording is read back bit for bit, including images, in order, with the metadata of its run.
#[test]
fn recordings_are_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut writer = Writer::create(&path, &about(), &places()).unwrap();
    for frame in 0..40 {
        for (topic, message) in messages(frame) {
            writer.write(topic, message.as_message()).unwrap();
        }
    }
    writer.finish().unwrap();
    assert_eq!(Reader::open(&path).unwrap().about(), Some(&about()));
    let (entries, cut_off) = read(&path);
    assert!(matches(&entries, 0..40), "{} entries", entries.len());
    assert!(!cut_off);
    assert!(matches!(Writer::create(&path, &about(), &[]), Err(RecordingError::Exists { .. })));
}

/// A writer that is killed leaves all flushed messages, and the reader reports the missing end. For any number of
/// missing last bytes, nothing panics and the messages are right.
#[test]
fn what_was_flushed_survives() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut writer = Writer::create(&path, &about(), &places()).unwrap();
    for frame in 0..10 {
        for (topic, message) in messages(frame) {
            writer.write(topic, message.as_message()).unwrap();
        }
        writer.flush().unwrap();
    }
    // These messages are not flushed when the writer is killed: no destructor runs.
    for (topic, message) in messages(10) {
        writer.write(topic, message.as_message()).unwrap();
    }
    let bytes = std::fs::read(&path).unwrap();
    std::mem::forget(writer);
    let (entries, cut_off) = read(&path);
    assert!(cut_off && matches(&entries, 0..10), "{} entries", entries.len());
    for missing in (1..bytes.len()).step_by(211) {
        let cut = folder.path().join("cut.mcap");
        std::fs::File::create(&cut).unwrap().write_all(&bytes[..bytes.len() - missing]).unwrap();
        let Ok(mut reader) = Reader::open(&cut) else { continue };
        let mut entries = Vec::new();
        while let Ok(Some(entry)) = reader.next() {
            entries.push(entry);
        }
        assert!(entries.len() <= 50 && matches(&entries[..entries.len() / 5 * 5], 0..entries.len() as u64 / 5));
    }
}

/// Damaged bytes are an error that names the file, or have no effect; they never panic.
#[test]
fn damage_is_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut writer = Writer::create(&path, &about(), &[]).unwrap();
    for (topic, message) in messages(0) {
        writer.write(topic, message.as_message()).unwrap();
    }
    writer.finish().unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let mut told = 0;
    for at in (0..bytes.len()).step_by(53) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x55;
        let file = folder.path().join("damaged.mcap");
        std::fs::write(&file, &damaged).unwrap();
        let result = Reader::open(&file).and_then(|mut reader| {
            while reader.next()?.is_some() {}
            Ok(())
        });
        if let Err(error) = result {
            assert!(error.to_string().contains("damaged.mcap"), "{error}");
            told += 1;
        }
    }
    assert!(told > 10, "{told}");
    std::fs::write(&path, b"no recording at all").unwrap();
    assert!(Reader::open(&path).is_err());
}

/// Full files are followed by numbered ones, each readable by itself; the number of files is limited.
#[test]
fn files_are_rotated() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let limits = RotationLimits { file_ns: Some(10_000_000), files: Some(2), ..RotationLimits::default() };
    let mut writer = RotatingWriter::create(&path, about(), places(), limits).unwrap();
    for frame in 0..35 {
        for (topic, message) in messages(frame) {
            writer.write(topic, message.as_message()).unwrap();
        }
    }
    assert_eq!(writer.files(), 4);
    writer.finish().unwrap();
    let mut names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["run-0002.mcap", "run-0003.mcap"]);
    assert!(matches(&read(&folder.path().join("run-0002.mcap")).0, 20..30));
    assert!(matches(&read(&folder.path().join("run-0003.mcap")).0, 30..35));
}

/// The queue writes all messages in order if the disk keeps up. A full queue drops whole messages, counts them, and the
/// written messages are still right.
#[test]
fn queues_drop_whole_messages() {
    let folder = tempfile::tempdir().unwrap();
    for (name, limit_bytes, all) in [("roomy.mcap", 1 << 26, true), ("none.mcap", 100, false)] {
        let path = folder.path().join(name);
        let writer = RotatingWriter::create(&path, about(), places(), RotationLimits::default()).unwrap();
        let queue = RecordingQueue::start(writer, limit_bytes).unwrap();
        for frame in 0..20 {
            for (topic, message) in messages(frame) {
                assert!(queue.push(topic, message));
            }
        }
        let counts = queue.finish().unwrap();
        assert_eq!(counts.written + counts.dropped, 100);
        let (entries, _) = read(&path);
        assert_eq!(entries.len() as u64, counts.written);
        if all {
            assert!(matches(&entries, 0..20));
        } else {
            assert!(counts.dropped > 0);
        }
    }
}

/// Other tools find the image, the calibration, the pose and the boxes under their standard names.
#[test]
fn other_tools_know_the_schemas() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut writer = Writer::create(&path, &about(), &places()).unwrap();
    for (topic, message) in messages(3) {
        writer.write(topic, message.as_message()).unwrap();
    }
    writer.finish().unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let mut found: Vec<(String, String, String)> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(|m| {
            let channel = m.unwrap().channel;
            let schema = channel.schema.as_ref().unwrap();
            (channel.topic.clone(), schema.name.clone(), schema.encoding.clone())
        })
        .collect();
    found.sort();
    let expected = [
        ("camera/calibration", "foxglove.CameraCalibration", "protobuf"),
        ("camera/frame", "carff.Frame", "jsonschema"),
        ("camera/image", "foxglove.RawImage", "protobuf"),
        ("camera/pose", "foxglove.FrameTransform", "protobuf"),
        ("controller/action", "carff.Action", "jsonschema"),
        ("encoder/posterior", "carff.Posterior", "jsonschema"),
        ("log", "foxglove.Log", "protobuf"),
        ("prober/belief", "carff.Belief", "jsonschema"),
        ("prober/boxes/step1", "foxglove.SceneUpdate", "protobuf"),
        ("renderer/birds-eye/calibration", "foxglove.CameraCalibration", "protobuf"),
        ("renderer/birds-eye/pose", "foxglove.FrameTransform", "protobuf"),
        ("renderer/birds-eye/step1/hypothesis0/image", "foxglove.RawImage", "protobuf"),
        ("renderer/view", "carff.View", "jsonschema"),
    ];
    assert_eq!(found.len(), expected.len());
    for (found, (topic, schema, encoding)) in found.iter().zip(expected) {
        assert_eq!((found.0.as_str(), found.1.as_str(), found.2.as_str()), (topic, schema, encoding));
    }
}

mod rewritten;
mod streams;
