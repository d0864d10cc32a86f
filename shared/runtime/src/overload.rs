//! Quality reduction under overload: pure logic, without topics and without a clock.
//!
//! Every stage that reads beliefs sees the same signs: the duration of each frame and skipped frames. So all stages
//! reach the same level independently; each reduces its own work.

use carff_config::{GraphConfig, Reduction};
use carff_messages::Belief;

/// Maximum number of doublings of the wait before a restoration.
const MAX_DOUBLINGS: u32 = 4;

/// Quality of the work at a level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quality {
    /// Factor by which views are smaller in width and height.
    pub resolution_divisor: u32,
    /// Number of latents drawn from each mixture.
    pub samples: u32,
    /// Number of look-ahead steps.
    pub horizon: u32,
}

/// Observes frames and selects the quality.
///
/// ```
/// use carff_config::GraphConfig;
/// use carff_messages::{Belief, Header};
/// use carff_runtime::Overload;
/// let text = "[run]\nname = \"x\"\ndataset = \"d\"\ncheckpoint = \"c\"\n[overload]\norder = [\"resolution\"]";
/// let graph = GraphConfig::parse(text, "crossing.toml".as_ref())?;
/// let mut overload = Overload::new(&graph);
/// let full = overload.quality();
/// // Only every second frame reaches the last step.
/// for n in 0..100 {
///     let mut header = Header::of_frame(2 * n, 0, 42).at_step(1);
///     header.sequence = n;
///     overload.observe(&Belief::empty(header, 1));
/// }
/// assert!(overload.quality().resolution_divisor > full.resolution_divisor);
/// # Ok::<(), carff_config::ConfigError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Overload {
    /// Quality of each level; level 0 is the graph file's.
    levels: Vec<Quality>,
    level: usize,
    latency_limit_ns: u64,
    window: u32,
    patience: u32,
    doublings: u32,
    /// Frames and signs in the current window.
    seen: u32,
    signs: u32,
    /// Number of consecutive frames without a sign.
    calm: u32,
    /// Number of frames since the last restoration.
    since_restored: Option<u32>,
    last_frame: Option<u64>,
    last_sequence: Option<u64>,
    /// Number of consecutive frames that were not newer than the last one.
    behind: u32,
}

impl Overload {
    /// Starts at the graph file's full quality.
    pub fn new(graph: &GraphConfig) -> Self {
        let settings = &graph.overload;
        Self {
            levels: levels(graph),
            level: 0,
            latency_limit_ns: (graph.controller.deadline_ms as f64 * 1e6 * settings.latency_share) as u64,
            window: settings.window,
            patience: settings.patience,
            doublings: 0,
            seen: 0,
            signs: 0,
            calm: 0,
            since_restored: None,
            last_frame: None,
            last_sequence: None,
            behind: 0,
        }
    }

    /// Observes a belief; the last step of each frame counts. Returns true if the quality has changed.
    pub fn observe(&mut self, belief: &Belief) -> bool {
        let header = &belief.header;
        // Messages that the observer itself missed were not skipped by the graph.
        let seen_all = self.last_sequence.is_some_and(|last| header.sequence == last.wrapping_add(1));
        self.last_sequence = Some(header.sequence);
        if !seen_all {
            self.last_frame = None;
        }
        if !belief.is_final() {
            return false;
        }
        let skipped = match self.last_frame {
            Some(last) if header.frame_id <= last => {
                // One late frame is ignored; many mean that the camera has restarted its count.
                self.behind += 1;
                if self.behind > self.window {
                    (self.last_frame, self.behind) = (None, 0);
                }
                return false;
            }
            Some(last) => header.frame_id > last + 1,
            None => false,
        };
        self.behind = 0;
        self.last_frame = Some(header.frame_id);
        let latency_ns = header.publish_time_ns.saturating_sub(header.capture_time_ns);
        let sign = skipped || latency_ns > self.latency_limit_ns;
        self.seen += 1;
        self.signs += u32::from(sign);
        self.calm = if sign { 0 } else { self.calm + 1 };
        if let Some(since) = &mut self.since_restored {
            *since += 1;
        }
        let before = self.level;
        if self.signs * 2 >= self.window {
            self.give_up();
        } else if self.calm >= self.patience << self.doublings {
            self.get_back();
        } else if self.seen >= self.window {
            (self.seen, self.signs) = (0, 0);
        }
        self.level != before
    }

    /// Returns the current quality.
    pub fn quality(&self) -> Quality {
        self.levels[self.level]
    }

    fn give_up(&mut self) {
        if self.level + 1 < self.levels.len() {
            self.level += 1;
        }
        // Overload returned soon after the restoration: there was not enough capacity.
        if self.since_restored.take().is_some_and(|since| since <= 4 * self.window) {
            self.doublings = (self.doublings + 1).min(MAX_DOUBLINGS);
        }
        (self.seen, self.signs, self.calm) = (0, 0, 0);
    }

    fn get_back(&mut self) {
        if self.level > 0 {
            self.level -= 1;
            self.since_restored = Some(0);
        } else {
            self.doublings = 0;
        }
        (self.seen, self.signs, self.calm) = (0, 0, 0);
    }
}

