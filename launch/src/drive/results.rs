//! The results of closed-loop drives.

use super::occupancy::StepOccupancy;
use carff::provenance::Origin;
use carff_base::statistics::{mean, percentile, wilson_interval};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;

/// Gap below which a drive without a collision is a near miss, metres.
const NEAR_M: f64 = 0.5;

/// End of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Outcome {
    /// The ego reached the end of its way.
    Arrived,
    /// The ego's box met another one.
    Collided,
    /// Time was up.
    Stuck,
}

/// Result of one drive.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct EpisodeResult {
    pub(super) episode: u64,
    pub(super) outcome: Outcome,
    /// Number of other vehicles.
    pub(super) actors: usize,
    /// Duration, seconds.
    pub(super) time_s: f64,
    /// Time at a standstill, seconds.
    pub(super) halted_s: f64,
    /// Smallest gap to another vehicle, metres; null without others.
    pub(super) least_gap_m: Option<f64>,
    /// Number of frames.
    pub(super) frames: u64,
    /// Frames without a decision, at which the ego was to halt.
    pub(super) missed_frames: u64,
}

/// Mean and quantiles of some durations; null without any.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Durations {
    mean: Option<f64>,
    p50: Option<f64>,
    p95: Option<f64>,
    p99: Option<f64>,
}

impl Durations {
    fn of(values: &[f64]) -> Self {
        let quantile = |q| percentile(values, q);
        Self { mean: mean(values), p50: quantile(0.5), p95: quantile(0.95), p99: quantile(0.99) }
    }
}

/// Figures of all drives.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct DriveFigures {
    episodes: usize,
    collisions: usize,
    /// 95 % Wilson interval of the share of collisions; null without drives.
    collision_share_interval: Option<[f64; 2]>,
    arrived: usize,
    stuck: usize,
    near_misses: usize,
    /// Durations of the drives that arrived.
    time_to_goal_s: Durations,
    /// Time at a standstill.
    halted_s: Durations,
    /// From camera to action, of every decision.
    latency_ms: Durations,
    frames: u64,
    missed_frames: u64,
}

/// Everything about the drives of one command.
#[derive(Clone, Debug, Serialize)]
pub(super) struct DriveReport {
    #[serde(flatten)]
    pub(super) figures: DriveFigures,
    pub(super) scenario: String,
    /// Name of the ego's route.
    pub(super) route: String,
    pub(super) rule: Option<String>,
    pub(super) seed: u64,
    pub(super) actors: Option<u32>,
    pub(super) frame_rate_hz: f64,
    pub(super) real_time: bool,
    pub(super) interrupted: bool,
    pub(super) origin: Origin,
    /// Calibration of the occupancy grids, by step.
    pub(super) occupancy: BTreeMap<u32, StepOccupancy>,
    pub(super) drives: Vec<EpisodeResult>,
}

impl DriveFigures {
    /// Returns the figures of all drives; `latencies_ns` are those of all decisions.
    pub(super) fn of(results: &[EpisodeResult], latencies_ns: &[u64]) -> Self {
        let count = |outcome: Outcome| results.iter().filter(|r| r.outcome == outcome).count();
        let is_near =
            |r: &&EpisodeResult| r.outcome != Outcome::Collided && r.least_gap_m.is_some_and(|gap| gap < NEAR_M);
        let arrived = results.iter().filter(|r| r.outcome == Outcome::Arrived);
        let collisions = count(Outcome::Collided);
        Self {
            episodes: results.len(),
            collisions,
            collision_share_interval: (!results.is_empty()).then(|| wilson_interval(collisions, results.len())),
            arrived: count(Outcome::Arrived),
            stuck: count(Outcome::Stuck),
            near_misses: results.iter().filter(is_near).count(),
            time_to_goal_s: Durations::of(&arrived.map(|r| r.time_s).collect::<Vec<_>>()),
            halted_s: Durations::of(&results.iter().map(|r| r.halted_s).collect::<Vec<_>>()),
            latency_ms: Durations::of(&latencies_ns.iter().map(|ns| *ns as f64 / 1e6).collect::<Vec<_>>()),
            frames: results.iter().map(|r| r.frames).sum(),
            missed_frames: results.iter().map(|r| r.missed_frames).sum(),
        }
    }
}

impl fmt::Display for DriveFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let number = |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |v| format!("{v:.digits$}"));
        let (time, latency) = (&self.time_to_goal_s, &self.latency_ms);
        writeln!(
            f,
            "episodes {}: {} arrived, {} collided, {} stuck, {} near misses",
            self.episodes, self.arrived, self.collisions, self.stuck, self.near_misses
        )?;
        writeln!(
            f,
            "time to goal: mean {} s, p50 {} s, p95 {} s; at a standstill: mean {} s",
            number(time.mean, 2),
            number(time.p50, 2),
            number(time.p95, 2),
            number(self.halted_s.mean, 2)
        )?;
        write!(
            f,
            "camera to action: p50 {} ms, p99 {} ms; {} of {} frames without a decision",
            number(latency.p50, 1),
            number(latency.p99, 1),
            self.missed_frames,
            self.frames
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each drive counts once; only arrivals have a time to the goal; nothing is a number without drives.
    #[test]
    fn drives_are_counted() {
        let result = |outcome, time_s, least_gap_m| EpisodeResult {
            episode: 0,
            outcome,
            actors: 1,
            time_s,
            halted_s: 1.0,
            least_gap_m,
            frames: 10,
            missed_frames: 0,
        };
        let results = [
            result(Outcome::Arrived, 4.0, Some(0.3)),
            result(Outcome::Arrived, 6.0, None),
            result(Outcome::Collided, 3.0, Some(-0.1)),
            result(Outcome::Stuck, 40.0, Some(7.0)),
        ];
        let figures = DriveFigures::of(&results, &[10_000_000]);
        let counts = [figures.episodes, figures.arrived, figures.collisions, figures.stuck, figures.near_misses];
        assert_eq!(counts, [4, 2, 1, 1, 1]);
        assert_eq!((figures.time_to_goal_s.mean, figures.latency_ms.p99), (Some(5.0), Some(10.0)));
        let none = DriveFigures::of(&[], &[]);
        assert_eq!((none.time_to_goal_s.mean, none.collision_share_interval), (None, None));
        assert!(none.to_string().contains("mean - s"), "{none}");
    }
}
