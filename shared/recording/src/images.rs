//! Camera images in MCAP files of other tools: ROS 2 bags and Foxglove's recordings.
//!
//! The pixels are borrowed from the message; only JPEG and PNG are decoded.

use crate::bag::{Bag, Channel};
use crate::cdr::Cdr;
use crate::{MessageError, RecordingError};
use bytes::Bytes;
use carff_dataset::{CalibrationError, CameraCalibration, Image, PixelFormat, RawImage};
use foxglove::Decode;
use foxglove::messages;
use std::collections::BTreeMap;
use std::path::Path;

/// Number of images before which a recording must contain its calibration.
const IMAGES_BEFORE_CALIBRATION: usize = 64;

/// Kinds of messages that contain an image or a calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    RosImage,
    RosCompressed,
    RosCalibration,
    /// Foxglove's messages as ROS 2 defines them.
    FoxgloveCdrImage,
    FoxgloveCdrCompressed,
    FoxgloveImage,
    FoxgloveCompressed,
    FoxgloveCalibration,
}

/// Schema names and message encodings of the kinds.
const KINDS: [(&str, &str, Kind); 8] = [
    ("sensor_msgs/msg/Image", "cdr", Kind::RosImage),
    ("sensor_msgs/msg/CompressedImage", "cdr", Kind::RosCompressed),
    ("sensor_msgs/msg/CameraInfo", "cdr", Kind::RosCalibration),
    ("foxglove_msgs/msg/RawImage", "cdr", Kind::FoxgloveCdrImage),
    ("foxglove_msgs/msg/CompressedImage", "cdr", Kind::FoxgloveCdrCompressed),
    ("foxglove.RawImage", "protobuf", Kind::FoxgloveImage),
    ("foxglove.CompressedImage", "protobuf", Kind::FoxgloveCompressed),
    ("foxglove.CameraCalibration", "protobuf", Kind::FoxgloveCalibration),
];

impl Kind {
    fn is_calibration(self) -> bool {
        matches!(self, Self::RosCalibration | Self::FoxgloveCalibration)
    }
}

/// Reads the images of one channel, in the order of the file.
///
/// ```no_run
/// use carff_recording::ImageReader;
/// let mut images = ImageReader::open("drive.mcap".as_ref(), Some("/camera/front/image_raw"))?;
/// while let Some(recorded_ns) = images.next()? {
///     println!("{recorded_ns}: {:?}", images.origin()?);
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct ImageReader {
    bag: Bag,
    topic: String,
    kind: Kind,
    message: Bytes,
}

impl std::fmt::Debug for ImageReader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ImageReader")
            .field("file", &self.bag.path())
            .field("topic", &self.topic)
            .finish_non_exhaustive()
    }
}

/// Time and coordinate frame in which an image was taken.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImageOrigin {
    /// Capture time: nanoseconds since 1970.
    pub captured_ns: u64,
    /// Name of the camera's coordinate frame: x right, y down, z forward.
    pub frame: String,
}

impl ImageReader {
    /// Opens a recording, or the recordings in a folder in the order of their names, and finds the channel of the
    /// images: the named one, or the only one.
    pub fn open(path: &Path, topic: Option<&str>) -> Result<Self, RecordingError> {
        let bag = Bag::open(path)?;
        let (topic, kind) = choose(path, &bag.channels()?, topic)?;
        Ok(Self { bag, topic, kind, message: Bytes::new() })
    }

    /// Starts again at the first image.
    pub fn rewind(&mut self) -> Result<(), RecordingError> {
        self.bag.rewind()
    }

    /// Returns the channel of the images.
    pub fn topic(&self) -> &str {
        &self.topic
    }

    /// Advances to the next image. Returns the time at which it was recorded, nanoseconds; `None` at the end.
    ///
    /// # Errors
    ///
    /// If the file is damaged. What follows in it cannot be read.
    #[allow(clippy::should_implement_trait, reason = "errors do not end it: the next image may be valid")]
    pub fn next(&mut self) -> Result<Option<u64>, RecordingError> {
        let found = self.bag.next(|channel| channel.topic == self.topic)?;
        Ok(found.map(|message| {
            self.message = message.data;
            message.log_time_ns
        }))
    }

