//! Reads a recording message by message, in the order in which the messages were written.

use crate::about::METADATA;
use crate::{About, MessageError, RecordingError};
use carff_messages::MAX_IMAGE_BYTES;
use carff_messages::forms::OwnedMessage;
use carff_transport::TopicId;
use foxglove::Decode;
use foxglove::messages::RawImage;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Maximum length of a record, bytes: enough for a chunk with an image of the largest size.
const MAX_RECORD_BYTES: usize = 4 * MAX_IMAGE_BYTES;
/// Maximum number of channels.
const MAX_CHANNELS: usize = 4096;

/// Channels with the images of each image topic.
const IMAGE_CHANNELS: [(TopicId, &str); 2] = [(TopicId::FRAME, "camera/image"), (TopicId::VIEW, "renderer/image")];

fn image_channel(topic: TopicId) -> Option<&'static str> {
    IMAGE_CHANNELS.into_iter().find_map(|(described, channel)| (described == topic).then_some(channel))
}

/// A message with its topic.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Topic of the message.
    pub topic: TopicId,
    /// The message, validated.
    pub message: OwnedMessage,
}

/// Reads a recording from the beginning.
pub struct Reader {
    path: PathBuf,
    file: File,
    inner: Box<LinearReader>,
    about: About,
    channels: BTreeMap<u16, String>,
    /// The latest image of each image channel, with its sequence number.
    images: BTreeMap<&'static str, (u32, Vec<u8>)>,
    has_footer: bool,
    is_cut_off: bool,
    ended: bool,
}

impl std::fmt::Debug for Reader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Reader").field("path", &self.path).finish_non_exhaustive()
    }
}

impl Reader {
    /// Opens a recording and reads its metadata.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|source| RecordingError::Io { path: path.to_owned(), source })?;
        let options = LinearReaderOptions::default()
            .with_record_length_limit(MAX_RECORD_BYTES)
            .with_validate_chunk_crcs(true)
            .with_skip_end_magic(true);
        let mut reader = Self {
            path: path.to_owned(),
            file,
            inner: Box::new(LinearReader::new_with_options(options)),
            about: About::default(),
            channels: BTreeMap::new(),
            images: BTreeMap::new(),
            has_footer: false,
            is_cut_off: false,
            ended: false,
        };
        // The metadata is the first record after the header.
        loop {
            match reader.next_record()? {
                Some(Owned::About(about)) => {
                    reader.about = about;
                    return Ok(reader);
                }
                Some(Owned::Message { .. }) | None => return Err(RecordingError::Foreign { path: path.to_owned() }),
                Some(_) => {}
            }
        }
    }

    /// Returns the metadata of the run.
    pub fn about(&self) -> &About {
        &self.about
    }

    /// Returns true if the file is incomplete, for example because its writer was killed. Known at the end.
    pub fn is_cut_off(&self) -> bool {
        self.is_cut_off
    }

    /// Returns the next message; `None` at the end.
    #[allow(clippy::should_implement_trait, reason = "errors do not end it: the next message may be valid")]
    pub fn next(&mut self) -> Result<Option<Entry>, RecordingError> {
        while let Some(record) = self.next_record()? {
            let Owned::Message { channel_id, sequence, data } = record else { continue };
            let Some(channel) = self.channels.get(&channel_id).cloned() else { continue };
            let entry = self.entry(&channel, sequence, &data).map_err(|MessageError(cause)| {
                RecordingError::Message { path: self.path.clone(), channel, sequence, cause }
            })?;
            if entry.is_some() {
                return Ok(entry);
            }
        }
        Ok(None)
    }

    /// Returns a message of a topic; `None` for other channels.
    fn entry(&mut self, channel: &str, sequence: u32, data: &[u8]) -> Result<Option<Entry>, MessageError> {
        if let Some(channel) = IMAGE_CHANNELS.into_iter().map(|(_, image)| image).find(|image| *image == channel) {
            let image = RawImage::decode(data).map_err(|e| MessageError(e.to_string()))?;
            self.images.insert(channel, (sequence, image.data.to_vec()));
            return Ok(None);
        }
        let Some(topic) = TopicId::all().find(|t| t.name() == channel) else { return Ok(None) };
        let bytes = match image_channel(topic) {
            Some(channel) => self.image(channel, sequence)?,
            None => Vec::new(),
        };
        Ok(Some(Entry { topic, message: topic.read(data, bytes)? }))
    }

    /// Takes the latest image of a channel, which must have the sequence number of its message.
    fn image(&mut self, channel: &'static str, sequence: u32) -> Result<Vec<u8>, MessageError> {
        let image = self.images.remove(channel).filter(|(number, _)| *number == sequence);
        image.map(|(_, bytes)| bytes).ok_or_else(|| MessageError(format!("its image is missing on `{channel}`")))
    }

    fn next_record(&mut self) -> Result<Option<Owned>, RecordingError> {
        let path = self.path.clone();
        while !self.ended {
            match self.inner.next_event() {
                None => (self.is_cut_off, self.ended) = (!self.has_footer, true),
                Some(Ok(LinearReadEvent::ReadRequest(bytes))) => {
                    // Limits the buffer to the maximum length of a record, whatever the file requests.
                    let bytes = bytes.min(MAX_RECORD_BYTES);
                    let read = self
                        .file
                        .read(self.inner.insert(bytes))
                        .map_err(|source| RecordingError::Io { path: path.clone(), source })?;
                    self.inner.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    let record = mcap::parse_record(opcode, data).map_err(|e| RecordingError::mcap(&path, e))?;
                    match record {
                        Record::Channel(channel) if self.channels.len() < MAX_CHANNELS => {
                            self.channels.insert(channel.id, channel.topic);
                        }
                        Record::Metadata(metadata) if metadata.name == METADATA => {
                            let about = About::from_metadata(&metadata.metadata)
                                .ok_or(RecordingError::Foreign { path: path.clone() })?;
                            return Ok(Some(Owned::About(about)));
                        }
                        Record::Message { header, data } => {
                            return Ok(Some(Owned::Message {
                                channel_id: header.channel_id,
                                sequence: header.sequence,
                                data: data.into_owned(),
                            }));
                        }
                        Record::Footer(_) => self.has_footer = true,
                        _ => return Ok(Some(Owned::Other)),
                    }
                }
                Some(Err(mcap::McapError::UnexpectedEof)) => (self.is_cut_off, self.ended) = (true, true),
                Some(Err(error)) => {
                    self.ended = true;
                    return Err(RecordingError::mcap(&path, error));
                }
            }
        }
        Ok(None)
    }
}

/// A record that the reader uses.
enum Owned {
    About(About),
    Message { channel_id: u16, sequence: u32, data: Vec<u8> },
    Other,
}
