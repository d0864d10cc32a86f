//! The table of the graph's topics: name, payload, limits, deadline.
//!
//! Each topic has a publish-subscribe service, and an event service of the same name for wake-ups. Safe overflow is
//! always enabled: a full buffer loses its oldest message, and no subscriber can delay a publisher.
//!
//! Stages of other crates declare topics in the same way, with message types made by [`carff_messages::message!`]:
//!
//! ```
//! use carff_messages::Posterior;
//! use carff_transport::{Topic, topics};
//! /// A second opinion on each frame.
//! pub const OPINION: Topic<Posterior> = Topic::new("second-encoder/posterior", topics::MESSAGES, 500);
//! ```

use crate::payload::{Image, Payload};
use crate::registry::{AnyTopic, TopicId};
use carff_messages::{Action, Belief, Forecast, FrameMeta, Health, Posterior, Stage, ViewMeta};
use std::marker::PhantomData;
use std::time::Duration;

/// The limits of a topic, fixed when its first user opens it.
///
/// ```
/// use carff_transport::{Limits, topics};
/// // Messages of which a late subscriber needs the latest one, and that one process publishes.
/// const SETTINGS: Limits = Limits { history: 1, max_publishers: 1, ..topics::MESSAGES };
/// assert_eq!(SETTINGS.buffer, topics::MESSAGES.buffer);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
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

impl Limits {
    /// Returns the number of messages for which a publisher reserves memory.
    pub(crate) fn preallocated(&self) -> usize {
        self.max_subscribers * (self.buffer + self.borrowed) + self.history + self.loaned
    }
}

/// A topic: a name in the run, with the payload and the limits that all its users share.
///
/// `P` is a message type, or [`Image`] of the message type that describes the image.
#[derive(Debug)]
pub struct Topic<P> {
    /// Name within the run.
    pub name: &'static str,
    /// Limits of the topic.
    pub limits: Limits,
    /// Time without a message, once the topic has begun, after which its receivers report it as stale.
    pub deadline: Duration,
    payload: PhantomData<fn() -> P>,
}

impl<P> Topic<P> {
    /// Returns a topic. Its first user fixes the limits; all others must use the same.
    pub const fn new(name: &'static str, limits: Limits, deadline_ms: u64) -> Self {
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

/// Limits of small messages; some receivers need every message.
pub const MESSAGES: Limits =
    Limits { max_subscribers: 10, max_publishers: 2, max_nodes: 14, history: 0, buffer: 16, borrowed: 3, loaned: 2 };
/// Limits of images: only a few wait, because they are large and only the newest counts.
pub const IMAGES: Limits =
    Limits { max_subscribers: 8, max_publishers: 2, max_nodes: 12, history: 0, buffer: 8, borrowed: 2, loaned: 2 };
/// Limits of status messages: a late receiver gets the latest one.
pub const STATUS: Limits = Limits { history: 1, ..MESSAGES };

macro_rules! topics {
    ($($(#[$doc:meta])* $const:ident: $payload:ty = $name:literal, $limits:expr, $deadline_ms:literal;)+) => {
        $($(#[$doc])* pub const $const: Topic<$payload> = Topic::new($name, $limits, $deadline_ms);)+

        /// The topics from the camera to the action, in the order of the data flow.
        pub(crate) const FLOW: &[&dyn AnyTopic] = &[$(&$const),+];
    };
}

topics! {
    /// Images from camera to encoder.
    FRAME: Image<FrameMeta> = "camera/frame", IMAGES, 500;
    /// Posteriors from encoder to forecaster.
    POSTERIOR: Posterior = "encoder/posterior", MESSAGES, 500;
    /// Forecasts from forecaster to prober and renderer.
    FORECAST: Forecast = "forecaster/forecast", MESSAGES, 500;
    /// Beliefs from prober to controller, renderer, and back to the forecaster.
    BELIEF: Belief = "prober/belief", MESSAGES, 500;
    /// Views from renderer to viewers, recorder and probes.
    VIEW: Image<ViewMeta> = "renderer/view", IMAGES, 5000;
    /// Actions from controller to vehicle.
    ACTION: Action = "controller/action", STATUS, 200;
}

/// The heartbeats of each stage, in the order of [`Stage::ALL`].
static HEALTH: [Topic<Health>; Stage::ALL.len()] = [
    Topic::new("health/camera", STATUS, 1000),
    Topic::new("health/encoder", STATUS, 1000),
    Topic::new("health/forecaster", STATUS, 1000),
    Topic::new("health/prober", STATUS, 1000),
    Topic::new("health/renderer", STATUS, 1000),
    Topic::new("health/controller", STATUS, 1000),
];

/// Returns the topic of a stage's heartbeats.
pub fn health(stage: Stage) -> &'static Topic<Health> {
    &HEALTH[stage.code() as usize - 1]
}

/// Returns the shared memory that a whole graph reserves, bytes, with camera frames and rendered views of these sizes.
/// The launcher checks it once, before it starts a stage.
pub fn graph_bytes(frame_bytes: usize, view_bytes: usize) -> u64 {
    let of = |topic: TopicId| {
        let image_bytes = match topic {
            _ if topic == TopicId::FRAME => frame_bytes,
            _ if topic == TopicId::VIEW => view_bytes,
            _ => 0,
        };
        topic.segment_bytes(image_bytes) + crate::space::MANAGEMENT_BYTES
    };
    TopicId::all().map(of).sum()
}
