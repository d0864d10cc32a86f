//! The result of a soak, as figures.

use super::SoakArgs;
use super::watch::Notes;
use crate::NS_PER_S;
use carff_base::statistics::percentile;
use carff_config::Contract;
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// All counts of a soak.
#[derive(Clone, Debug, Default)]
pub(super) struct Outcome {
    pub(super) seconds: f64,
    pub(super) faults: BTreeMap<&'static str, u64>,
    /// Faults that this system does not permit.
    pub(super) not_tried: BTreeMap<&'static str, u64>,
    /// Number of killed stages.
    pub(super) kills: u64,
    /// Number of graphs stopped and started.
    pub(super) cycles: u64,
    pub(super) recoveries_ms: Vec<f64>,
    /// Longest recovery by kind of fault.
    pub(super) worst_recoveries_ms: BTreeMap<&'static str, f64>,
    /// Largest number of frames from the first bad image to the safe action, by kind of fault.
    pub(super) worst_answers_frames: BTreeMap<&'static str, u64>,
    pub(super) worst_start_ms: f64,
    pub(super) leaked_files: usize,
    pub(super) growth_percent_per_hour: Option<f64>,
    pub(super) drift_percent: Option<f64>,
    pub(super) violation: Option<String>,
    pub(super) evidence: Option<String>,
    pub(super) schedule: Vec<String>,
}

/// Resident memory over the life of each process.
#[derive(Clone, Debug, Default)]
pub(super) struct Lives {
    /// Samples (time, bytes) by process.
    lives: BTreeMap<(&'static str, u32), Vec<(u64, u64)>>,
}

impl Lives {
    pub(super) fn note(&mut self, name: &'static str, pid: u32, at_ns: u64, bytes: u64) {
        self.lives.entry((name, pid)).or_default().push((at_ns, bytes));
    }

    /// Returns the fastest growth of any process, percent an hour, with its name: from a linear fit after the warm-up.
    /// `None` if no life was long enough.
    pub(super) fn growth_percent_per_hour(&self, warm_up_s: u64, span_s: u64) -> Option<(f64, &'static str)> {
        let growths = self.lives.iter().filter_map(|((name, _), points)| {
            let first_ns = points.first()?.0;
            let points: Vec<(f64, f64)> = points
                .iter()
                .map(|&(at_ns, bytes)| ((at_ns - first_ns) as f64 / NS_PER_S as f64, bytes as f64))
                .filter(|(at_s, _)| *at_s >= warm_up_s as f64)
                .collect();
            let (first, last) = (points.first()?, points.last()?);
            if last.0 - first.0 < span_s as f64 {
                return None;
            }
            let count = points.len() as f64;
            let mean = |value: fn(&(f64, f64)) -> f64| points.iter().map(value).sum::<f64>() / count;
            let (mean_s, mean_bytes) = (mean(|p| p.0), mean(|p| p.1));
            let (mut over, mut under) = (0.0, 0.0);
            for (at_s, bytes) in &points {
                over += (at_s - mean_s) * (bytes - mean_bytes);
                under += (at_s - mean_s) * (at_s - mean_s);
            }
            Some((100.0 * 3600.0 * over / under / mean_bytes, *name))
        });
        growths.max_by(|a, b| a.0.total_cmp(&b.0))
    }
}

impl Outcome {
    /// Assigns the recoveries from number `first` to a kind of fault.
    pub(super) fn note_recoveries(&mut self, kind: &'static str, first: usize) {
        for &ms in self.recoveries_ms.iter().skip(first) {
            let worst = self.worst_recoveries_ms.entry(kind).or_default();
            *worst = worst.max(ms);
        }
    }

    /// Checks the limits that apply to the whole soak.
    pub(super) fn finish(&mut self, notes: &Notes, lives: &Lives, contract: &Contract) {
        let growth = lives.growth_percent_per_hour(contract.warm_up_s, contract.memory_span_s);
        self.growth_percent_per_hour = growth.map(|(percent, _)| percent);
        let (latency_ms, frames) = (&notes.latency_ms, contract.p99_frames);
        if latency_ms.len() >= 2 * frames && frames > 0 {
            let p99 = |values: &[f64]| percentile(values, 0.99).unwrap_or(f64::NAN);
            let (first, last) = (p99(&latency_ms[..frames]), p99(&latency_ms[latency_ms.len() - frames..]));
            self.drift_percent = Some(100.0 * (last - first) / first);
        }
        if let Some((percent, name)) = growth
            && percent > contract.memory_growth_percent_per_hour
        {
            self.violation = Some(format!("the memory of {name} grows by {percent:.2} % an hour"));
        }
        if let Some(percent) = self.drift_percent
            && percent > contract.p99_drift_percent
        {
            self.violation = Some(format!("the p99 of camera to action has grown by {percent:.1} %"));
        }
    }

