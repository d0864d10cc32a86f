//! Receiving: in place, validated, the newest or one by one.

use crate::payload::{ImagePayload, Payload};
use crate::wait::Input;
use crate::{Counters, ReceiveError, Run, Service, Topic, descriptors};
use carff_messages::check::equals;
use carff_messages::{ImageMeta, Message};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::subscriber::Subscriber;
use ndarray::ArrayView3;
use std::ops::Deref;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::time::Duration;

/// Maximum number of invalid messages that one call drops, so that a flood of them cannot block a stage.
const MAX_DROPS: usize = 64;

/// Receives the messages of one topic.
#[derive(Debug)]
pub struct Receiver<P: Payload> {
    topic: &'static str,
    deadline: Duration,
    run_id: u64,
    port: Subscriber<Service, P::Body, P::UserHeader>,
    /// Listener for wake-ups; `None` for a polled input.
    listener: Option<Listener<Service>>,
    counters: Arc<Counters>,
}

/// A received message in its sender's memory. The memory stays in use until the sample is dropped.
#[derive(Debug)]
pub struct Sample<P: Payload>(iceoryx2::sample::Sample<Service, P::Body, P::UserHeader>);

impl<P: Payload> Deref for Sample<P> {
    type Target = P::Message;

    fn deref(&self) -> &P::Message {
        P::message(&self.0)
    }
}

impl<P: Payload> Sample<P> {
    /// Returns the bytes of an image; empty for a message by itself.
    pub fn bytes(&self) -> &[u8] {
        P::bytes(&self.0)
    }
}

impl<M: ImageMeta> Sample<ImagePayload<M>> {
    /// Returns the image as (height, width, channel), borrowed from shared memory.
    #[allow(clippy::missing_panics_doc, reason = "an empty view needs no bytes")]
    pub fn image(&self) -> ArrayView3<'_, u8> {
        let [width_px, height_px] = self.size_px().map(|side| side as usize);
        // A received image has as many bytes as its description states; the empty view is never returned.
        ArrayView3::from_shape((height_px, width_px, 3), self.bytes())
            .unwrap_or_else(|_| ArrayView3::from_shape((0, 0, 3), &[]).expect("an empty view needs no bytes"))
    }
}

impl<P: Payload> Receiver<P> {
    pub(crate) fn new(
        topic: &Topic<P>,
        run: &Run,
        port: Subscriber<Service, P::Body, P::UserHeader>,
        listener: Listener<Service>,
        counters: Arc<Counters>,
    ) -> Self {
        let (name, deadline) = (topic.name, topic.deadline);
        Self { topic: name, deadline, run_id: run.id(), port, listener: Some(listener), counters }
    }

    /// Disables wake-ups: senders save the system call, and a wait for this input polls, which occupies a core.
    #[must_use]
    pub fn polled(mut self) -> Self {
        self.listener = None;
        self
    }

    /// Returns the oldest waiting valid message. After many invalid messages it also returns `None`; the input then
    /// still has a message, and the next wait ends at once.
    #[allow(clippy::should_implement_trait, reason = "an iterator would borrow the receiver for a whole loop")]
    pub fn next(&mut self) -> Result<Option<Sample<P>>, ReceiveError> {
        for _ in 0..MAX_DROPS {
            let Some(sample) = P::receive(&self.port).map_err(|e| self.failed(&e))? else { break };
            if self.accepts(&sample) {
                return Ok(Some(Sample(sample)));
            }
        }
        Ok(None)
    }

    /// Returns the newest waiting valid message and counts older ones as skipped.
    pub fn newest(&mut self) -> Result<Option<Sample<P>>, ReceiveError> {
        self.newest_of(|_| ())
    }

    /// Returns the newest waiting valid message, after passing each valid message to `each`, oldest first.
    pub fn newest_of(&mut self, mut each: impl FnMut(&P::Message)) -> Result<Option<Sample<P>>, ReceiveError> {
        let mut newest = None;
        for _ in 0..MAX_DROPS {
            let Some(sample) = self.next()? else { break };
            each(&sample);
            if newest.replace(sample).is_some() {
                self.counters.count_skipped();
            }
        }
        Ok(newest)
    }

    /// Counts the message and returns whether it is valid.
    fn accepts(&self, sample: &iceoryx2::sample::Sample<Service, P::Body, P::UserHeader>) -> bool {
        let message = P::message(sample);
        let same_run = equals("header.run_id", message.header().run_id, self.run_id);
        // The size in the description is only meaningful if the message is valid.
        match message.validate().and(same_run).and_then(|()| P::check_size(message, P::bytes(sample).len())) {
            Ok(()) => {
                self.counters.count_received();
                true
            }
            Err(error) => {
                // All are counted; in a flood, fewer and fewer are logged.
                let count = self.counters.count_invalid();
                if count <= 8 || count.is_power_of_two() {
                    let publisher = format_args!("{:x}", sample.origin().value());
                    tracing::warn!(topic = self.topic, publisher, count, %error, "dropped an invalid message");
                }
                false
            }
        }
    }

    fn failed(&self, error: &dyn std::error::Error) -> ReceiveError {
        ReceiveError { topic: self.topic.to_owned(), cause: error.to_string() }
    }
}

impl<P: Payload> Input for Receiver<P> {
    fn topic(&self) -> &'static str {
        self.topic
    }
    fn deadline(&self) -> Duration {
        self.deadline
    }
    fn has_waiting(&self) -> Result<bool, ReceiveError> {
        self.port.has_samples().map_err(|e| self.failed(&e))
    }
    fn clear_wake_ups(&self) -> Result<(), ReceiveError> {
        let Some(listener) = &self.listener else { return Ok(()) };
        listener.try_wait(|_| ()).map(|_| ()).map_err(|e| self.failed(&e))
    }
    fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.listener.as_ref().map(descriptors::of_listener)
    }
}
