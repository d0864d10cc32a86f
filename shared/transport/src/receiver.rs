//! Receiving: in place, validated, newest first or one by one.

use crate::wait::Input;
use crate::{Counters, ReceiveError, Run, Service, descriptors};
use carff_messages::{Invalid, Message, PictureMeta};
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::ZeroCopySend;
use std::fmt::Debug;
use std::ops::Deref;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::time::Duration;

/// Most invalid messages that one look drops: a flood of them must not keep a stage from its other work.
const MAX_DROPS: usize = 64;

/// What both kinds of receiver share.
#[derive(Debug)]
struct Source {
    topic: &'static str,
    deadline: Duration,
    run_id: u64,
    /// None when nobody is to be woken.
    listener: Option<Listener<Service>>,
    counters: Arc<Counters>,
}

impl Source {
    fn failed(&self, error: &dyn std::error::Error) -> ReceiveError {
        ReceiveError { topic: self.topic.to_owned(), cause: error.to_string() }
    }

    /// Counts, and says whether the message may be used. `publisher` is the sender's unique id.
    fn accepts(&self, message: &impl Message, extra: Result<(), Invalid>, publisher: u128) -> bool {
        let found = message.header().run_id;
        let same_run = if found == self.run_id {
            Ok(())
        } else {
            Err(Invalid::Mismatch { field: "header.run_id", found, expected: self.run_id })
        };
        match message.validate().and(same_run).and(extra) {
            Ok(()) => {
                self.counters.count_received();
                true
            }
            Err(error) => {
                // Each is counted; a flood is told of ever more seldom.
                let count = self.counters.count_invalid();
                if count <= 8 || count.is_power_of_two() {
                    let publisher = format_args!("{publisher:x}");
                    tracing::warn!(topic = self.topic, publisher, count, %error, "dropped an invalid message");
                }
                false
            }
        }
    }

    fn clear(&self) -> Result<(), ReceiveError> {
        let Some(listener) = &self.listener else { return Ok(()) };
        listener.try_wait(|_| ()).map(|_| ()).map_err(|e| self.failed(&e))
    }
}

/// Receives messages of a fixed size.
#[derive(Debug)]
pub struct Receiver<M: Message + ZeroCopySend + Debug + 'static> {
    source: Source,
    port: iceoryx2::port::subscriber::Subscriber<Service, M, ()>,
}

/// A message in the sender's memory. It keeps its place there until it is dropped.
#[derive(Debug)]
pub struct Sample<M: Message + ZeroCopySend + Debug + 'static>(iceoryx2::sample::Sample<Service, M, ()>);

impl<M: Message + ZeroCopySend + Debug + 'static> Deref for Sample<M> {
    type Target = M;
    fn deref(&self) -> &M {
        self.0.payload()
    }
}

impl<M: Message + ZeroCopySend + Debug + 'static> Receiver<M> {
    pub(crate) fn new(
        (topic, deadline): (&'static str, Duration),
        run: &Run,
        port: iceoryx2::port::subscriber::Subscriber<Service, M, ()>,
        listener: Listener<Service>,
        counters: Arc<Counters>,
    ) -> Self {
        Self { source: Source { topic, deadline, run_id: run.id(), listener: Some(listener), counters }, port }
    }

    /// Gives up being woken: senders save the system call, and whoever waits for this input spins on a core of its own.
    #[must_use]
    pub fn polled(mut self) -> Self {
        self.source.listener = None;
        self
    }

    /// The oldest valid message that waits, if any. Also `None` after many invalid ones: then the input still has
    /// something waiting, and a wait for it ends at once.
    #[allow(clippy::should_implement_trait, reason = "an iterator would borrow the receiver for a whole loop")]
    pub fn next(&mut self) -> Result<Option<Sample<M>>, ReceiveError> {
        for _ in 0..MAX_DROPS {
            let Some(sample) = self.port.receive().map_err(|e| self.source.failed(&e))? else { break };
            if self.source.accepts(sample.payload(), Ok(()), sample.origin().value()) {
                return Ok(Some(Sample(sample)));
            }
        }
        Ok(None)
    }

    /// The newest valid message that waits, if any. Older ones are counted as skipped.
    pub fn newest(&mut self) -> Result<Option<Sample<M>>, ReceiveError> {
        self.newest_of(|_| ())
    }

    /// The same, with a look at each valid message, older ones first.
    pub fn newest_of(&mut self, mut each: impl FnMut(&M)) -> Result<Option<Sample<M>>, ReceiveError> {
        let mut newest = None;
        for _ in 0..MAX_DROPS {
            let Some(sample) = self.next()? else { break };
            each(&sample);
            if newest.replace(sample).is_some() {
                self.source.counters.count_skipped();
            }
        }
        Ok(newest)
    }
}

