//! The files of another tool's recording, read record by record: a ROS 2 bag, or a recording of Foxglove.

use crate::RecordingError;
use bytes::Bytes;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, McapResult};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Maximum length of a record, bytes: an image of the largest size with four bytes a pixel.
const MAX_RECORD_BYTES: usize = 1 << 28;

/// A channel of a file.
#[derive(Clone, Debug)]
pub(crate) struct Channel {
    pub(crate) topic: String,
    /// Name of the messages' schema.
    pub(crate) schema: String,
    /// Encoding of the messages.
    pub(crate) encoding: String,
}

impl Channel {
    /// Returns the kind of the messages, from a table of schemas, encodings and kinds.
    pub(crate) fn kind<K: Copy>(&self, kinds: &[(&str, &str, K)]) -> Option<K> {
        let known = |(schema, encoding, _): &&(&str, &str, K)| *schema == self.schema && *encoding == self.encoding;
        kinds.iter().find(known).map(|(.., kind)| *kind)
    }
}

/// A message of another tool.
#[derive(Clone, Debug)]
pub(crate) struct BagMessage {
    /// Time of its recording, nanoseconds since 1970.
    pub(crate) log_time_ns: u64,
    pub(crate) channel: Channel,
    /// Number of the message on its channel.
    pub(crate) sequence: u32,
    pub(crate) data: Bytes,
}

/// Reads the messages of a file, or of the files in a folder, in their order.
pub(crate) struct Bag {
    files: Vec<PathBuf>,
    /// Number of the open file.
    file: usize,
    records: Records,
    channels: BTreeMap<u16, Channel>,
    schemas: BTreeMap<u16, String>,
}

impl Bag {
    /// Opens a recording, or the recordings in a folder in the order of their names.
    pub(crate) fn open(path: &Path) -> Result<Self, RecordingError> {
        let files = files(path)?;
        let records = Records::open(&files[0])?;
        Ok(Self { files, file: 0, records, channels: BTreeMap::new(), schemas: BTreeMap::new() })
    }

    /// Returns the channels of all files, by topic.
    pub(crate) fn channels(&self) -> Result<BTreeMap<String, Channel>, RecordingError> {
        let mut found = BTreeMap::new();
        for file in &self.files {
            for channel in channels(file)? {
                found.insert(channel.topic.clone(), channel);
            }
        }
        Ok(found)
    }

    /// Returns the path of the open file.
    pub(crate) fn path(&self) -> &Path {
        &self.files[self.file]
    }

    /// Starts again at the first message.
    pub(crate) fn rewind(&mut self) -> Result<(), RecordingError> {
        self.file = 0;
        self.open_file()
    }

    fn open_file(&mut self) -> Result<(), RecordingError> {
        self.records = Records::open(&self.files[self.file])?;
        self.channels.clear();
        self.schemas.clear();
        Ok(())
    }

    /// Returns the next message on a wanted channel; `None` at the end.
    ///
    /// # Errors
    ///
    /// If the file is damaged. What follows in it cannot be read.
    pub(crate) fn next(&mut self, wanted: impl Fn(&Channel) -> bool) -> Result<Option<BagMessage>, RecordingError> {
        loop {
            let Self { records, channels, schemas, .. } = self;
            let mut found = None;
            let more = records.next(|record| {
                note(&record, schemas, channels);
                if let Record::Message { header, data } = record
                    && let Some(channel) = channels.get(&header.channel_id).filter(|channel| wanted(channel))
                {
                    let (log_time_ns, sequence) = (header.log_time, header.sequence);
                    let (channel, data) = (channel.clone(), Bytes::copy_from_slice(&data));
                    found = Some(BagMessage { log_time_ns, channel, sequence, data });
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
                Err(error) => return Err(RecordingError::mcap(self.path(), error)),
            }
        }
    }
}

/// The records of a file, one after the other.
struct Records {
    file: File,
    reader: LinearReader,
}

impl Records {
    fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|source| RecordingError::Io { path: path.to_owned(), source })?;
        let options = LinearReaderOptions::default()
            .with_record_length_limit(MAX_RECORD_BYTES)
            .with_validate_chunk_crcs(true)
            .with_skip_end_magic(true);
        Ok(Self { file, reader: LinearReader::new_with_options(options) })
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
                    each(mcap::parse_record(opcode, data)?);
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
            let (topic, encoding) = (channel.topic.clone(), channel.message_encoding.clone());
            channels.insert(channel.id, Channel { topic, schema, encoding });
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
