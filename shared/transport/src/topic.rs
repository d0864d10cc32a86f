//! A topic with its limits.

use crate::payload::Payload;
use std::marker::PhantomData;
use std::time::Duration;

/// The limits of a topic, fixed when its first user opens it.
///
/// ```
/// use carff_transport::{TopicLimits, topics};
/// // Messages of which a late subscriber needs the latest one, and that one process publishes.
/// const SETTINGS: TopicLimits = TopicLimits { history: 1, max_publishers: 1, ..topics::MESSAGES };
/// assert_eq!(SETTINGS.buffer, topics::MESSAGES.buffer);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicLimits {
    /// Maximum number of subscribers: those of the graph, and spare ones for launcher, recorder, viewer and probes.
    pub max_subscribers: usize,
    /// Maximum number of publishers: one, and one to replace it while a dead one's slot is being freed.
    pub max_publishers: usize,
    /// Maximum number of processes that have the topic open.
    pub max_nodes: usize,
    /// Number of past messages that a late subscriber receives.
    pub history: usize,
    /// Number of messages that wait for a slow subscriber before the oldest is lost.
    pub buffer: usize,
    /// Number of messages that a subscriber can hold at a time.
    pub borrowed: usize,
    /// Number of messages that a publisher can write at a time.
    pub loaned: usize,
}

impl TopicLimits {
    /// Returns the number of messages for which a publisher reserves memory.
    pub(crate) fn preallocated(&self) -> usize {
        self.max_subscribers * (self.buffer + self.borrowed) + self.history + self.loaned
    }
}

/// A topic: a name in the run, with the payload and the limits that all its users share.
///
/// `P` is a message type, or [`crate::ImagePayload`] of the message type that describes the image.
///
/// ```
/// use carff_messages::EgoPose;
/// use carff_transport::{Topic, topics};
/// // The pose of another vehicle, which comes at least every 200 ms.
/// const LEADER_POSE: Topic<EgoPose> = Topic::new("leader/pose", topics::MESSAGES, 200);
/// assert_eq!(LEADER_POSE.deadline.as_millis(), 200);
/// ```
#[derive(Debug)]
pub struct Topic<P> {
    /// Name within the run.
    pub name: &'static str,
    /// Limits of the topic.
    pub limits: TopicLimits,
    /// Time without a message, once the topic has begun, after which its receivers report it as stale.
    pub deadline: Duration,
    payload: PhantomData<fn() -> P>,
}

impl<P> Topic<P> {
    /// Returns a topic. Its first user fixes the limits; all others must use the same.
    pub const fn new(name: &'static str, limits: TopicLimits, deadline_ms: u64) -> Self {
        Self { name, limits, deadline: Duration::from_millis(deadline_ms), payload: PhantomData }
    }
}

impl<P: Payload> Topic<P> {
    /// Returns the shared memory that a publisher of images of `max_bytes` (0 for messages) reserves, bytes.
    pub(crate) fn segment_bytes(&self, max_bytes: usize) -> u64 {
        /// Size of iceoryx2's own header of each sample, with alignment.
        const SAMPLE_HEADER_BYTES: usize = 64;
        let sample_bytes = size_of::<P::Message>() + max_bytes + SAMPLE_HEADER_BYTES;
        (self.limits.preallocated() * sample_bytes) as u64
    }
}
