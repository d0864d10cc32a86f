//! Images with poses in a recording of another tool (a ROS 2 bag, a Foxglove recording), as a dataset that can be
//! imported.

use anyhow::{Context, anyhow, bail, ensure};
use carff_dataset::{CameraCalibration, DistortionModel, Image};
use carff_recording::{ImageReader, RecordingError, Transforms};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Options for recordings of other tools.
#[derive(Clone, Debug, clap::Args)]
pub struct BagArgs {
    /// Recording: topic of the images; optional if one topic has images.
    #[arg(long, value_name = "TOPIC", help_heading = "Recordings")]
    topic: Option<String>,
    /// Recording: topic of the poses (`PoseStamped`, `Odometry`, `PoseInFrame`); optional if one topic has poses of the
    /// frame. Transforms (`/tf`) are always used.
    #[arg(long, value_name = "TOPIC", help_heading = "Recordings")]
    pose_topic: Option<String>,
    /// Recording: ROS `camera_info` YAML file, in place of the calibration in the recording.
    #[arg(long, value_name = "FILE", help_heading = "Recordings")]
    calibration: Option<PathBuf>,
    /// Recording: number of images to import, evenly spread over those with a pose.
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=10_000), help_heading = "Recordings")]
    images: u32,
}

/// Result of an extraction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Extracted {
    /// Number of images in the recording.
    pub(crate) images: usize,
    /// Number of images without a pose at their time.
    pub(crate) without_pose: usize,
    /// Number of written images.
    pub(crate) written: usize,
}

/// Returns true for a recording, or a folder of recordings.
pub(crate) fn is_recording(path: &Path) -> bool {
    let is_mcap = |path: &Path| path.extension().is_some_and(|extension| extension == "mcap");
    let mut entries = std::fs::read_dir(path).into_iter().flatten().flatten();
    is_mcap(path) || entries.any(|entry| is_mcap(&entry.path()))
}

/// Writes images of a recording with their cameras to a folder, in nerfstudio's format.
pub(crate) fn extract(recording: &Path, out: &Path, args: &BagArgs) -> anyhow::Result<Extracted> {
    let mut reader = ImageReader::open(recording, args.topic.as_deref()).map_err(named_here)?;
    let calibration = match &args.calibration {
        Some(path) => Some(CameraCalibration::load(path)?),
        None => reader.calibration().map_err(named_here)?,
    };
    let calibration = calibration.with_context(|| {
        format!("{} has no calibration of `{}`: pass --calibration FILE", recording.display(), reader.topic())
    })?;
    calibration.check()?;
    let transforms = Transforms::read(recording, args.pose_topic.as_deref())
        .context("cannot read the poses; --pose-topic chooses among several topics")?;
    let (mut poses, mut extracted) = (Vec::new(), Extracted::default());
    while reader.next()?.is_some() {
        let origin = reader.origin()?;
        transforms.check(recording, &origin.frame)?;
        poses.extend(transforms.world_from_camera(&origin).map(|pose| (extracted.images, pose)));
        extracted.images += 1;
    }
    extracted.without_pose = extracted.images - poses.len();
    ensure!(
        !poses.is_empty(),
        "{}: no image has a pose at its time: name another topic with --pose-topic",
        recording.display()
    );
    let count = poses.len().min(args.images as usize);
    let chosen: Vec<_> = (0..count).map(|i| poses[i * poses.len() / count]).collect();
    reader.rewind()?;
    let mut frames = Vec::new();
    let mut image = 0;
    while reader.next()?.is_some() {
        if let Some((_, pose)) = chosen.get(frames.len()).filter(|(number, _)| *number == image) {
            let file = format!("{image:06}.png");
            decoded(&reader, &calibration)?.save_png(&out.join(&file))?;
            frames.push(json!({ "file_path": file, "transform_matrix": pose }));
        }
        image += 1;
    }
    extracted.written = frames.len();
    let set = with_frames(intrinsics(&calibration), frames);
    let path = out.join("transforms.json");
    std::fs::write(&path, set.to_string()).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(extracted)
}

/// Names this command's options in errors whose remedy is a key of the graph file.
fn named_here(error: RecordingError) -> anyhow::Error {
    match error {
        RecordingError::SeveralImages { path, channels } => {
            anyhow!("{} has images on several channels: name one with `--topic`: `{channels}`", path.display())
        }
        RecordingError::Calibration { path, cause } => {
            anyhow!("{}: its calibration cannot be used: {cause}; pass --calibration FILE", path.display())
        }
        other => other.into(),
    }
}

