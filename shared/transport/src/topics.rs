//! The table of the graph's topics: name, payload, limits, deadline. A new topic of the graph is one line of it.
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

use crate::in_use::OpenTopic;
use crate::payload::ImagePayload;
use crate::topic::{Topic, TopicLimits};
use crate::{AnyTopic, TopicId};
use carff_messages::{
    Action, Belief, EgoMotion, EgoPose, Forecast, FrameMeta, Health, ImageCheck, LookGain, Occupancy, Posterior, Stage,
    Unknowns, ViewMeta,
};

/// Limits of small messages; some receivers need every message.
pub const MESSAGES: TopicLimits = TopicLimits {
    max_subscribers: 10,
    max_publishers: 2,
    max_nodes: 14,
    history: 0,
    buffer: 16,
    borrowed: 3,
    loaned: 2,
};
/// Limits of messages that a restarted receiver takes up again: those of the last seconds.
pub const REMEMBERED: TopicLimits = TopicLimits { history: 48, buffer: 64, ..MESSAGES };
/// Limits of images: only a few wait, because they are large and only the newest counts.
pub const IMAGES: TopicLimits =
    TopicLimits { max_subscribers: 8, max_publishers: 2, max_nodes: 12, history: 0, buffer: 8, borrowed: 2, loaned: 2 };
/// Limits of status messages: a late receiver gets the latest one.
pub const STATUS: TopicLimits = TopicLimits { history: 1, ..MESSAGES };

/// Limits of images for one observer: large ones need little memory.
const ONE_IMAGE: TopicLimits =
    TopicLimits { max_subscribers: 1, max_publishers: 2, max_nodes: 4, history: 0, buffer: 1, borrowed: 1, loaned: 1 };

/// Images of a real camera before rectification, for `carff camera check`; published only for it.
pub const RAW: Topic<ImagePayload<FrameMeta>> = Topic::new("camera/raw", ONE_IMAGE, 500);

/// Declares the topics of the graph's messages, each with its [`TopicId`]: name, payload, limits, and deadline in
/// milliseconds.
macro_rules! flow {
    ($($(#[$doc:meta])* $id:ident: $payload:ty = $name:literal, $limits:expr, $deadline_ms:literal;)+) => {
        $($(#[$doc])* pub const $id: Topic<$payload> = Topic::new($name, $limits, $deadline_ms);)+

        /// The position of each topic in the table.
        #[allow(non_camel_case_types, clippy::upper_case_acronyms, reason = "the names are those of the constants")]
        enum Index {
            $($id),+
        }

        impl TopicId {
            $(#[doc = concat!("`", $name, "`.")] pub const $id: Self = Self::of_graph(Index::$id as usize, &$id);)+

            /// The topics from the vehicle and the camera to the action, in the order of the data flow.
            pub const FLOW: [Self; [$($name),+].len()] = [$(Self::$id),+];

            /// Returns the topic of a stage's heartbeats.
            pub fn health(stage: Stage) -> Self {
                Self::of_graph(Self::FLOW.len() + stage.code() as usize - 1, health(stage))
            }
        }

        /// Returns an open topic with the payload of one of the graph's topics.
        pub(crate) fn of_known_payload(open: &OpenTopic) -> Option<&'static dyn AnyTopic> {
            None$(.or_else(|| open.typed::<$payload>()))+.or_else(|| open.typed::<Health>())
        }
    };
}

flow! {
    /// Poses of the vehicle, from a localisation or a simulator. A camera with `camera.vehicle_from_camera` takes the
    /// newest one for each frame.
    EGO_POSE: EgoPose = "ego/pose", STATUS, 500;
    /// Motions of the vehicle, from its planner or a simulator. Approaches other than `stop` use the newest one.
    EGO_MOTION: EgoMotion = "ego/motion", STATUS, 500;
    /// Images from camera to encoder and prober.
    FRAME: ImagePayload<FrameMeta> = "camera/frame", IMAGES, 500;
    /// Posteriors from encoder to forecaster.
    POSTERIOR: Posterior = "encoder/posterior", REMEMBERED, 500;
    /// Checks of images from encoder to controller.
    CHECK: ImageCheck = "encoder/check", MESSAGES, 500;
    /// Forecasts from forecaster to prober and renderer.
    FORECAST: Forecast = "forecaster/forecast", MESSAGES, 500;
    /// Beliefs from prober to controller, renderer, and back to the forecaster.
    BELIEF: Belief = "prober/belief", MESSAGES, 500;
    /// Comparisons of images with the known states, from prober to observers, and back to the forecaster.
    UNKNOWN: Unknowns = "prober/unknown", REMEMBERED, 500;
    /// Occupancy grids of beliefs, from prober to observers and planners.
    OCCUPANCY: Occupancy = "prober/occupancy", MESSAGES, 500;
    /// Values of a look from further on, from prober to controller; published with `controller.approach = "look"`.
    LOOK: LookGain = "prober/look", MESSAGES, 500;
    /// Views from renderer to viewers, recorder and probes.
    VIEW: ImagePayload<ViewMeta> = "renderer/view", IMAGES, 5000;
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