/// Returns full quality, then one more reduction per level in the configured order.
fn levels(graph: &GraphConfig) -> Vec<Quality> {
    let mut quality = Quality { resolution_divisor: 1, samples: graph.run.samples, horizon: graph.run.horizon };
    let mut levels = vec![quality];
    for part in &graph.overload.order {
        match part {
            Reduction::Resolution => {
                for divisor in [2, 4] {
                    quality.resolution_divisor = divisor;
                    levels.push(quality);
                }
            }
            Reduction::Samples => {
                while quality.samples > graph.overload.min_samples {
                    quality.samples = (quality.samples / 2).max(graph.overload.min_samples);
                    levels.push(quality);
                }
            }
            Reduction::Horizon => {
                while quality.horizon > 1 {
                    quality.horizon -= 1;
                    levels.push(quality);
                }
            }
        }
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Header;

    const MS: u64 = 1_000_000;

    fn overload(rest: &str) -> Overload {
        let text = format!("[run]\nname = \"t\"\ndataset = \"d\"\ncheckpoint = \"c\"\n{rest}");
        Overload::new(&GraphConfig::parse(&text, "test.toml".as_ref()).unwrap())
    }

    /// Observes `count` frames from `first` on, each with this latency; returns the number of changes.
    fn show(overload: &mut Overload, first: u64, count: u64, latency_ms: u64) -> usize {
        (first..first + count)
            .filter(|&id| {
                let mut header = Header::of_frame(id, id * 100 * MS, 1).at_step(2);
                header.publish_time_ns = header.capture_time_ns + latency_ms * MS;
                header.sequence = overload.last_sequence.map_or(0, |last| last + 1);
                overload.observe(&Belief::empty(header, 2))
            })
            .count()
    }

    const ALL: &str = "[overload]\norder = [\"resolution\", \"samples\", \"horizon\"]\nwindow = 4\npatience = 8\n";

    /// Levels follow the configured order, one step each; quality that the order does not name is kept.
    #[test]
    fn things_are_given_up_in_the_configured_order() {
        let quality = |resolution_divisor, samples, horizon| Quality { resolution_divisor, samples, horizon };
        assert_eq!(
            overload(ALL).levels,
            [
                quality(1, 10, 2),
                quality(2, 10, 2),
                quality(4, 10, 2),
                quality(4, 5, 2),
                quality(4, 4, 2),
                quality(4, 4, 1)
            ]
        );
        assert_eq!(overload("[overload]\norder = [\"horizon\"]\n").levels, [quality(1, 10, 2), quality(1, 10, 1)]);
        assert_eq!(overload("").levels, [quality(1, 10, 2)]);
    }

    /// Late frames lower the quality level by level to the last, where it stays; calm frames restore full quality.
    #[test]
    fn late_frames_lower_it_and_calm_restores_it() {
        let mut overload = overload(ALL);
        assert_eq!(show(&mut overload, 0, 40, 130), 5, "above 0.8 x 150 ms");
        assert_eq!((overload.quality().horizon, overload.quality().samples), (1, 4));
        assert!(show(&mut overload, 40, 400, 20) >= 5);
        assert_eq!(overload.quality(), overload.levels[0]);
    }

    /// Skipped frames are a sign too, even if the others are fast; one in many is not.
    #[test]
    fn skipped_frames_lower_it() {
        let mut overload = overload(ALL);
        let mut changes = 0;
        for frame in 0..40 {
            changes += show(&mut overload, frame * 2, 1, 20);
        }
        assert_eq!(changes, 5);
        let mut calm = self::overload(ALL);
        let changes: usize = (0..10).map(|block| show(&mut calm, block * 10, 9, 20)).sum();
        assert_eq!((changes, calm.level), (0, 0));
    }

    /// After a restoration that failed at once, the next wait is longer.
    #[test]
    fn it_does_not_swing() {
        let mut overload = overload(ALL);
        show(&mut overload, 0, 4, 130);
        let mut first = 4;
        let mut waits = Vec::new();
        for _ in 0..4 {
            let mut calm = 0;
            while show(&mut overload, first + calm, 1, 20) == 0 {
                calm += 1;
            }
            waits.push(calm);
            first += calm + 1;
            show(&mut overload, first, 4, 130);
            first += 4;
        }
        assert!(waits.windows(2).all(|w| w[1] > w[0]), "{waits:?}");
    }

    /// Messages that the observer missed are not frames that the graph skipped.
    #[test]
    fn what_was_not_seen_was_not_skipped() {
        let mut overload = overload(ALL);
        for frame in 0..40 {
            let mut header = Header::of_frame(frame * 5, frame * 500 * MS, 1).at_step(2);
            header.sequence = frame * 7;
            assert!(!overload.observe(&Belief::empty(header, 2)));
        }
    }

    /// Steps of an observed frame, and older frames, count once.
    #[test]
    fn a_frame_counts_once() {
        let mut overload = overload(ALL);
        for _ in 0..2 {
            show(&mut overload, 7, 1, 130);
            show(&mut overload, 6, 1, 130);
        }
        assert_eq!(overload.level, 0);
        // A camera that restarts its count is followed.
        assert!(show(&mut overload, 0, 40, 130) > 0);
    }
}
