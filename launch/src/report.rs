//! The report of a run, as JSON.

use crate::supervision::monitor::Records;
use carff_messages::Stage;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// A finished run, for the report and for callers that add tables.
#[derive(Clone, Debug, Default)]
pub struct RunOutcome {
    /// Run name.
    pub run: String,
    /// Graph file.
    pub graph: String,
    /// The run's seed.
    pub seed: u64,
    /// Folder of the dataset.
    pub dataset: std::path::PathBuf,
    /// Folder of the trained models.
    pub checkpoint: std::path::PathBuf,
    /// Records of the run.
    pub records: Records,
    /// Restarts by stage.
    pub restarts: BTreeMap<Stage, u32>,
    /// Number of invalid messages that the launcher received.
    pub invalid: u64,
}

/// Converts times in nanoseconds to p50, p99 and max in milliseconds; null if there are no times.
pub fn quantiles_ms<'a>(times_ns: impl IntoIterator<Item = &'a u64>) -> Value {
    let mut sorted: Vec<u64> = times_ns.into_iter().copied().collect();
    sorted.sort_unstable();
    // The smallest time that is at least as large as this share of all times.
    let at = |share: f64| {
        let rank = (share * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.max(1) - 1).map(|&ns| ns as f64 / 1e6)
    };
    json!({ "p50": at(0.5), "p99": at(0.99), "max": at(1.0), "count": sorted.len() })
}

/// Returns the report with `tables` added.
pub fn json(outcome: &RunOutcome, tables: Map<String, Value>) -> Value {
    let records = &outcome.records;
    let decided: Vec<u64> = records.frames.values().filter(|f| f.action.is_some()).map(|f| f.latency_ns).collect();
    let by_stage = |value: &dyn Fn(Stage) -> Option<Value>| -> Value {
        Stage::ALL.iter().filter_map(|&s| Some((s.name().to_owned(), value(s)?))).collect::<Map<_, _>>().into()
    };
    let stage = |s: Stage| records.stages.get(&s);
    let mut report = json!({
        "run": outcome.run,
        "graph": outcome.graph,
        "seed": outcome.seed,
        "frames": records.frame_count(),
        "frames_not_recorded": records.frame_count() - records.frames.len() as u64,
        "decisions": decided.len(),
        "actions": records.actions,
        "safe_actions": records.safe_actions,
        "skipped": records.skipped(),
        "skipped_by_stage": by_stage(&|s| Some(stage(s)?.skipped.into())),
        "invalid_by_stage": by_stage(&|s| Some(stage(s)?.invalid.into())),
        "errors_by_stage": by_stage(&|s| Some(stage(s)?.errors.into())),
        "given_up": records.given_up,
        "restarts": outcome.restarts.values().sum::<u32>(),
        "restarts_by_stage": by_stage(&|s| Some((*outcome.restarts.get(&s)?).into())),
        "latency_ms": {
            "camera_to_action": quantiles_ms(&decided),
            "encoder": quantiles_ms(&records.encoder_ns),
            "forecaster": quantiles_ms(&records.forecaster_ns),
            "prober": quantiles_ms(&records.prober_ns),
            "renderer": quantiles_ms(&records.renderer_ns),
        },
        "memory_mb": by_stage(&|s| Some((stage(s)?.max_rss_bytes as f64 / 1e6).into())),
    });
    if let Some(report) = report.as_object_mut() {
        report.extend(tables);
    }
    report
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Quantiles are measured times; of a hundred, p99 is the 99th and max the last; of none, they are null.
    #[test]
    fn quantiles_are_exact() {
        let times: Vec<u64> = (1..=100).rev().map(|ms| ms * 1_000_000).collect();
        assert_eq!(quantiles_ms(&times), json!({ "p50": 50.0, "p99": 99.0, "max": 100.0, "count": 100 }));
        assert_eq!(quantiles_ms(&[7_000_000])["p99"], json!(7.0));
        assert_eq!(quantiles_ms(&[])["p50"], Value::Null);
    }

    /// The report has all promised keys, also for a run without events, and tables are added at the top level.
    #[test]
    fn promised_keys_are_there() {
        let mut tables = Map::new();
        tables.insert("planning".into(), json!({ "drives": {} }));
        let report = json(&RunOutcome::default(), tables);
        for key in ["frames", "actions", "skipped", "restarts", "memory_mb", "planning"] {
            assert!(report.get(key).is_some(), "{key}");
        }
        for part in ["camera_to_action", "encoder", "forecaster", "prober", "renderer"] {
            for quantile in ["p50", "p99", "max"] {
                assert!(report["latency_ms"][part].get(quantile).is_some(), "{part}.{quantile}");
            }
        }
    }
}