    /// Returns when and in which coordinate frame the current image was taken.
    ///
    /// # Errors
    ///
    /// If the message is damaged.
    pub fn origin(&self) -> Result<ImageOrigin, ImageError> {
        origin(self.kind, &self.message).map_err(|cause| self.error(cause))
    }

    fn error(&self, cause: MessageError) -> ImageError {
        ImageError { topic: self.topic.clone(), cause: cause.0 }
    }

    /// Calls a function with the current image.
    ///
    /// # Errors
    ///
    /// If the message is damaged, or its encoding is not supported.
    pub fn with_image<R>(&self, each: impl FnOnce(&RawImage<'_>) -> R) -> Result<R, ImageError> {
        with_image(self.kind, &self.message, Path::new(&self.topic), each).map_err(|cause| self.error(cause))
    }

    /// Returns the calibration that the recording contains for its images, and then starts again at the first image.
    pub fn calibration(&mut self) -> Result<Option<CameraCalibration>, RecordingError> {
        let namespace = namespace(&self.topic);
        let is_rectified = self.topic.rsplit('/').any(|part| part.starts_with("image_rect"));
        let calibrates = |channel: &Channel| {
            channel.kind(&KINDS).filter(|k| k.is_calibration() && self::namespace(&channel.topic) == namespace)
        };
        let mut found = None;
        let mut messages = 0;
        while found.is_none() && messages < IMAGES_BEFORE_CALIBRATION {
            let wanted = |channel: &Channel| channel.topic == self.topic || calibrates(channel).is_some();
            let Some(message) = self.bag.next(wanted)? else { break };
            messages += 1;
            if let Some(kind) = calibrates(&message.channel) {
                let path = self.bag.path();
                let wrong = |cause| RecordingError::Calibration { path: path.to_owned(), cause };
                let parsed = calibration_of(kind, &message.data, is_rectified).map_err(|e| wrong(e.0))?;
                found = Some(parsed.map_err(|e| wrong(e.to_string()))?);
            }
        }
        self.bag.rewind()?;
        Ok(found)
    }
}

/// Reason why one image of a recording cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("an image of channel `{topic}` cannot be used: {cause}; omit it, or record the channel again")]
pub struct ImageError {
    /// Channel of the image.
    topic: String,
    /// Description of the error.
    cause: String,
}

/// Chooses the channel of the images.
fn choose(
    path: &Path,
    found: &BTreeMap<String, Channel>,
    topic: Option<&str>,
) -> Result<(String, Kind), RecordingError> {
    let images: Vec<(&String, Kind)> = found
        .iter()
        .filter_map(|(topic, channel)| Some((topic, channel.kind(&KINDS).filter(|kind| !kind.is_calibration())?)))
        .collect();
    let names = || images.iter().map(|(topic, _)| topic.as_str()).collect::<Vec<_>>().join("`, `");
    match (topic, &images[..]) {
        (_, []) => {
            let named = |c: &Channel| format!("`{}` ({} in {})", c.topic, c.schema, c.encoding);
            let channels = found.values().map(named).collect::<Vec<_>>();
            let channels = if channels.is_empty() { "none".to_owned() } else { channels.join(", ") };
            Err(RecordingError::NoImages { path: path.to_owned(), channels: format!("its channels: {channels}") })
        }
        (None, [(topic, kind)]) => Ok(((*topic).clone(), *kind)),
        (None, _) => Err(RecordingError::SeveralImages { path: path.to_owned(), channels: names() }),
        (Some(wanted), _) => {
            images.iter().find(|(topic, _)| *topic == wanted).map(|(topic, kind)| ((*topic).clone(), *kind)).ok_or_else(
                || RecordingError::NoSuchImages { path: path.to_owned(), topic: wanted.to_owned(), channels: names() },
            )
        }
    }
}

/// Returns the part of a channel's name that images and calibration of a camera share.
fn namespace(topic: &str) -> &str {
    let topic = topic.trim_end_matches("/compressed");
    topic.rsplit_once('/').map_or("", |(namespace, _)| namespace)
}

fn origin(kind: Kind, message: &Bytes) -> Result<ImageOrigin, MessageError> {
    let (captured, frame) = match kind {
        Kind::FoxgloveImage => {
            let image = messages::RawImage::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?;
            (image.timestamp, image.frame_id)
        }
        Kind::FoxgloveCompressed => {
            let image = messages::CompressedImage::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?;
            (image.timestamp, image.frame_id)
        }
        _ => {
            let (captured_ns, frame) = Cdr::new(message)?.header()?;
            return Ok(ImageOrigin { captured_ns, frame: frame.to_owned() });
        }
    };
    let captured_ns = captured.map_or(0, |time| time.total_nanos());
    Ok(ImageOrigin { captured_ns, frame })
}

fn with_image<R>(
    kind: Kind,
    message: &Bytes,
    source: &Path,
    each: impl FnOnce(&RawImage<'_>) -> R,
) -> Result<R, MessageError> {
    let compressed = match kind {
        Kind::RosImage => {
            let mut cdr = Cdr::new(message)?;
            cdr.header()?;
            let (height, width, encoding) = (cdr.u32()?, cdr.u32()?, cdr.text()?);
            cdr.u8()?;
            return raw([width, height], cdr.u32()?, encoding, cdr.bytes()?, each);
        }
        Kind::FoxgloveCdrImage => {
            let mut cdr = Cdr::new(message)?;
            cdr.header()?;
            let (width, height, encoding) = (cdr.u32()?, cdr.u32()?, cdr.text()?);
            return raw([width, height], cdr.u32()?, encoding, cdr.bytes()?, each);
        }
        Kind::FoxgloveImage => {
            let image = messages::RawImage::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?;
            return raw([image.width, image.height], image.step, &image.encoding, &image.data, each);
        }
        Kind::RosCompressed => {
            let mut cdr = Cdr::new(message)?;
            cdr.header()?;
            cdr.text()?;
            Bytes::copy_from_slice(cdr.bytes()?)
        }
        Kind::FoxgloveCdrCompressed => {
            let mut cdr = Cdr::new(message)?;
            cdr.header()?;
            Bytes::copy_from_slice(cdr.bytes()?)
        }
        Kind::FoxgloveCompressed => {
            messages::CompressedImage::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?.data
        }
        Kind::RosCalibration | Kind::FoxgloveCalibration => {
            return Err(MessageError("it is a calibration: choose a channel of images".to_owned()));
        }
    };
    let image = Image::decode(&compressed, source).map_err(|e| MessageError(e.to_string()))?;
    Ok(each(&RawImage::rgb([image.width_px, image.height_px], &image.rgb)?))
}

/// Calls a function with an uncompressed image.
fn raw<R>(
    size_px: [u32; 2],
    step: u32,
    encoding: &str,
    data: &[u8],
    each: impl FnOnce(&RawImage<'_>) -> R,
) -> Result<R, MessageError> {
    let format: PixelFormat = encoding.parse()?;
    Ok(each(&RawImage::new(size_px, step as usize, format, data)?))
}

fn calibration_of(
    kind: Kind,
    message: &Bytes,
    is_rectified: bool,
) -> Result<Result<CameraCalibration, CalibrationError>, MessageError> {
    let (size_px, model, d, k, p) = if kind == Kind::RosCalibration {
        let mut cdr = Cdr::new(message)?;
        cdr.header()?;
        let (height, width, model) = (cdr.u32()?, cdr.u32()?, cdr.text()?.to_owned());
        let count = cdr.u32()? as usize;
        let (d, k, _r, p) = (cdr.f64s(count)?, cdr.f64s(9)?, cdr.f64s(9)?, cdr.f64s(12)?);
        let binning = [cdr.u32()?, cdr.u32()?];
        let [x, y, _, _] = [cdr.u32()?, cdr.u32()?, cdr.u32()?, cdr.u32()?];
        if binning.iter().any(|&n| n > 1) || x + y > 0 {
            return Err(MessageError("its binning or region of interest is not supported".to_owned()));
        }
        ([width, height], model, d, k, p)
    } else {
        let c = messages::CameraCalibration::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?;
        ([c.width, c.height], c.distortion_model, c.d, c.k, c.p)
    };
    if let (true, &[fx, _, cx, _, _, fy, cy, ..]) = (is_rectified, &p[..]) {
        return Ok(CameraCalibration::of_ros(size_px, "", &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], &[]));
    }
    Ok(CameraCalibration::of_ros(size_px, &model, &k, &d))
}
