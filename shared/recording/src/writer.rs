//! Writes one file of a recording.

use crate::about::METADATA;
use crate::{About, RecordingError, channels, encode};
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
/// use carff_recording::{About, Reader, Writer};
/// use carff_transport::TopicId;
/// # let folder = tempfile::tempdir()?;
/// # let path = folder.path().join("run.mcap");
/// let mut writer = Writer::create(&path, &About { run: "crossing".into(), ..About::default() }, &[])?;
/// let header = Header::of_frame(7, 1_000, 42);
/// let posterior = Posterior { header, gaussian: Gaussian::standard(), stage_latency_ns: 0 };
/// writer.write(TopicId::POSTERIOR, AnyMessage::new(&posterior, &[]))?;
/// writer.finish()?;
///
/// let mut reader = Reader::open(&path)?;
/// assert_eq!(reader.about().run, "crossing");
/// let entry = reader.next()?.expect("one message was written");
/// assert_eq!(entry.message.as_message().get::<Posterior>(), Some(&posterior));
/// assert!(reader.next()?.is_none() && !reader.is_cut_off());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Writer {
    path: PathBuf,
    inner: mcap::Writer<NoSeek<BufWriter<File>>>,
    channels: BTreeMap<&'static str, u16>,
    places: Vec<Place>,
    wall_offset_ns: u64,
}

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Writer {
    /// Creates the file, which must not exist. `places` are the places of the checkpoint: their boxes are recorded with
    /// each belief.
    pub fn create(path: &Path, about: &About, places: &[Place]) -> Result<Self, RecordingError> {
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
        // All channels at once, so that a reader sees the complete list.
        let mut ids = BTreeMap::new();
        for channel in channels() {
            let schema = match &channel.schema {
                Some(schema) => inner.add_schema(&schema.name, &schema.encoding, &schema.data).map_err(failed)?,
                None => 0,
            };
            let id = inner.add_channel(schema, channel.name, &channel.encoding, &BTreeMap::new()).map_err(failed)?;
            ids.insert(channel.name, id);
        }
        let mut writer = Self {
            path: path.to_owned(),
            inner,
            channels: ids,
            places: places.to_vec(),
            wall_offset_ns: about.wall_offset_ns,
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
        let header = message.header();
        let wall_ns = header.publish_time_ns.saturating_add(self.wall_offset_ns);
        let failed = |e: serde_json::Error| RecordingError::Message {
            path: self.path.clone(),
            channel: topic.name().to_owned(),
            sequence: header.sequence as u32,
            cause: e.to_string(),
        };
        for (name, data) in encode(topic, message, &self.places, wall_ns).map_err(failed)? {
            let Some(&channel_id) = self.channels.get(name) else { continue };
            let header = MessageHeader {
                channel_id,
                sequence: header.sequence as u32,
                log_time: wall_ns,
                publish_time: wall_ns,
            };
            self.inner.write_to_known_channel(&header, &data).map_err(|e| RecordingError::mcap(&self.path, e))?;
        }
        Ok(())
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
