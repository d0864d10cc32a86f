//! Writes one file of a recording.

use crate::about::METADATA;
use crate::{Encoded, LogLine, MessageEncoder, RecordingAbout, RecordingError};
use carff_decision::Place;
use carff_messages::forms::AnyMessage;
use carff_transport::TopicId;
use mcap::records::{MessageHeader, Metadata};
use mcap::write::NoSeek;
use mcap::{Compression, WriteOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// Size of a chunk before compression, bytes.
const CHUNK_BYTES: u64 = 1 << 20;

/// Writes one recording. An unfinished file is readable up to the last [`Writer::flush`].
///
/// ```
/// use carff_messages::forms::AnyMessage;
/// use carff_messages::{Gaussian, Header, Posterior};
/// use carff_recording::{RecordingAbout, Reader, Writer};
/// use carff_transport::TopicId;
/// # let folder = tempfile::tempdir()?;
/// # let path = folder.path().join("run.mcap");
/// let mut writer = Writer::create(&path, &RecordingAbout { run: "crossing".into(), ..RecordingAbout::default() }, &[])?;
/// let header = Header::of_frame(7, 1_000, 42);
/// let posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 };
/// writer.write(TopicId::POSTERIOR, AnyMessage::new(&posterior, &[]))?;
/// writer.finish()?;
///
/// let mut reader = Reader::open(&path)?;
/// assert_eq!(reader.about().map(|about| about.run.as_str()), Some("crossing"));
/// let entry = reader.next()?.expect("one message was written");
/// assert_eq!(entry.message.as_message().get::<Posterior>(), Some(&posterior));
/// assert!(reader.next()?.is_none() && !reader.is_cut_off());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Writer {
    path: PathBuf,
    inner: mcap::Writer<NoSeek<BufWriter<File>>>,
    channels: BTreeMap<String, u16>,
    encoder: MessageEncoder,
}

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Writer {
    /// Creates the file, which must not exist. `places` are the places of the checkpoint: their boxes are recorded with
    /// each belief.
    pub fn create(path: &Path, about: &RecordingAbout, places: &[Place]) -> Result<Self, RecordingError> {
        let file = File::create_new(path).map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => RecordingError::Exists { path: path.to_owned() },
            _ => RecordingError::Io { path: path.to_owned(), source },
        })?;
        let failed = |e| RecordingError::mcap(path, e);
        let mut inner = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .compression_level(1)
            .chunk_size(Some(CHUNK_BYTES))
            .library("carff")
            // Only complete chunks are written: a killed process does not leave a partial chunk of unknown length.
            .disable_seeking(true)
            .create(NoSeek::new(BufWriter::new(file)))
            .map_err(failed)?;
        inner.write_metadata(&Metadata { name: METADATA.to_owned(), metadata: about.to_metadata() }).map_err(failed)?;
        let mut writer = Self {
            path: path.to_owned(),
            inner,
            channels: BTreeMap::new(),
            encoder: MessageEncoder::new(places.to_vec(), about.wall_offset_ns),
        };
        writer.flush()?;
        Ok(writer)
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of bytes written so far, without the current chunk.
    pub fn written_bytes(&self) -> u64 {
        std::fs::metadata(&self.path).map_or(0, |m| m.len())
    }

    /// Writes a message, with its standard messages for other tools.
    pub fn write(&mut self, topic: TopicId, message: AnyMessage<'_>) -> Result<(), RecordingError> {
        let sequence = message.header().sequence as u32;
        let wall_ns = self.encoder.wall_ns(message.header().publish_time_ns);
        let encoded = self.encoder.encode(topic, message).map_err(|e| RecordingError::Message {
            path: self.path.clone(),
            channel: topic.name().to_owned(),
            sequence,
            cause: e.to_string(),
        })?;
        encoded.iter().try_for_each(|message| self.append(message, sequence, wall_ns))
    }

    /// Writes a line of the run's log.
    pub fn write_log(&mut self, line: &LogLine) -> Result<(), RecordingError> {
        self.append(&line.encode(), 0, line.wall_ns)
    }

    fn append(&mut self, message: &Encoded, sequence: u32, wall_ns: u64) -> Result<(), RecordingError> {
        let channel_id = self.channel(message).map_err(|e| RecordingError::mcap(&self.path, e))?;
        let header = MessageHeader { channel_id, sequence, log_time: wall_ns, publish_time: wall_ns };
        self.inner.write_to_known_channel(&header, &message.data).map_err(|e| RecordingError::mcap(&self.path, e))
    }

    /// Returns the id of a message's channel, which is created for its first message.
    fn channel(&mut self, message: &Encoded) -> Result<u16, mcap::McapError> {
        if let Some(&id) = self.channels.get(&message.channel) {
            return Ok(id);
        }
        let schema = match message.format.schema() {
            Some(schema) => self.inner.add_schema(&schema.name, &schema.encoding, &schema.data)?,
            None => 0,
        };
        let encoding = message.format.encoding();
        let id = self.inner.add_channel(schema, &message.channel, encoding, &BTreeMap::new())?;
        self.channels.insert(message.channel.clone(), id);
        Ok(id)
    }

    /// Ends the chunk and passes it to the system: after that, it stays readable if the process is killed.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.inner.flush().map_err(|e| RecordingError::mcap(&self.path, e))
    }

    /// Writes the index and closes the file.
    pub fn finish(mut self) -> Result<(), RecordingError> {
        self.inner.finish().map(|_| ()).map_err(|e| RecordingError::mcap(&self.path, e))
    }
}
