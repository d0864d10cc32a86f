//! Tests of reading coordinate transforms in MCAP files of other tools.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_recording::{ImageOrigin, ImageReader, Transforms};
use foxglove::Encode;
use foxglove::messages::{FrameTransform, Pose, PoseInFrame, Quaternion, Timestamp, Vector3};
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn bag(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(name)
}

/// Returns the poses of all images of a bag.
fn poses(name: &str) -> Vec<Option<[[f64; 4]; 4]>> {
    let transforms = Transforms::read(&bag(name), None).unwrap();
    let mut reader = ImageReader::open(&bag(name), None).unwrap();
    let mut poses = Vec::new();
    while reader.next().unwrap().is_some() {
        let origin = reader.origin().unwrap();
        transforms.check(&bag(name), &origin.frame).unwrap();
        poses.push(transforms.world_from_camera(&origin));
    }
    poses
}

#[track_caller]
fn assert_close(found: &[[f64; 4]; 4], wanted: &[[f64; 4]; 4]) {
    let differ = found.iter().flatten().zip(wanted.iter().flatten()).any(|(f, w)| (f - w).abs() > 1e-6);
    assert!(!differ, "{found:?}\n{wanted:?}");
}

/// In the bags of another implementation a vehicle drives along +y at 2 m/s, with a camera 1.5 m above it. The camera's
/// pose is interpolated between the transforms before and after each image; the last image has none after it.
#[test]
fn poses_are_those_of_the_camera() {
    // Right is +x, up is +z, and the camera looks along +y.
    let wanted = |y: f64, z: f64| [[1.0, 0.0, 0.0, 5.0], [0.0, 0.0, -1.0, y], [0.0, 1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]];
    for name in ["ros2-tf.mcap", "ros2-odometry.mcap"] {
        let poses = poses(name);
        assert_eq!((poses.len(), poses[3]), (4, None), "{name}");
        for (image, y) in [(0, 0.0), (1, 0.2), (2, 0.4)] {
            assert_close(&poses[image].unwrap(), &wanted(y, 1.5));
        }
    }
    // A pose without a child frame is that of the camera: here it looks along +z, with its x along the world's y.
    let poses = poses("ros2-pose.mcap");
    assert_eq!((poses.len(), poses[3]), (4, None));
    let wanted = [[0.0, 1.0, 0.0, 5.0], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    assert_close(&poses[1].unwrap(), &wanted);
}

/// A message of Foxglove, with its topic.
type Message = (&'static str, &'static str, Vec<u8>);

fn transform(topic: &'static str, at_ns: u32, names: [&str; 2], x: f64, rotation: [f64; 4]) -> Message {
    let [x_, y, z, w] = rotation;
    let transform = FrameTransform {
        timestamp: Some(Timestamp::new(0, at_ns)),
        parent_frame_id: names[0].to_owned(),
        child_frame_id: names[1].to_owned(),
        translation: Some(Vector3 { x, y: 0.0, z: 0.0 }),
        rotation: Some(Quaternion { x: x_, y, z, w }),
    };
    (topic, "foxglove.FrameTransform", encoded(&transform))
}

fn pose(topic: &'static str, at_ns: u32) -> Message {
    let position = Some(Vector3 { x: 3.0, y: 0.0, z: 0.0 });
    let pose = Pose { position, orientation: Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }) };
    let stamp = Some(Timestamp::new(0, at_ns));
    let message = PoseInFrame { timestamp: stamp, frame_id: "map".to_owned(), pose: Some(pose) };
    (topic, "foxglove.PoseInFrame", encoded(&message))
}

fn encoded(message: &impl Encode) -> Vec<u8> {
    let mut data = Vec::new();
    message.encode(&mut data).map_err(|_| "encoding failed").unwrap();
    data
}

fn written(path: &Path, messages: &[Message]) {
    let mut writer = mcap::Writer::new(std::fs::File::create(path).unwrap()).unwrap();
    for (sequence, (topic, schema, data)) in (0..).zip(messages) {
        let id = writer.add_schema(schema, "protobuf", &[]).unwrap();
        let channel_id = writer.add_channel(id, topic, "protobuf", &BTreeMap::new()).unwrap();
        let header = MessageHeader { channel_id, sequence, log_time: 0, publish_time: 0 };
        writer.write_to_known_channel(&header, data).unwrap();
    }
    writer.finish().unwrap();
}

/// Transforms are chained and interpolated. A gap of more than a second and a circle give no pose, and a transform that
/// is not rigid is an error. If two topics have poses, one must be named.
#[test]
fn transforms_are_chained() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.mcap");
    let level = [0.0, 0.0, 0.0, 1.0];
    let read = |messages: &[Message], topic: Option<&str>| {
        written(&path, messages);
        Transforms::read(&path, topic)
    };
    let x_at = |transforms: &Transforms, captured_ns: u64| {
        let origin = ImageOrigin { captured_ns, frame: "camera".to_owned() };
        transforms.world_from_camera(&origin).map(|pose| pose[0][3])
    };
    let chain = [
        transform("/tf", 0, ["map", "base"], 0.0, level),
        // The same rotation, with the other sign.
        transform("/tf", 400_000_000, ["map", "base"], 4.0, [0.0, 0.0, 0.0, -1.0]),
        transform("/static", 7, ["base", "camera"], 0.5, level),
    ];
    let chained = read(&chain, None).unwrap();
    assert_eq!([0, 100_000_000, 400_000_000].map(|at| x_at(&chained, at)), [Some(0.5), Some(1.5), Some(4.5)]);
    assert_eq!(x_at(&chained, 400_000_001), None);
    assert!(chained.check(&path, "camera").is_ok());
    let error = chained.check(&path, "rear").unwrap_err().to_string();
    assert!(
        error.contains("`rear`") && error.contains("`camera` in `base`, `base` in `map`")
            || error.contains("`base` in `map`, `camera` in `base`"),
        "{error}"
    );

    let times = [0, 900_000_000].map(|at| transform("/tf", at, ["map", "camera"], 1.0, level));
    assert_eq!(x_at(&read(&times, None).unwrap(), 500_000_000), Some(1.0));
    let circle = [["a", "camera"], ["camera", "a"]].map(|names| transform("/tf", 0, names, 1.0, level));
    assert_eq!(x_at(&read(&circle, None).unwrap(), 0), None);
    let error = read(&[transform("/tf", 0, ["a", "b"], 1.0, [0.0; 4])], None).unwrap_err().to_string();
    assert!(error.contains("`/tf`") && error.contains("unit quaternion"), "{error}");

    let two = [pose("/slam", 0), pose("/gps", 0)];
    let error = read(&two, None).unwrap_err().to_string();
    assert!(error.contains("`/gps`") && error.contains("`/slam` has poses too"), "{error}");
    assert_eq!(x_at(&read(&two, Some("/gps")).unwrap(), 5), Some(3.0));
    assert!(read(&[], None).unwrap().check(&path, "camera").unwrap_err().to_string().contains("no transforms"));
}
