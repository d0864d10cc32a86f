//! Reads a recording message by message, in the order of publication.
//!
//! Other tools rewrite recordings: in another order, with or without chunks, index and metadata. So a reader first goes
//! through the whole file and notes the position of each message.

use crate::about::METADATA;
use crate::channels::Content;
use crate::{MessageError, RecordingAbout, RecordingError};
use carff_messages::forms::{FormError, OwnedMessage, read};
use carff_messages::{FrameMeta, MAX_IMAGE_BYTES, SCHEMA_VERSION, ViewMeta};
use carff_transport::TopicId;
use foxglove::Decode;
use foxglove::messages::RawImage;
use mcap::records::{MessageHeader, Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, McapResult};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Maximum length of a record, bytes: enough for an image of the largest size.
const MAX_RECORD_BYTES: usize = 4 * MAX_IMAGE_BYTES;
/// Maximum size of the messages in a chunk, bytes.
const MAX_CHUNK_BYTES: usize = 1 << 30;
/// Length of a record's code and length, bytes.
const RECORD_HEAD_BYTES: u64 = 9;

/// A message with its topic.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Topic of the message.
    pub topic: TopicId,
    /// Time of publication: nanoseconds since 1970.
    pub wall_time_ns: u64,
    /// The message, validated.
    pub message: OwnedMessage,
}

/// Position of a message: a segment, and the message's number in it.
type Position = (usize, usize);

/// A part of the file that is read as a whole: a chunk, or one record outside of chunks.
#[derive(Debug)]
struct Segment {
    range: Range<u64>,
    /// Time of the last message: after it, the content is not needed.
    last_ns: u64,
}

/// A message in the file.
#[derive(Debug)]
struct Located {
    published_ns: u64,
    sequence: u32,
    topic: TopicId,
    position: Position,
}

/// Reads a recording from the beginning.
pub struct Reader {
    path: PathBuf,
    file: BufReader<File>,
    file_bytes: u64,
    about: Option<RecordingAbout>,
    has_other_format: bool,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, (String, Option<Content>)>,
    /// Ids of channels with messages.
    used: BTreeSet<u16>,
    segments: Vec<Segment>,
    /// The remaining messages, last first.
    messages: Vec<Located>,
    /// Position of each image, by its topic, time and sequence number; `None` if several have the same.
    images: BTreeMap<(TopicId, u64, u32), Option<Position>>,
    /// Messages of the segments in use.
    loaded: BTreeMap<usize, Vec<Option<Vec<u8>>>>,
    first_ns: u64,
    /// Run of the first message.
    run_id: Option<u64>,
    without_images: bool,
    is_cut_off: bool,
    /// Reason why the rest of the file cannot be read.
    failure: Option<RecordingError>,
}

