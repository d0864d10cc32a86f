//! Camera images in MCAP files of other tools: ROS 2 bags and Foxglove's recordings.
//!
//! The pixels are borrowed from the message; only JPEG and PNG are decoded.

use crate::cdr::Cdr;
use crate::{MessageError, RecordingError};
use bytes::Bytes;
use carff_dataset::{Calibration, CalibrationError, Image, PixelFormat, RawImage};
use foxglove::Decode;
use foxglove::messages;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, McapResult};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Maximum length of a record, bytes: an image of the largest size with four bytes a pixel.
const MAX_RECORD_BYTES: usize = 1 << 28;
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

/// A channel of a file.
#[derive(Clone, Debug)]
struct Channel {
    topic: String,
    schema: String,
    kind: Option<Kind>,
}

/// Reads the images of one channel, in the order of the file.
pub struct ImageReader {
    files: Vec<PathBuf>,
    /// Number of the open file.
    file: usize,
    records: Records,
    channels: BTreeMap<u16, Channel>,
    schemas: BTreeMap<u16, String>,
    topic: String,
    kind: Kind,
    message: Bytes,
}

impl std::fmt::Debug for ImageReader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ImageReader").field("files", &self.files).field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl ImageReader {
    /// Opens a recording, or the recordings in a folder in the order of their names, and finds the channel of the
    /// images: the named one, or the only one.
    pub fn open(path: &Path, topic: Option<&str>) -> Result<Self, RecordingError> {
        let files = files(path)?;
        let mut found = BTreeMap::new();
        for file in &files {
            for channel in channels(file)? {
                found.insert(channel.topic.clone(), channel);
            }
        }
        let (topic, kind) = choose(path, &found, topic)?;
        let records = Records::open(&files[0])?;
        let (channels, schemas) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self { files, file: 0, records, channels, schemas, topic, kind, message: Bytes::new() })
    }

    /// Starts again at the first image.
    pub fn rewind(&mut self) -> Result<(), RecordingError> {
        self.file = 0;
        self.open_file()
    }

    fn open_file(&mut self) -> Result<(), RecordingError> {
        self.records = Records::open(&self.files[self.file])?;
        self.channels.clear();
        self.schemas.clear();
        Ok(())
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
        let topic = self.topic.clone();
        self.next_of(|channel| channel.topic == topic)
    }

    fn next_of(&mut self, wanted: impl Fn(&Channel) -> bool) -> Result<Option<u64>, RecordingError> {
        loop {
            let Self { records, channels, schemas, message, .. } = self;
            let mut found = None;
            let more = records.next(|record| {
                note(&record, schemas, channels);
                if let Record::Message { header, data } = record
                    && channels.get(&header.channel_id).is_some_and(&wanted)
                {
                    *message = Bytes::copy_from_slice(&data);
                    found = Some(header.log_time);
                }
            });
            match more {
                Ok(true) if found.is_some() => return Ok(found),
                Ok(true) => {}
                Ok(false) if self.file + 1 < self.files.len() => {
                    self.file += 1;
                    self.open_file()?;
                }
                Ok(false) => return Ok(None),
                Err(error) => return Err(RecordingError::mcap(&self.files[self.file], error)),
            }
        }
    }

    /// Calls a function with the current image.
    ///
    /// # Errors
    ///
    /// If the message is damaged, or its encoding is not supported.
    pub fn with_image<R>(&self, each: impl FnOnce(&RawImage<'_>) -> R) -> Result<R, ImageError> {
        let wrong = |cause: MessageError| ImageError { topic: self.topic.clone(), cause: cause.0 };
        with_image(self.kind, &self.message, Path::new(&self.topic), each).map_err(wrong)
    }

    /// Returns the calibration that the recording contains for its images, and then starts again at the first image.
    pub fn calibration(&mut self) -> Result<Option<Calibration>, RecordingError> {
        let namespace = namespace(&self.topic).to_owned();
        let mut found = None;
        let mut images = 0;
        while found.is_none() && images < IMAGES_BEFORE_CALIBRATION {
            let topic = self.topic.clone();
            let wanted = |channel: &Channel| {
                let calibrates = channel.kind.is_some_and(Kind::is_calibration);
                channel.topic == topic || calibrates && self::namespace(&channel.topic) == namespace
            };
            let Some(_) = self.next_of(wanted)? else { break };
            images += 1;
            let is_rectified = self.topic.rsplit('/').any(|part| part.starts_with("image_rect"));
            // An image does not parse as a calibration of the kind of its channel.
            found = self.current_kind().filter(|kind| kind.is_calibration()).map(|kind| {
                let wrong = |cause: String| RecordingError::Calibration { path: self.files[self.file].clone(), cause };
                let parsed = calibration_of(kind, &self.message, is_rectified).map_err(|e| wrong(e.0))?;
                parsed.map_err(|e| wrong(e.to_string()))
            });
        }
        self.rewind()?;
        found.transpose()
    }

    fn current_kind(&self) -> Option<Kind> {
        self.channels.get(&self.records.channel_id).and_then(|channel| channel.kind)
    }
}

