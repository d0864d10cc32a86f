//! The truth about a closed-loop world, for observers. No stage of a graph subscribes to it.

use carff_messages::{Header, Invalid, ZeroCopySend, check, described, message};
use carff_transport::{Topic, topics};

/// Largest number of other vehicles.
pub(super) const MAX_ACTORS: usize = 3;

/// Poses of everyone when a frame is taken.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("carff.WorldTruth.v1")]
pub(super) struct WorldTruth {
    /// Header of the frame.
    pub(super) header: Header,
    /// Number of the episode.
    pub(super) episode: u64,
    /// Time since the start of the episode, seconds.
    pub(super) time_s: f64,
    /// The ego: x, y in metres, heading in radians, speed in m/s.
    pub(super) ego: [f64; 4],
    /// Number of other vehicles.
    pub(super) actor_count: u64,
    /// The others: x, y in metres, heading in radians for each.
    pub(super) actors: [[f64; 3]; MAX_ACTORS],
}

/// Topic of the truth.
pub(super) const TRUTH: Topic<WorldTruth> = Topic::new("world/truth", topics::MESSAGES, 500);

impl WorldTruth {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::at_most("actor_count", self.actor_count, MAX_ACTORS as u64)?;
        check::finite_f64("ego", &self.ego)?;
        check::finite_f64("actors", self.actors.iter().flatten())
    }
}

message!(WorldTruth);
described!(WorldTruth { header, episode, time_s, ego, actor_count, actors });