impl<M: Message + ZeroCopySend + Debug + 'static> Input for Receiver<M> {
    fn topic(&self) -> &'static str {
        self.source.topic
    }
    fn deadline(&self) -> Duration {
        self.source.deadline
    }
    fn has_waiting(&self) -> Result<bool, ReceiveError> {
        self.port.has_samples().map_err(|e| self.source.failed(&e))
    }
    fn clear_wake_ups(&self) -> Result<(), ReceiveError> {
        self.source.clear()
    }
    fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.source.listener.as_ref().map(descriptors::of_listener)
    }
}

/// Receives pictures.
#[derive(Debug)]
pub struct PictureReceiver<M: PictureMeta + ZeroCopySend + Debug + 'static> {
    source: Source,
    port: iceoryx2::port::subscriber::Subscriber<Service, [u8], M>,
}

/// A picture in the sender's memory. It keeps its place there until it is dropped.
#[derive(Debug)]
pub struct Picture<M: PictureMeta + ZeroCopySend + Debug + 'static>(iceoryx2::sample::Sample<Service, [u8], M>);

impl<M: PictureMeta + ZeroCopySend + Debug + 'static> Picture<M> {
    /// What describes it.
    pub fn meta(&self) -> &M {
        self.0.user_header()
    }

    /// Its bytes, as many as the description says: RGB, 8 bit, rows from the top.
    pub fn bytes(&self) -> &[u8] {
        self.0.payload()
    }
}

impl<M: PictureMeta + ZeroCopySend + Debug + 'static> PictureReceiver<M> {
    pub(crate) fn new(
        (topic, deadline): (&'static str, Duration),
        run: &Run,
        port: iceoryx2::port::subscriber::Subscriber<Service, [u8], M>,
        listener: Listener<Service>,
        counters: Arc<Counters>,
    ) -> Self {
        Self { source: Source { topic, deadline, run_id: run.id(), listener: Some(listener), counters }, port }
    }

    /// Gives up being woken: senders save the system call, and whoever waits for this input spins on a core of its own.
    #[must_use]
    pub fn polled(mut self) -> Self {
        self.source.listener = None;
        self
    }

    /// The oldest valid picture that waits, if any. Also `None` after many invalid ones: then the input still has
    /// something waiting, and a wait for it ends at once.
    #[allow(clippy::should_implement_trait, reason = "an iterator would borrow the receiver for a whole loop")]
    pub fn next(&mut self) -> Result<Option<Picture<M>>, ReceiveError> {
        for _ in 0..MAX_DROPS {
            let Some(sample) = self.port.receive().map_err(|e| self.source.failed(&e))? else { break };
            let meta = sample.user_header();
            // The size that it claims is only meaningful, and only looked at, once the description is valid.
            let size = meta.validate().and_then(|()| {
                let (found, expected) = (sample.payload().len(), meta.picture_bytes());
                if found == expected {
                    Ok(())
                } else {
                    Err(Invalid::Mismatch { field: "picture bytes", found: found as u64, expected: expected as u64 })
                }
            });
            if self.source.accepts(meta, size, sample.origin().value()) {
                return Ok(Some(Picture(sample)));
            }
        }
        Ok(None)
    }

    /// The newest valid picture that waits, if any. Older ones are counted as skipped.
    pub fn newest(&mut self) -> Result<Option<Picture<M>>, ReceiveError> {
        let mut newest = None;
        for _ in 0..MAX_DROPS {
            let Some(picture) = self.next()? else { break };
            if newest.replace(picture).is_some() {
                self.source.counters.count_skipped();
            }
        }
        Ok(newest)
    }
}

impl<M: PictureMeta + ZeroCopySend + Debug + 'static> Input for PictureReceiver<M> {
    fn topic(&self) -> &'static str {
        self.source.topic
    }
    fn deadline(&self) -> Duration {
        self.source.deadline
    }
    fn has_waiting(&self) -> Result<bool, ReceiveError> {
        self.port.has_samples().map_err(|e| self.source.failed(&e))
    }
    fn clear_wake_ups(&self) -> Result<(), ReceiveError> {
        self.source.clear()
    }
    fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.source.listener.as_ref().map(descriptors::of_listener)
    }
}
