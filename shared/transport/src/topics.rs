//! The one table of topics: name, type, limits, deadline.
//!
//! Each topic has a publish-subscribe service and an event service of the same name for wake-up. Safe overflow is on
//! everywhere: a full buffer loses its oldest message, and no subscriber can delay a publisher.
//!
//! A stage of another crate has topics of its own, of messages made with [`carff_messages::message!`]:
//!
//! ```
//! use carff_messages::Posterior;
//! use carff_transport::{Topic, topics};
//! /// A second opinion on each frame.
//! pub const OPINION: Topic<Posterior> = Topic::new("second-encoder/posterior", topics::MESSAGES, 500);
//! ```

use carff_messages::{Action, Belief, Forecast, FrameMeta, Health, Posterior, Stage, ViewMeta};
use std::marker::PhantomData;
use std::time::Duration;

/// The limits of a topic, fixed when its first user opens it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Subscribers: those of the graph, and spare ones for the launcher, recorder, viewer and probes.
    pub max_subscribers: usize,
    /// Publishers: one, and one to replace it while the dead one's slot is being freed.
    pub max_publishers: usize,
    /// Processes that have the topic open.
    pub max_nodes: usize,
    /// Messages that a subscriber who comes late is given.
    pub history: usize,
    /// Messages that wait for a slow subscriber before the oldest is lost.
    pub buffer: usize,
    /// Messages that a subscriber can hold at a time.
    pub borrowed: usize,
    /// Messages that a publisher can write at a time.
    pub loaned: usize,
}

impl Limits {
    /// Messages for which a publisher sets memory aside.
    pub(crate) fn preallocated(&self) -> usize {
        self.max_subscribers * (self.buffer + self.borrowed) + self.history + self.loaned
    }
}

/// A topic of fixed-size messages.
#[derive(Debug)]
pub struct Topic<M> {
    /// Name within the run.
    pub name: &'static str,
    /// Limits.
    pub limits: Limits,
    /// How long it may be quiet, once it has begun, before whoever reads it calls it stale.
    pub deadline: Duration,
    message: PhantomData<M>,
}

/// A topic of pictures: bytes, with `M` to describe them.
#[derive(Debug)]
pub struct PictureTopic<M> {
    /// Name within the run.
    pub name: &'static str,
    /// Limits.
    pub limits: Limits,
    /// How long it may be quiet, once it has begun, before whoever reads it calls it stale.
    pub deadline: Duration,
    meta: PhantomData<M>,
}

/// Small messages of which some readers want every one.
pub const MESSAGES: Limits =
    Limits { max_subscribers: 10, max_publishers: 2, max_nodes: 14, history: 0, buffer: 16, borrowed: 3, loaned: 2 };
/// Pictures: fewer wait, as they are large and only the newest counts.
pub const PICTURES: Limits =
    Limits { max_subscribers: 8, max_publishers: 2, max_nodes: 12, history: 0, buffer: 8, borrowed: 2, loaned: 2 };
/// The latest of these tells a late reader how things stand.
pub const STATUS: Limits = Limits { history: 1, ..MESSAGES };

macro_rules! table {
    ($($(#[$doc:meta])* $const:ident: $kind:ident<$message:ty> = $name:literal, $limits:expr, $deadline_ms:literal;)+) => {
        $($(#[$doc])* pub const $const: $kind<$message> = $kind::new($name, $limits, $deadline_ms);)+
    };
}

table! {
    /// Camera to encoder.
    FRAME: PictureTopic<FrameMeta> = "camera/frame", PICTURES, 500;
    /// Encoder to forecaster.
    POSTERIOR: Topic<Posterior> = "encoder/posterior", MESSAGES, 500;
    /// Forecaster to prober and renderer.
    FORECAST: Topic<Forecast> = "forecaster/forecast", MESSAGES, 500;
    /// Prober to controller, renderer, and back to the forecaster.
    BELIEF: Topic<Belief> = "prober/belief", MESSAGES, 500;
    /// Renderer to viewers, recorder, probes.
    VIEW: PictureTopic<ViewMeta> = "renderer/view", PICTURES, 5000;
    /// Controller to the car.
    ACTION: Topic<Action> = "controller/action", STATUS, 200;
}

/// The heartbeats of a stage.
pub const fn health(stage: Stage) -> Topic<Health> {
    let name = match stage {
        Stage::Camera => "health/camera",
        Stage::Encoder => "health/encoder",
        Stage::Forecaster => "health/forecaster",
        Stage::Prober => "health/prober",
        Stage::Renderer => "health/renderer",
        Stage::Controller => "health/controller",
    };
    Topic::new(name, STATUS, 1000)
}

impl<M> Topic<M> {
    /// A topic; whoever opens it first fixes its limits, and all others must have the same.
    pub const fn new(name: &'static str, limits: Limits, deadline_ms: u64) -> Self {
        Self { name, limits, deadline: Duration::from_millis(deadline_ms), message: PhantomData }
    }
}

impl<M> PictureTopic<M> {
    /// A topic; whoever opens it first fixes its limits, and all others must have the same.
    pub const fn new(name: &'static str, limits: Limits, deadline_ms: u64) -> Self {
        Self { name, limits, deadline: Duration::from_millis(deadline_ms), meta: PhantomData }
    }
}

/// Shared memory that a whole graph takes with camera frames and rendered views of these sizes, bytes.
/// The launcher checks it once, before it starts anything.
pub fn graph_bytes(frame_bytes: usize, view_bytes: usize) -> u64 {
    fn of<M>(limits: Limits, payload: usize) -> u64 {
        (limits.preallocated() * (size_of::<M>() + payload + 64)) as u64 + crate::space::MANAGEMENT_BYTES
    }
    of::<FrameMeta>(FRAME.limits, frame_bytes)
        + of::<Posterior>(POSTERIOR.limits, 0)
        + of::<Forecast>(FORECAST.limits, 0)
        + of::<Belief>(BELIEF.limits, 0)
        + of::<ViewMeta>(VIEW.limits, view_bytes)
        + of::<Action>(ACTION.limits, 0)
        + Stage::ALL.len() as u64 * of::<Health>(STATUS, 0)
}
