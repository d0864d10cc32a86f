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

use crate::payload::Image;
use crate::topic::{Limits, Topic};
use carff_messages::{
    Action, Belief, Forecast, FrameMeta, Health, ImageCheck, Occupancy, Posterior, Stage, Unknowns, ViewMeta,
};

/// Limits of small messages; some receivers need every message.
pub const MESSAGES: Limits =
    Limits { max_subscribers: 10, max_publishers: 2, max_nodes: 14, history: 0, buffer: 16, borrowed: 3, loaned: 2 };
/// Limits of messages that a restarted receiver takes up again: those of the last seconds.
pub const REMEMBERED: Limits = Limits { history: 48, buffer: 64, ..MESSAGES };
/// Limits of images: only a few wait, because they are large and only the newest counts.
pub const IMAGES: Limits =
    Limits { max_subscribers: 8, max_publishers: 2, max_nodes: 12, history: 0, buffer: 8, borrowed: 2, loaned: 2 };
/// Limits of status messages: a late receiver gets the latest one.
pub const STATUS: Limits = Limits { history: 1, ..MESSAGES };

/// Limits of images for one observer: large ones need little memory.
const ONE_IMAGE: Limits =
    Limits { max_subscribers: 1, max_publishers: 2, max_nodes: 4, history: 0, buffer: 1, borrowed: 1, loaned: 1 };

/// Images from camera to encoder and prober.
pub const FRAME: Topic<Image<FrameMeta>> = Topic::new("camera/frame", IMAGES, 500);
/// Images of a real camera before rectification, for `carff camera check`; published only for it.
pub const RAW: Topic<Image<FrameMeta>> = Topic::new("camera/raw", ONE_IMAGE, 500);
/// Posteriors from encoder to forecaster.
pub const POSTERIOR: Topic<Posterior> = Topic::new("encoder/posterior", REMEMBERED, 500);
/// Checks of images from encoder to controller.
pub const CHECK: Topic<ImageCheck> = Topic::new("encoder/check", MESSAGES, 500);
/// Forecasts from forecaster to prober and renderer.
pub const FORECAST: Topic<Forecast> = Topic::new("forecaster/forecast", MESSAGES, 500);
/// Beliefs from prober to controller, renderer, and back to the forecaster.
pub const BELIEF: Topic<Belief> = Topic::new("prober/belief", MESSAGES, 500);
/// Comparisons of images with the known states, from prober to observers.
pub const UNKNOWN: Topic<Unknowns> = Topic::new("prober/unknown", MESSAGES, 500);
/// Occupancy grids of beliefs, from prober to observers and planners.
pub const OCCUPANCY: Topic<Occupancy> = Topic::new("prober/occupancy", MESSAGES, 500);
/// Views from renderer to viewers, recorder and probes.
pub const VIEW: Topic<Image<ViewMeta>> = Topic::new("renderer/view", IMAGES, 5000);
/// Actions from controller to vehicle.
pub const ACTION: Topic<Action> = Topic::new("controller/action", STATUS, 200);

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
