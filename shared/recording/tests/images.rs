//! Tests of reading camera images in MCAP files of other tools.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_dataset::DistortionModel;
use carff_recording::ImageReader;
use foxglove::{Encode, messages};
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn bag(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(name)
}

/// Reads all images: recorded times, and the colours of a pixel on the left and on the right.
fn all(reader: &mut ImageReader) -> Vec<(u64, [u8; 3], [u8; 3])> {
    let mut images = Vec::new();
    while let Some(time_ns) = reader.next().unwrap() {
        let (left, right) = reader.with_image(|raw| (raw.pixel(3, 5), raw.pixel(28, 30))).unwrap();
        images.push((time_ns, left, right));
    }
    images
}

/// The images and the calibration of a ROS 2 bag of another implementation are read, again after a rewind.
#[test]
fn bags_of_ros_are_read() {
    let mut reader = ImageReader::open(&bag("ros2-raw.mcap"), None).unwrap();
    assert_eq!(reader.topic(), "/front/image_raw");
    let calibration = reader.calibration().unwrap().unwrap();
    assert_eq!((calibration.size_px(), calibration.fl_x_px, calibration.cx_px), ([32, 32], 25.0, 15.5));
    assert_eq!((calibration.model, calibration.distortion[0]), (DistortionModel::PlumbBob, -0.05));
    for _ in 0..2 {
        let images = all(&mut reader);
        assert_eq!(images.len(), 4);
        for (i, (time_ns, left, right)) in (0..).zip(images) {
            assert_eq!(time_ns, 1_700_000_000_000_000_000 + i * 100_000_000);
            assert_eq!((left, right), ([10 * i as u8, 100, 200], [10 * i as u8, 100, 0]));
        }
        reader.rewind().unwrap();
    }
}

/// Compressed images are decoded, and find the calibration of their camera.
#[test]
fn compressed_images_are_decoded() {
    let mut reader = ImageReader::open(&bag("ros2-jpeg.mcap"), None).unwrap();
    assert_eq!(reader.calibration().unwrap().unwrap().fl_x_px, 25.0);
    let images = all(&mut reader);
    assert_eq!(images.len(), 4);
    for (i, (_, left, right)) in images.into_iter().enumerate() {
        for (found, wanted) in [(left, [10 * i as u8, 100, 200]), (right, [10 * i as u8, 100, 0])] {
            assert!(found.iter().zip(wanted).all(|(f, w)| f.abs_diff(w) < 6), "{found:?} {wanted:?}");
        }
    }
}

/// A bag without images, a bag with several cameras, an unknown channel and a missing file are errors that name the
/// channels and the remedy.
#[test]
fn unusable_bags_are_refused() {
    let error = |name: &str, topic: Option<&str>| ImageReader::open(&bag(name), topic).unwrap_err().to_string();
    let none = error("ros2-none.mcap", None);
    assert!(
        none.contains("no images") && none.contains("/chatter") && none.contains("sensor_msgs/msg/Image"),
        "{none}"
    );
    let two = error("ros2-two.mcap", None);
    assert!(two.contains("camera.topic") && two.contains("/front/image_raw`, `/rear/image_raw"), "{two}");
    let unknown = error("ros2-raw.mcap", Some("/left"));
    assert!(unknown.contains("no images on `/left`") && unknown.contains("/front/image_raw"), "{unknown}");
    assert!(error("missing.mcap", None).contains("missing.mcap"));
    assert!(error("make_bags.py", None).contains("not an MCAP file"));
    assert!(ImageReader::open(&bag("ros2-two.mcap"), Some("/rear/image_raw")).is_ok());
    let empty = tempfile::tempdir().unwrap();
    assert!(ImageReader::open(empty.path(), None).unwrap_err().to_string().contains("no file *.mcap"));
}

/// Writes a file with one channel of Foxglove's images.
fn foxglove(path: &Path, schema: &foxglove::Schema, messages: &[Vec<u8>]) {
    let mut writer = mcap::Writer::new(std::fs::File::create(path).unwrap()).unwrap();
    let id = writer.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
    let channel_id = writer.add_channel(id, "/camera", "protobuf", &BTreeMap::new()).unwrap();
    for (sequence, data) in (0..).zip(messages) {
        let time = u64::from(sequence) * 1_000_000;
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, data).unwrap();
    }
    writer.finish().unwrap();
}

fn raw_image(width: u32, encoding: &str, data: Vec<u8>) -> messages::RawImage {
    let encoding = encoding.to_owned();
    messages::RawImage { width, height: 32, encoding, step: width * 3, data: data.into(), ..Default::default() }
}

fn encoded(message: &impl Encode) -> Vec<u8> {
    let mut bytes = Vec::new();
    message.encode(&mut bytes).unwrap();
    bytes
}

/// Foxglove's images are read. A wrong image is an error of its own, and the next one is read.
#[test]
fn foxgloves_images_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("foxglove.mcap");
    let good = encoded(&raw_image(32, "rgb8", [1, 2, 3].repeat(32 * 32)));
    let schema = messages::RawImage::get_schema().unwrap();
    let wrong = [
        encoded(&raw_image(32, "bayer_rggb8", vec![0; 32 * 32 * 3])),
        encoded(&raw_image(32, "rgb8", vec![0; 100])),
        encoded(&raw_image(0, "rgb8", Vec::new())),
        vec![0xff; 40],
    ];
    let messages: Vec<Vec<u8>> = wrong.into_iter().chain([good]).collect();
    foxglove(&path, &schema, &messages);
    let mut reader = ImageReader::open(&path, None).unwrap();
    assert_eq!(reader.calibration().unwrap(), None);
    let mut told = Vec::new();
    while reader.next().unwrap().is_some() {
        told.push(reader.with_image(|raw| raw.pixel(31, 31)).map_err(|e| e.to_string()));
    }
    for (found, words) in told.iter().zip(["bayer_rggb8", "cut off", "0x32", "/camera"]) {
        assert!(found.as_ref().unwrap_err().contains(words), "{found:?}");
    }
    assert_eq!(told[4], Ok([1, 2, 3]));
}

/// A damaged or cut-off file is read up to the damage; no byte makes the reader panic.
#[test]
fn damaged_files_end_early() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("damaged.mcap");
    let whole = std::fs::read(bag("ros2-raw.mcap")).unwrap();
    for at in (9..whole.len()).step_by(97) {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x55;
        for damaged in [&bytes[..], &whole[..at]] {
            std::fs::write(&path, damaged).unwrap();
            let Ok(mut reader) = ImageReader::open(&path, None) else { continue };
            let _ = reader.calibration();
            while let Ok(Some(_)) = reader.next() {
                let _ = reader.with_image(|raw| raw.pixel(0, 0));
            }
        }
    }
}
