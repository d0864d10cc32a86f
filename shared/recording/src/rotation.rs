//! A recording as a sequence of files with limits.

use crate::{LogLine, RecordingAbout, RecordingError, Writer};
use carff_decision::Place;
use carff_messages::forms::AnyMessage;
use carff_transport::TopicId;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};

/// Limits of each file. `None`: unlimited.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RotationLimits {
    /// Maximum size of a file, bytes.
    pub file_bytes: Option<u64>,
    /// Maximum time that a file covers, nanoseconds.
    pub file_ns: Option<u64>,
    /// Maximum number of files; a further file replaces the oldest.
    pub files: Option<usize>,
}

/// Writes a sequence of files.
///
/// ```
/// use carff_messages::forms::AnyMessage;
/// use carff_messages::{EgoPose, Header};
/// use carff_recording::{RecordingAbout, RotatingWriter, RotationLimits};
/// use carff_transport::TopicId;
/// # let folder = tempfile::tempdir()?;
/// # let path = folder.path().join("drive.mcap");
/// let limits = RotationLimits { file_ns: Some(1_000_000_000), ..RotationLimits::default() };
/// let mut writer = RotatingWriter::create(&path, RecordingAbout::default(), Vec::new(), limits)?;
/// for second in 1..=3 {
///     let header = Header { publish_time_ns: second * 1_000_000_000, ..Header::of_frame(second, 1, 42) };
///     let ego = EgoPose { header, ..EgoPose::default() };
///     writer.write(TopicId::EGO_POSE, AnyMessage::new(&ego, &[]))?;
/// }
/// assert_eq!(writer.files(), 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct RotatingWriter {
    first: PathBuf,
    about: RecordingAbout,
    places: Vec<Place>,
    limits: RotationLimits,
    writer: Writer,
    /// Publication time of the file's first message.
    begun_ns: Option<u64>,
    written: VecDeque<PathBuf>,
    files: usize,
}

impl RotatingWriter {
    /// Starts with the file `first`; later files have a number before the extension.
    pub fn create(
        first: &Path,
        about: RecordingAbout,
        places: Vec<Place>,
        limits: RotationLimits,
    ) -> Result<Self, RecordingError> {
        let writer = Writer::create(first, &about, &places)?;
        let written = VecDeque::from([first.to_owned()]);
        Ok(Self { first: first.to_owned(), about, places, limits, writer, begun_ns: None, written, files: 1 })
    }

    /// Returns the path of the current file.
    pub fn path(&self) -> &Path {
        self.writer.path()
    }

    /// Returns the number of files so far.
    pub fn files(&self) -> usize {
        self.files
    }

    /// Writes a message; starts the next file if this one is full.
    pub fn write(&mut self, topic: TopicId, message: AnyMessage<'_>) -> Result<(), RecordingError> {
        let now_ns = message.header().publish_time_ns;
        let begun_ns = *self.begun_ns.get_or_insert(now_ns);
        if self.limits.file_ns.is_some_and(|limit_ns| now_ns.saturating_sub(begun_ns) >= limit_ns) {
            self.next_file()?;
            self.begun_ns = Some(now_ns);
        }
        self.writer.write(topic, message)
    }

    /// Writes a line of the run's log into the current file.
    pub fn write_log(&mut self, line: &LogLine) -> Result<(), RecordingError> {
        self.writer.write_log(line)
    }

    /// Makes the written messages safe, and starts the next file if this one is too large.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.writer.flush()?;
        match self.limits.file_bytes {
            Some(limit) if self.writer.written_bytes() >= limit => self.next_file(),
            _ => Ok(()),
        }
    }

    /// Writes the index of the last file.
    pub fn finish(self) -> Result<(), RecordingError> {
        self.writer.finish()
    }

    fn next_file(&mut self) -> Result<(), RecordingError> {
        let stem = self.first.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let extension = self.first.extension().unwrap_or_default().to_string_lossy().into_owned();
        let path = self.first.with_file_name(format!("{stem}-{:04}.{extension}", self.files));
        let next = Writer::create(&path, &self.about, &self.places)?;
        std::mem::replace(&mut self.writer, next).finish()?;
        self.files += 1;
        self.begun_ns = None;
        self.written.push_back(path);
        while self.limits.files.is_some_and(|keep| self.written.len() > keep.max(1)) {
            if let Some(oldest) = self.written.pop_front() {
                std::fs::remove_file(&oldest).map_err(|source| RecordingError::Io { path: oldest, source })?;
            }
        }
        Ok(())
    }
}
