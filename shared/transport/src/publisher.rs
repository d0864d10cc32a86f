//! Sending: stamp, write in place, wake.

use crate::{Counters, Run, SendError, Service, monotonic_now_ns};
use carff_messages::{Header, Message, PictureMeta, SCHEMA_VERSION};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::sample_mut::SampleMut;
use std::fmt::Debug;
use std::sync::Arc;

/// What both kinds of publisher share.
#[derive(Debug)]
struct Sender {
    topic: &'static str,
    run_id: u64,
    sequence: u64,
    notifier: Notifier<Service>,
    counters: Arc<Counters>,
}

impl Sender {
    fn stamp(&self, header: &mut Header) {
        header.schema_version = SCHEMA_VERSION;
        header.run_id = self.run_id;
        header.sequence = self.sequence;
        header.publish_time_ns = monotonic_now_ns();
    }

    /// Counts and wakes. A listener that cannot be woken (dead, or stopped with a full socket) is its own problem:
    /// it finds the message when it looks next.
    fn sent(&mut self) {
        self.sequence += 1;
        self.counters.count_published();
        if let Err(error) = self.notifier.notify() {
            tracing::debug!(topic = self.topic, %error, "a listener was not woken");
        }
    }

    fn failed(&self, error: &dyn std::error::Error) -> SendError {
        SendError::Failed { topic: self.topic.to_owned(), cause: error.to_string() }
    }

    fn validated(&self, message: &impl Message) -> Result<(), SendError> {
        message.validate().map_err(|source| SendError::Invalid { topic: self.topic.to_owned(), source })
    }
}

/// Sends messages of a fixed size.
#[derive(Debug)]
pub struct Publisher<M: Message + ZeroCopySend + Debug + 'static> {
    sender: Sender,
    port: iceoryx2::port::publisher::Publisher<Service, M, ()>,
}

impl<M: Message + ZeroCopySend + Debug + 'static> Publisher<M> {
    pub(crate) fn new(
        topic: &'static str,
        run: &Run,
        port: iceoryx2::port::publisher::Publisher<Service, M, ()>,
        notifier: Notifier<Service>,
        counters: Arc<Counters>,
    ) -> Self {
        Self { sender: Sender { topic, run_id: run.id(), sequence: 0, notifier, counters }, port }
    }

    /// Stamps the header (schema, run, sequence, publish time), validates, sends, and wakes whoever waits.
    pub fn send(&mut self, mut message: M) -> Result<(), SendError> {
        self.sender.stamp(message.header_mut());
        self.sender.validated(&message)?;
        self.send_unchecked(message)
    }

    /// Sends as it is, without stamp or validation: for replay, and for tests that inject faults.
    pub fn send_unchecked(&mut self, message: M) -> Result<(), SendError> {
        let sample = self.port.loan_uninit().map_err(|e| self.sender.failed(&e))?;
        sample.write_payload(message).send().map_err(|e| self.sender.failed(&e))?;
        self.sender.sent();
        Ok(())
    }
}

/// Sends pictures that are written in place.
#[derive(Debug)]
pub struct PicturePublisher<M: PictureMeta + ZeroCopySend + Debug + 'static> {
    sender: Sender,
    port: iceoryx2::port::publisher::Publisher<Service, [u8], M>,
    max_bytes: usize,
}

/// Memory of the publisher, to be written in place and sent.
#[derive(Debug)]
pub struct PictureLoan<M: PictureMeta + ZeroCopySend + Debug + 'static> {
    sample: SampleMut<Service, [u8], M>,
}

impl<M: PictureMeta + ZeroCopySend + Debug + 'static> PictureLoan<M> {
    /// The picture's bytes, zero at first.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        self.sample.payload_mut()
    }
}

impl<M: PictureMeta + ZeroCopySend + Debug + 'static> PicturePublisher<M> {
    pub(crate) fn new(
        topic: &'static str,
        run: &Run,
        port: iceoryx2::port::publisher::Publisher<Service, [u8], M>,
        notifier: Notifier<Service>,
        counters: Arc<Counters>,
        max_bytes: usize,
    ) -> Self {
        Self { sender: Sender { topic, run_id: run.id(), sequence: 0, notifier, counters }, port, max_bytes }
    }

    /// Memory for a picture of so many bytes, in the segment that the receivers read from.
    pub fn loan(&self, bytes: usize) -> Result<PictureLoan<M>, SendError> {
        if bytes > self.max_bytes {
            return Err(SendError::Size { topic: self.sender.topic.to_owned(), found: bytes, max: self.max_bytes });
        }
        let sample = self.port.loan_slice(bytes).map_err(|e| self.sender.failed(&e))?;
        Ok(PictureLoan { sample })
    }

    /// [`PicturePublisher::send`] of a picture that lies elsewhere: its bytes are copied once, over memory that nobody
    /// cleared first.
    pub fn send_bytes(&mut self, bytes: &[u8], mut meta: M) -> Result<(), SendError> {
        self.sender.stamp(meta.header_mut());
        self.sender.validated(&meta)?;
        let topic = || self.sender.topic.to_owned();
        if bytes.len() > self.max_bytes {
            return Err(SendError::Size { topic: topic(), found: bytes.len(), max: self.max_bytes });
        }
        if bytes.len() != meta.picture_bytes() {
            return Err(SendError::Size { topic: topic(), found: bytes.len(), max: meta.picture_bytes() });
        }
        let sample = self.port.loan_slice_uninit(bytes.len()).map_err(|e| self.sender.failed(&e))?;
        self.send_unchecked(PictureLoan { sample: sample.write_from_slice(bytes) }, meta)
    }

    /// Stamps the header, validates, sends what was written, and wakes whoever waits.
    pub fn send(&mut self, loan: PictureLoan<M>, mut meta: M) -> Result<(), SendError> {
        self.sender.stamp(meta.header_mut());
        self.sender.validated(&meta)?;
        let (found, described) = (loan.sample.payload().len(), meta.picture_bytes());
        if found != described {
            return Err(SendError::Size { topic: self.sender.topic.to_owned(), found, max: described });
        }
        self.send_unchecked(loan, meta)
    }

    /// Sends as it is, without stamp or validation: for replay, and for tests that inject faults.
    pub fn send_unchecked(&mut self, mut loan: PictureLoan<M>, meta: M) -> Result<(), SendError> {
        *loan.sample.user_header_mut() = meta;
        loan.sample.send().map_err(|e| self.sender.failed(&e))?;
        self.sender.sent();
        Ok(())
    }
}
