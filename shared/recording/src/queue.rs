//! A queue before the disk, so that subscribers of the graph never wait for the disk.

use crate::{LogLine, RecordingError, RotatingWriter};
use carff_messages::forms::OwnedMessage;
use carff_transport::TopicId;
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Maximum number of waiting messages.
const MESSAGES: usize = 1 << 16;
/// Longest time until a written message is safe.
const FLUSH_EVERY: Duration = Duration::from_secs(1);

/// Counts of written and dropped messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct QueueCounts {
    /// Number of messages written to the file.
    pub written: u64,
    /// Number of messages dropped because the disk was too slow.
    pub dropped: u64,
}

#[derive(Debug, Default)]
struct Shared {
    waiting_bytes: AtomicU64,
    written: AtomicU64,
    dropped: AtomicU64,
}

/// An item of the queue.
#[derive(Debug)]
enum Item {
    Message(TopicId, OwnedMessage),
    Log(LogLine),
}

impl Item {
    fn size_bytes(&self) -> u64 {
        match self {
            Self::Message(_, message) => message.as_message().size_bytes() as u64,
            Self::Log(line) => (size_of::<LogLine>() + line.message.len()) as u64,
        }
    }
}

/// Writes a recording on a separate thread from a bounded queue.
///
/// ```
/// use carff_messages::forms::OwnedMessage;
/// use carff_messages::{Gaussian, Header, Posterior};
/// use carff_recording::{RecordingAbout, RotationLimits, RecordingQueue, RotatingWriter};
/// use carff_transport::TopicId;
/// # let folder = tempfile::tempdir()?;
/// # let path = folder.path().join("run.mcap");
/// let limits = RotationLimits { files: Some(3), file_bytes: Some(1 << 30), ..RotationLimits::default() };
/// let writer = RotatingWriter::create(&path, RecordingAbout::default(), Vec::new(), limits)?;
/// let queue = RecordingQueue::start(writer, 64 << 20)?;
/// let header = Header::of_frame(7, 1_000, 42);
/// let posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 };
/// assert!(queue.push(TopicId::POSTERIOR, OwnedMessage::new(Box::new(posterior), Vec::new())));
/// assert_eq!(queue.finish()?.written, 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct RecordingQueue {
    sender: Option<Sender<Item>>,
    shared: Arc<Shared>,
    limit_bytes: u64,
    thread: Option<JoinHandle<Result<(), RecordingError>>>,
}

impl RecordingQueue {
    /// Starts writing; at most `limit_bytes` wait.
    pub fn start(writer: RotatingWriter, limit_bytes: u64) -> std::io::Result<Self> {
        let (sender, receiver) = bounded(MESSAGES);
        let shared = Arc::<Shared>::default();
        let theirs = shared.clone();
        let thread =
            std::thread::Builder::new().name("recording".into()).spawn(move || drain(writer, &receiver, &theirs))?;
        Ok(Self { sender: Some(sender), shared, limit_bytes, thread: Some(thread) })
    }

    /// Queues a message, or drops and counts it if the queue is full. Returns false if the writer has failed: then
    /// [`RecordingQueue::finish`] returns the error.
    pub fn push(&self, topic: TopicId, message: OwnedMessage) -> bool {
        self.queue(Item::Message(topic, message))
    }

    /// Queues a line of the run's log like a message.
    pub fn push_log(&self, line: LogLine) -> bool {
        self.queue(Item::Log(line))
    }

    fn queue(&self, item: Item) -> bool {
        let Some(sender) = &self.sender else { return false };
        let bytes = item.size_bytes();
        if self.shared.waiting_bytes.load(Ordering::Relaxed) + bytes > self.limit_bytes {
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
            return true;
        }
        self.shared.waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
        match sender.try_send(item) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                self.shared.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
                self.shared.dropped.fetch_add(1, Ordering::Relaxed);
                true
            }
            Err(TrySendError::Disconnected(_)) => false,
        }
    }

    /// Returns the counts so far.
    pub fn counts(&self) -> QueueCounts {
        QueueCounts {
            written: self.shared.written.load(Ordering::Relaxed),
            dropped: self.shared.dropped.load(Ordering::Relaxed),
        }
    }

    /// Writes the waiting messages and the index.
    pub fn finish(mut self) -> Result<QueueCounts, RecordingError> {
        self.close()?;
        Ok(self.counts())
    }

    fn close(&mut self) -> Result<(), RecordingError> {
        drop(self.sender.take());
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            // A panic has been printed to standard error.
            Some(Err(_)) | None => Ok(()),
        }
    }
}

impl Drop for RecordingQueue {
    fn drop(&mut self) {
        // Callers that need the error call `finish`.
        let _ = self.close();
    }
}

fn drain(mut writer: RotatingWriter, receiver: &Receiver<Item>, shared: &Shared) -> Result<(), RecordingError> {
    let mut flushed = Instant::now();
    loop {
        match receiver.recv_timeout(FLUSH_EVERY) {
            Ok(item) => {
                match &item {
                    Item::Message(topic, message) => writer.write(*topic, message.as_message())?,
                    Item::Log(line) => writer.write_log(line)?,
                }
                shared.waiting_bytes.fetch_sub(item.size_bytes(), Ordering::Relaxed);
                shared.written.fetch_add(1, Ordering::Relaxed);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return writer.finish(),
        }
        if flushed.elapsed() >= FLUSH_EVERY {
            writer.flush()?;
            flushed = Instant::now();
        }
    }
}