    pub(super) fn json(&self, args: &SoakArgs, notes: &Notes) -> Value {
        let ms = |ns: u64| ns as f64 / 1e6;
        json!({
            "config": args.config.display().to_string(),
            "seed": args.seed,
            "minutes": self.seconds / 60.0,
            "faults": self.faults,
            "faults_total": self.faults.values().sum::<u64>(),
            "not_tried": self.not_tried,
            "kills": self.kills,
            "cycles": self.cycles,
            "violations": u32::from(self.violation.is_some()),
            "violation": self.violation,
            "evidence": self.evidence,
            "worst_recovery_ms": self.recoveries_ms.iter().copied().reduce(f64::max),
            "worst_recovery_ms_by_kind": self.worst_recoveries_ms,
            "worst_frames_to_safe_action_by_kind": self.worst_answers_frames,
            "median_recovery_ms": percentile(&self.recoveries_ms, 0.5),
            "worst_start_ms": self.worst_start_ms,
            "worst_safe_action_ms": ms(notes.judge.worst_safe_action_ns),
            "worst_action_gap_ms": ms(notes.judge.worst_gap_ns),
            "decisions_judged": notes.judge.judged,
            "decisions_not_judged": notes.judge.unjudged,
            "leaked_files": self.leaked_files,
            "rss_growth_percent_per_hour": self.growth_percent_per_hour,
            "p99_ms": percentile(&notes.latency_ms, 0.99),
            "p99_drift_percent": self.drift_percent,
            "schedule": self.schedule,
        })
    }

    pub(super) fn summary(&self) -> String {
        let verdict = match (&self.violation, &self.evidence) {
            (Some(violation), Some(evidence)) => format!("VIOLATED: {violation}\nevidence: {evidence}"),
            (Some(violation), None) => format!("VIOLATED: {violation}"),
            _ => "the contract held".to_owned(),
        };
        format!(
            "{} faults ({} kills, {} start-stop cycles) in {:.1} minutes, worst recovery {:.0} ms: {verdict}",
            self.faults.values().sum::<u64>(),
            self.kills,
            self.cycles,
            self.seconds / 60.0,
            self.recoveries_ms.iter().copied().fold(0.0, f64::max),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Growth is the slope of a linear fit after the warm-up; lives that were too short do not count.
    #[test]
    fn growth_is_fitted_after_the_warm_up() {
        let mut lives = Lives::default();
        for second in 0..4000_u64 {
            // A jump at first, then 2 % an hour of 100 MB, with a ripple.
            let bytes = 1e8 + 2e6 * (second as f64 - 2000.0) / 3600.0 + if second % 2 == 0 { 1e5 } else { -1e5 };
            let bytes = if second < 100 { 2e7 } else { bytes };
            lives.note("prober", 1, second * 1_000_000_000, bytes as u64);
        }
        lives.note("encoder", 2, 0, 1);
        let (percent, name) = lives.growth_percent_per_hour(120, 1800).unwrap();
        assert_eq!(name, "prober");
        assert!((1.9..2.1).contains(&percent), "{percent}");
        assert!(lives.growth_percent_per_hour(120, 4000).is_none());
    }

    /// Each kind of fault has the longest of its own recoveries; a kind without recoveries has none.
    #[test]
    fn recoveries_belong_to_their_kind() {
        let mut outcome = Outcome::default();
        for (kind, found) in
            [("kill", vec![200.0]), ("stop", vec![900.0, 300.0]), ("full_disk", vec![]), ("kill", vec![500.0])]
        {
            let first = outcome.recoveries_ms.len();
            outcome.recoveries_ms.extend(found);
            outcome.note_recoveries(kind, first);
        }
        assert_eq!(outcome.worst_recoveries_ms, BTreeMap::from([("kill", 500.0), ("stop", 900.0)]));
    }

    /// Quantiles are measured values; without values there is no quantile.
    #[test]
    fn quantiles_occurred() {
        let values: Vec<f64> = (1..=200).rev().map(f64::from).collect();
        assert_eq!(
            (percentile(&values, 0.5), percentile(&values, 0.99), percentile(&[], 0.5)),
            (Some(100.0), Some(198.0), None)
        );
    }
}