fn decoded(reader: &ImageReader, calibration: &CameraCalibration) -> anyhow::Result<Image> {
    let image = reader.with_image(|raw| {
        let [width_px, height_px] = raw.size_px();
        let mut image = Image::filled(width_px, height_px, [0; 3]);
        raw.write_rgb(&mut image.rgb);
        image
    })?;
    let [width_px, height_px] = calibration.size_px();
    if (image.width_px, image.height_px) != (width_px, height_px) {
        bail!(
            "an image of `{}` has {} x {} pixels, but the calibration is for {width_px} x {height_px}: \
             pass this camera's with --calibration",
            reader.topic(),
            image.width_px,
            image.height_px
        );
    }
    Ok(image)
}

/// Returns the keys of a calibration in nerfstudio's format.
fn intrinsics(calibration: &CameraCalibration) -> Value {
    let coefficient = |index: usize| calibration.distortion.get(index).copied().unwrap_or(0.0);
    let mut keys = json!({
        "w": calibration.width_px,
        "h": calibration.height_px,
        "fl_x": calibration.fl_x_px,
        "fl_y": calibration.fl_y_px,
        // ROS counts from the centre of the first pixel, nerfstudio from its corner.
        "cx": calibration.cx_px + 0.5,
        "cy": calibration.cy_px + 0.5,
    });
    let (model, names) = match calibration.model {
        DistortionModel::Pinhole => return keys,
        DistortionModel::PlumbBob => ("OPENCV", ["k1", "k2", "p1", "p2", "k3"].as_slice()),
        DistortionModel::Fisheye => ("OPENCV_FISHEYE", ["k1", "k2", "k3", "k4"].as_slice()),
    };
    keys["camera_model"] = model.into();
    for (index, name) in names.iter().enumerate() {
        keys[*name] = coefficient(index).into();
    }
    keys
}

fn with_frames(mut set: Value, frames: Vec<Value>) -> Value {
    set["frames"] = frames.into();
    set
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_dataset::{Dataset, ImportOptions, import};

    fn bag(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/recording/testdata").join(name)
    }

    fn args(images: u32) -> BagArgs {
        BagArgs { topic: None, pose_topic: None, calibration: None, images }
    }

    /// A ROS 2 bag becomes a dataset: undistorted images with the camera's poses, evenly spread, without those that have
    /// no pose.
    #[test]
    fn a_bag_becomes_a_dataset() {
        let folder = tempfile::tempdir().unwrap();
        let [set, out] = ["front", "out"].map(|name| folder.path().join(name));
        std::fs::create_dir(&set).unwrap();
        assert!(is_recording(&bag("ros2-tf.mcap")) && is_recording(&bag("")) && !is_recording(&set));
        let extracted = extract(&bag("ros2-tf.mcap"), &set, &args(2)).unwrap();
        assert_eq!(extracted, Extracted { images: 4, without_pose: 1, written: 2 });
        let imported = import(&set, &out, &ImportOptions::default()).unwrap();
        assert_eq!((imported.frames, imported.undistorted), (2, 2));
        let dataset = Dataset::open(&out).unwrap();
        for (frame, y_m) in dataset.frames().iter().zip([0.0, 0.2]) {
            let position_m = frame.camera.position_m();
            assert!(position_m.iter().zip([5.0, y_m, 1.5]).all(|(p, w)| (p - w).abs() < 1e-6), "{position_m:?}");
            let camera = &frame.camera;
            assert_eq!((camera.width_px, camera.fl_x_px, camera.cx_px), (32, 25.0, 16.0));
            let left = Image::load(&frame.image_path).unwrap().pixel(8, 16).unwrap();
            assert_eq!(left[1..], [100, 200]);
        }
    }

    /// A bag without a calibration, without poses, or with a calibration of another size is an error with the remedy.
    #[test]
    fn unusable_bags_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let error = |name: &str, args: &BagArgs| extract(&bag(name), folder.path(), args).unwrap_err().to_string();
        assert!(error("ros2-two.mcap", &args(9)).contains("name one with `--topic`"));
        let rear = BagArgs { topic: Some("/rear/image_raw".to_owned()), ..args(9) };
        assert!(error("ros2-two.mcap", &rear).contains("pass --calibration FILE"));
        assert!(error("ros2-raw.mcap", &args(9)).contains("no pose of the camera frame `camera`"));
        let yaml = folder.path().join("c.yaml");
        let text = "image_width: 64\nimage_height: 64\ncamera_matrix: {data: [50, 0, 32, 0, 50, 32, 0, 0, 1]}\n";
        std::fs::write(&yaml, text).unwrap();
        let other = BagArgs { calibration: Some(yaml), ..args(9) };
        assert!(error("ros2-tf.mcap", &other).contains("32 x 32 pixels, but the calibration is for 64 x 64"));
    }
}