/// Reason why one image of a recording cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("an image of channel `{topic}` cannot be used: {cause}")]
pub struct ImageError {
    /// Channel of the image.
    topic: String,
    /// Description of the error.
    cause: String,
}

/// The records of a file, one after the other.
struct Records {
    file: File,
    reader: LinearReader,
    /// Channel of the latest message.
    channel_id: u16,
}

impl Records {
    fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|source| RecordingError::Io { path: path.to_owned(), source })?;
        let options = LinearReaderOptions::default()
            .with_record_length_limit(MAX_RECORD_BYTES)
            .with_validate_chunk_crcs(true)
            .with_skip_end_magic(true);
        Ok(Self { file, reader: LinearReader::new_with_options(options), channel_id: 0 })
    }

    /// Passes the next record to `each`; returns false at the end. A file whose writer was killed ends early.
    fn next(&mut self, each: impl FnOnce(Record<'_>)) -> McapResult<bool> {
        loop {
            match self.reader.next_event() {
                None | Some(Err(McapError::UnexpectedEof)) => return Ok(false),
                Some(Err(error)) => return Err(error),
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let read = self.file.read(self.reader.insert(wanted.min(MAX_RECORD_BYTES)))?;
                    self.reader.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    if opcode == op::FOOTER {
                        return Ok(false);
                    }
                    let record = mcap::parse_record(opcode, data)?;
                    if let Record::Message { header, .. } = &record {
                        self.channel_id = header.channel_id;
                    }
                    each(record);
                    return Ok(true);
                }
            }
        }
    }
}

/// Takes notice of schemas and channels.
fn note(record: &Record<'_>, schemas: &mut BTreeMap<u16, String>, channels: &mut BTreeMap<u16, Channel>) {
    match record {
        Record::Schema { header, .. } => drop(schemas.insert(header.id, header.name.clone())),
        Record::Channel(channel) => {
            let schema = schemas.get(&channel.schema_id).cloned().unwrap_or_default();
            let known =
                KINDS.iter().find(|(name, encoding, _)| *name == schema && *encoding == channel.message_encoding);
            let kind = known.map(|(.., kind)| *kind);
            let schema = format!("{schema} in {}", channel.message_encoding);
            channels.insert(channel.id, Channel { topic: channel.topic.clone(), schema, kind });
        }
        _ => {}
    }
}