impl std::fmt::Debug for Reader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Reader").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Reader {
    /// Opens a recording, and finds its metadata and its messages.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.to_owned(), source };
        let file = File::open(path).map_err(io)?;
        let mut reader = Self {
            path: path.to_owned(),
            file_bytes: file.metadata().map_err(io)?.len(),
            file: BufReader::new(file),
            about: None,
            has_other_format: false,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            used: BTreeSet::new(),
            segments: Vec::new(),
            messages: Vec::new(),
            images: BTreeMap::new(),
            loaded: BTreeMap::new(),
            first_ns: 0,
            run_id: None,
            without_images: false,
            is_cut_off: false,
            failure: None,
        };
        reader.failure = reader.scan().err().map(|e| RecordingError::mcap(path, e));
        // Messages of the same time stay in the order of the file.
        reader.messages.sort_by_key(|m| m.published_ns);
        reader.messages.reverse();
        reader.first_ns = reader.messages.last().map_or(0, |m| m.published_ns);
        if reader.has_other_format {
            return Err(RecordingError::Format { path: path.to_owned() });
        }
        let is_ours = reader.about.is_some() || reader.channels.values().any(|(_, content)| content.is_some());
        match reader.failure.take_if(|_| !is_ours) {
            Some(failure) => Err(failure),
            None if is_ours => Ok(reader),
            None => Err(RecordingError::Foreign { path: path.to_owned(), channels: reader.channel_names() }),
        }
    }

    /// Returns the metadata of the run; `None` if the tool that rewrote the file dropped it.
    pub fn about(&self) -> Option<&RecordingAbout> {
        self.about.as_ref()
    }

    /// Returns the time of the first message of any topic: nanoseconds since 1970.
    pub fn first_ns(&self) -> u64 {
        self.first_ns
    }

    /// Returns true if the file is incomplete, for example because its writer was killed.
    pub fn is_cut_off(&self) -> bool {
        self.is_cut_off
    }

    /// Returns true if the file contains this topic's messages, and the images that they describe.
    pub fn has(&self, topic: TopicId) -> bool {
        self.needed(topic).all(|content| self.holds(content))
    }

    /// Skips all images: messages that describe one have no bytes.
    #[must_use]
    pub fn without_images(self) -> Self {
        Self { without_images: true, ..self }
    }

    /// Restricts the reader to these topics. Fails if one of them, or its images, is missing.
    pub fn select(&mut self, topics: impl IntoIterator<Item = TopicId>) -> Result<(), RecordingError> {
        let topics: BTreeSet<TopicId> = topics.into_iter().collect();
        let needed = topics.iter().flat_map(|topic| self.needed(*topic));
        let missing: Vec<&str> = needed.filter(|content| !self.holds(*content)).map(Content::name).collect();
        if !missing.is_empty() {
            let (missing, present) = (missing.join("`, `"), self.channel_names());
            return Err(RecordingError::Missing { path: self.path.clone(), missing, present });
        }
        self.messages.retain(|m| topics.contains(&m.topic));
        Ok(())
    }

    /// Returns the next message; `None` at the end.
    #[allow(clippy::should_implement_trait, reason = "errors do not end it: the next message may be valid")]
    pub fn next(&mut self) -> Result<Option<Entry>, RecordingError> {
        let Some(located) = self.messages.pop() else { return self.failure.take().map_or(Ok(None), Err) };
        let Self { loaded, segments, .. } = self;
        loaded.retain(|&segment, _| segments[segment].last_ns >= located.published_ns);
        let message = self.message(&located).map_err(|MessageError(cause)| RecordingError::Message {
            path: self.path.clone(),
            channel: located.topic.name().to_owned(),
            sequence: located.sequence,
            cause,
        })?;
        let run_id = message.as_message().header().run_id;
        let first = *self.run_id.get_or_insert(run_id);
        if run_id != first {
            return Err(RecordingError::Runs { path: self.path.clone(), run_ids: [first, run_id] });
        }
        Ok(Some(Entry { topic: located.topic, wall_time_ns: located.published_ns, message }))
    }

    fn message(&mut self, located: &Located) -> Result<OwnedMessage, MessageError> {
        let topic = located.topic;
        let json = self.load(located.position)?;
        let refused = |error: FormError| of_other_version(&json).unwrap_or_else(|| error.into());
        if self.without_images && topic == TopicId::FRAME {
            return Ok(OwnedMessage::new(Box::new(read::<FrameMeta>(&json).map_err(refused)?), Vec::new()));
        }
        if self.without_images && topic == TopicId::VIEW {
            return Ok(OwnedMessage::new(Box::new(read::<ViewMeta>(&json).map_err(refused)?), Vec::new()));
        }
        let bytes = if topic.is_image() {
            let key = (topic, located.published_ns, located.sequence);
            let found = self.images.get(&key).copied().flatten();
            let name = Content::Images(topic).name();
            let position = found.ok_or_else(|| MessageError(format!("its image is missing on `{name}`")))?;
            RawImage::decode(&self.load(position)?[..]).map_err(|e| MessageError(e.to_string()))?.data.to_vec()
        } else {
            Vec::new()
        };
        topic.read(&json, bytes).map_err(refused)
    }

    /// Takes a message's bytes from the file.
    fn load(&mut self, (segment, number): Position) -> Result<Vec<u8>, MessageError> {
        if !self.loaded.contains_key(&segment) {
            let (mut messages, channels) = (Vec::new(), &self.channels);
            let taken = records(&mut self.file, self.segments[segment].range.clone(), |record| {
                if let Record::Message { header, data } = record {
                    let is_read = channels.get(&header.channel_id).is_some_and(|(_, content)| content.is_some());
                    messages.push(is_read.then(|| data.into_owned()));
                }
            });
            // A cut-off segment ends early.
            taken.or_else(|e| if self.is_cut_off { Ok(()) } else { Err(MessageError(e.to_string())) })?;
            self.loaded.insert(segment, messages);
        }
        let message = self.loaded.get_mut(&segment).and_then(|messages| messages.get_mut(number)?.take());
        message.ok_or_else(|| MessageError("the file has changed".to_owned()))
    }

    fn needed(&self, topic: TopicId) -> impl Iterator<Item = Content> + use<> {
        let images = (topic.is_image() && !self.without_images).then_some(Content::Images(topic));
        [Content::Forms(topic)].into_iter().chain(images)
    }

    fn holds(&self, content: Content) -> bool {
        self.used.iter().any(|id| self.channels.get(id).is_some_and(|(_, found)| *found == Some(content)))
    }

    /// Returns the names of all channels with messages.
    fn channel_names(&self) -> String {
        let names: BTreeSet<&str> = self.used.iter().filter_map(|id| Some(self.channels.get(id)?.0.as_str())).collect();
        if names.is_empty() { "none".to_owned() } else { names.into_iter().collect::<Vec<_>>().join(", ") }
    }

    /// Goes through the file, up to its end or to the first damage.
    fn scan(&mut self) -> McapResult<()> {
        let mut magic = [0; mcap::MAGIC.len()];
        self.file.read_exact(&mut magic).map_err(|error| match error.kind() {
            std::io::ErrorKind::UnexpectedEof => McapError::BadMagic,
            _ => error.into(),
        })?;
        if magic != *mcap::MAGIC {
            return Err(McapError::BadMagic);
        }
        let mut at = mcap::MAGIC.len() as u64;
        loop {
            let mut head = [0; RECORD_HEAD_BYTES as usize];
            self.file.seek(SeekFrom::Start(at))?;
            if self.file_bytes.saturating_sub(at) < RECORD_HEAD_BYTES {
                self.is_cut_off = true;
                return Ok(());
            }
            self.file.read_exact(&mut head)?;
            let [code, length @ ..] = head;
            let end = at.saturating_add(RECORD_HEAD_BYTES).saturating_add(u64::from_le_bytes(length));
            self.is_cut_off = end > self.file_bytes;
            match code {
                op::FOOTER => return Ok(()),
                op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK | op::METADATA => match self.note(at..end) {
                    Err(McapError::UnexpectedEof) if self.is_cut_off => {}
                    noted => noted?,
                },
                _ => {}
            }
            at = end;
        }
    }

    /// Notes the messages of a segment. What a damaged segment contains is not noted.
    fn note(&mut self, range: Range<u64>) -> McapResult<()> {
        let Self { file, schemas, channels, about, has_other_format, .. } = self;
        let mut found: Vec<MessageHeader> = Vec::new();
        let read = records(file, range.clone(), |record| match record {
            Record::Schema { header, .. } => drop(schemas.insert(header.id, header.name)),
            Record::Channel(c) => {
                let schema = schemas.get(&c.schema_id).map_or("", String::as_str);
                let content = Content::of(&c.topic, &c.message_encoding, schema);
                channels.insert(c.id, (c.topic, content));
            }
            Record::Metadata(m) if m.name == METADATA && about.is_none() => {
                *about = RecordingAbout::from_metadata(&m.metadata);
                *has_other_format |= about.is_none();
            }
            Record::Message { header, .. } => found.push(header),
            _ => {}
        });
        if read.is_err() && !self.is_cut_off {
            return read;
        }
        let segment = self.segments.len();
        let mut last_ns = 0;
        for (number, MessageHeader { channel_id, sequence, publish_time, .. }) in found.into_iter().enumerate() {
            self.used.insert(channel_id);
            let position = (segment, number);
            match self.channels.get(&channel_id) {
                Some((_, Some(Content::Forms(topic)))) => {
                    self.messages.push(Located { published_ns: publish_time, sequence, topic: *topic, position });
                }
                Some((_, Some(Content::Images(topic)))) => {
                    let image = self.images.entry((*topic, publish_time, sequence));
                    image.and_modify(|known| *known = None).or_insert(Some(position));
                }
                _ => continue,
            }
            last_ns = last_ns.max(publish_time);
        }
        self.segments.push(Segment { range, last_ns });
        read
    }
}

