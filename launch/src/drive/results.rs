//! The results of closed-loop drives.

use carff_base::statistics::{mean, percentile, wilson_interval};
use serde::Serialize;
use serde_json::{Value, json};

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

/// Returns the figures of all drives; `latencies_ns` are those of all decisions.
pub(super) fn summary(results: &[EpisodeResult], latencies_ns: &[u64]) -> Value {
    let count = |outcome: Outcome| results.iter().filter(|r| r.outcome == outcome).count();
    let is_near = |r: &&EpisodeResult| r.outcome != Outcome::Collided && r.least_gap_m.is_some_and(|gap| gap < NEAR_M);
    let times: Vec<f64> = results.iter().filter(|r| r.outcome == Outcome::Arrived).map(|r| r.time_s).collect();
    let halted: Vec<f64> = results.iter().map(|r| r.halted_s).collect();
    let latencies: Vec<f64> = latencies_ns.iter().map(|ns| *ns as f64 / 1e6).collect();
    let collisions = count(Outcome::Collided);
    let interval = (!results.is_empty()).then(|| wilson_interval(collisions, results.len()));
    json!({
        "episodes": results.len(),
        "collisions": collisions,
        "collision_share_interval": interval,
        "arrived": count(Outcome::Arrived),
        "stuck": count(Outcome::Stuck),
        "near_misses": results.iter().filter(is_near).count(),
        "time_to_goal_s": {
            "mean": mean(&times),
            "p50": percentile(&times, 0.5),
            "p95": percentile(&times, 0.95),
        },
        "halted_s": { "mean": mean(&halted) },
        "latency_ms": { "p50": percentile(&latencies, 0.5), "p99": percentile(&latencies, 0.99) },
        "frames": results.iter().map(|r| r.frames).sum::<u64>(),
        "missed_frames": results.iter().map(|r| r.missed_frames).sum::<u64>(),
    })
}

/// Returns the figures as lines of text.
pub(super) fn text(summary: &Value) -> String {
    let number = |value: &Value, digits: usize| value.as_f64().map_or("-".to_owned(), |v| format!("{v:.digits$}"));
    let [time, latency] = [&summary["time_to_goal_s"], &summary["latency_ms"]];
    format!(
        "episodes {}: {} arrived, {} collided, {} stuck, {} near misses\n\
         time to goal: mean {} s, p50 {} s, p95 {} s; at a standstill: mean {} s\n\
         camera to action: p50 {} ms, p99 {} ms; {} of {} frames without a decision",
        summary["episodes"],
        summary["arrived"],
        summary["collisions"],
        summary["stuck"],
        summary["near_misses"],
        number(&time["mean"], 2),
        number(&time["p50"], 2),
        number(&time["p95"], 2),
        number(&summary["halted_s"]["mean"], 2),
        number(&latency["p50"], 1),
        number(&latency["p99"], 1),
        summary["missed_frames"],
        summary["frames"],
    )
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
        let summary = summary(&results, &[10_000_000]);
        let counts = ["episodes", "arrived", "collisions", "stuck", "near_misses"].map(|key| summary[key].as_u64());
        assert_eq!(counts, [Some(4), Some(2), Some(1), Some(1), Some(1)]);
        assert_eq!(summary["time_to_goal_s"]["mean"], 5.0);
        assert_eq!(summary["latency_ms"]["p99"], 10.0);
        let none = super::summary(&[], &[]);
        assert!(none["time_to_goal_s"]["mean"].is_null() && none["collision_share_interval"].is_null());
    }
}