/// Returns the channels of a file: from its summary, or by reading it.
fn channels(path: &Path) -> Result<Vec<Channel>, RecordingError> {
    let (mut schemas, mut channels) = (BTreeMap::new(), BTreeMap::new());
    let mut records = Records::open(path)?;
    let wrong = |error| RecordingError::mcap(path, error);
    let summary = crate::summary::range(&mut records.file).map_err(wrong)?;
    if let Some(range) = summary {
        let each = |record: Record<'_>| note(&record, &mut schemas, &mut channels);
        crate::reader::records(&mut records.file, range, each).map_err(wrong)?;
    }
    if channels.is_empty() {
        let mut records = Records::open(path)?;
        while records.next(|record| note(&record, &mut schemas, &mut channels)).map_err(wrong)? {}
    }
    Ok(channels.into_values().collect())
}

/// Returns the files of a path, which may be a folder of recordings.
fn files(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let io = |source| RecordingError::Io { path: path.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io)? {
        let file = entry.map_err(io)?.path();
        if file.extension().is_some_and(|extension| extension == "mcap") {
            files.push(file);
        }
    }
    // `bag_10.mcap` comes after `bag_9.mcap`.
    files.sort_by_key(|file| (file.as_os_str().len(), file.clone()));
    if files.is_empty() {
        return Err(RecordingError::NoImages { path: path.to_owned(), channels: "no file *.mcap is in it".to_owned() });
    }
    Ok(files)
}

/// Chooses the channel of the images.
fn choose(
    path: &Path,
    found: &BTreeMap<String, Channel>,
    topic: Option<&str>,
) -> Result<(String, Kind), RecordingError> {
    let images: Vec<(&String, Kind)> = found
        .iter()
        .filter_map(|(topic, channel)| Some((topic, channel.kind.filter(|kind| !kind.is_calibration())?)))
        .collect();
    let names = || images.iter().map(|(topic, _)| topic.as_str()).collect::<Vec<_>>().join("`, `");
    match (topic, &images[..]) {
        (_, []) => {
            let channels = found.values().map(|c| format!("`{}` ({})", c.topic, c.schema)).collect::<Vec<_>>();
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

fn with_image<R>(
    kind: Kind,
    message: &Bytes,
    source: &Path,
    each: impl FnOnce(&RawImage<'_>) -> R,
) -> Result<R, MessageError> {
    let compressed = match kind {
        Kind::RosImage => {
            let mut cdr = Cdr::new(message)?;
            cdr.skip_header()?;
            let (height, width, encoding) = (cdr.u32()?, cdr.u32()?, cdr.text()?);
            cdr.u8()?;
            return raw([width, height], cdr.u32()?, encoding, cdr.bytes()?, each);
        }
        Kind::FoxgloveCdrImage => {
            let mut cdr = Cdr::new(message)?;
            cdr.skip_header()?;
            let (width, height, encoding) = (cdr.u32()?, cdr.u32()?, cdr.text()?);
            return raw([width, height], cdr.u32()?, encoding, cdr.bytes()?, each);
        }
        Kind::FoxgloveImage => {
            let image = messages::RawImage::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?;
            return raw([image.width, image.height], image.step, &image.encoding, &image.data, each);
        }
        Kind::RosCompressed => {
            let mut cdr = Cdr::new(message)?;
            cdr.skip_header()?;
            cdr.text()?;
            Bytes::copy_from_slice(cdr.bytes()?)
        }
        Kind::FoxgloveCdrCompressed => {
            let mut cdr = Cdr::new(message)?;
            cdr.skip_header()?;
            Bytes::copy_from_slice(cdr.bytes()?)
        }
        Kind::FoxgloveCompressed => {
            messages::CompressedImage::decode(message.clone()).map_err(|e| MessageError(e.to_string()))?.data
        }
        Kind::RosCalibration | Kind::FoxgloveCalibration => {
            return Err(MessageError("it is a calibration".to_owned()));
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
) -> Result<Result<Calibration, CalibrationError>, MessageError> {
    let (size_px, model, d, k, p) = if kind == Kind::RosCalibration {
        let mut cdr = Cdr::new(message)?;
        cdr.skip_header()?;
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
        return Ok(Calibration::of_ros(size_px, "", &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], &[]));
    }
    Ok(Calibration::of_ros(size_px, &model, &k, &d))
}