/// Reads the records in a range of the file; those of a chunk are decompressed.
pub(crate) fn records(
    file: &mut (impl Read + Seek),
    range: Range<u64>,
    mut each: impl FnMut(Record<'_>),
) -> McapResult<()> {
    let options = LinearReaderOptions::default()
        .with_record_length_limit(MAX_RECORD_BYTES)
        .with_validate_chunk_crcs(true)
        .with_skip_start_magic(true)
        .with_skip_end_magic(true);
    let mut reader = LinearReader::new_with_options(options);
    file.seek(SeekFrom::Start(range.start))?;
    let mut file = file.take(range.end - range.start);
    let mut bytes = 0;
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                // RotationLimits the buffer to the maximum length of a record, for any length that the file states.
                let read = file.read(reader.insert(wanted.min(MAX_RECORD_BYTES)))?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { data, opcode } => {
                bytes += data.len();
                if bytes > MAX_CHUNK_BYTES {
                    return Err(McapError::ChunkTooLarge(bytes as u64));
                }
                each(mcap::parse_record(opcode, data)?);
            }
        }
    }
    Ok(())
}

/// The reason why the form of a message of another version is refused; `None` for this program's version.
fn of_other_version(json: &[u8]) -> Option<MessageError> {
    let form: serde_json::Value = serde_json::from_slice(json).ok()?;
    let version = form.pointer("/header/schema_version")?.as_u64()?;
    (version != u64::from(SCHEMA_VERSION)).then(|| {
        MessageError(format!(
            "it is of version {version} of the messages, and this program reads version {SCHEMA_VERSION}; use the \
             version of carff that recorded it"
        ))
    })
}
