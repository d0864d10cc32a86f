//! Judges the resource limits of a user against the requests of a graph.

use super::size::size;
use crate::doctor::finding::{Area, Finding};
use carff_config::{StageConfig, StagesConfig};
use carff_messages::Stage;

/// Locked memory below which a stage cannot be locked.
const LOCKED_BYTES: u64 = 1 << 30;
/// Maximum number of open files of a process in a graph with all probes.
const OPEN_FILES: u64 = 1024;

/// Resource limits of a process of this user. `None`: unlimited.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Allowed {
    /// Lockable memory, bytes.
    pub locked_bytes: Option<u64>,
    /// Highest real-time priority.
    pub realtime_priority: Option<u64>,
    /// `RLIMIT_NICE`: 20 less the lowest niceness.
    pub nice: Option<u64>,
    /// Number of open files.
    pub open_files: Option<u64>,
    /// True if the user may lock unlimited memory (`CAP_IPC_LOCK`).
    pub may_lock: bool,
    /// True if the user may take any priority (`CAP_SYS_NICE`).
    pub may_schedule: bool,
}

/// Compares limits with the requests of a graph.
pub fn limits(allowed: &Allowed, stages: &StagesConfig) -> Vec<Finding> {
    let area = Area::Limits;
    let without = "the stage logs a warning, and continues without it";
    let raise = |line: &str, unit: &str| {
        format!("write `USER - {line}` to /etc/security/limits.d/carff.conf, log in again; in a systemd unit: {unit}")
    };
    let show = |limit: Option<u64>, show: &dyn Fn(u64) -> String| limit.map_or_else(|| "no limit".to_owned(), show);
    let each = || Stage::ALL.into_iter().map(|stage| (stage.name(), stages.of(stage)));
    let asking = |asks: &dyn Fn(&StageConfig) -> bool| {
        each().filter(|(_, s)| asks(s)).map(|(name, _)| name).collect::<Vec<_>>().join(", ")
    };

    let locking = asking(&|s| s.lock_memory);
    let locked = show(allowed.locked_bytes, &size);
    let may_lock = allowed.may_lock || allowed.locked_bytes.is_none_or(|bytes| bytes >= LOCKED_BYTES);
    let memlock = if locking.is_empty() || may_lock {
        let privilege = if allowed.may_lock { ", and the privilege to lock more" } else { "" };
        Finding::ok(area, "memlock", format!("{locked}{privilege}"))
    } else {
        Finding::warning(
            area,
            "memlock",
            format!("{locked}, and the graph locks the memory of: {locking}"),
            without,
            raise("memlock unlimited", "LimitMEMLOCK=infinity"),
        )
    };

    let highest = each().filter_map(|(_, s)| s.fifo_priority).max().unwrap_or(0);
    let priority = show(allowed.realtime_priority, &|p| p.to_string());
    let may_rise = allowed.may_schedule || allowed.realtime_priority.is_none_or(|p| p >= u64::from(highest));
    let rtprio = if may_rise {
        let privilege = if allowed.may_schedule { ", and the privilege to take any" } else { "" };
        Finding::ok(area, "rtprio", format!("{priority}{privilege}"))
    } else {
        Finding::warning(
            area,
            "rtprio",
            format!("{priority}, and the graph asks for {highest}"),
            without,
            raise("rtprio 99", "LimitRTPRIO=99"),
        )
    };

    let lowest = each().filter_map(|(_, s)| s.nice).min().unwrap_or(0);
    let floor = allowed.nice.map_or(-20, |limit| 20 - limit.min(40) as i64);
    let mut findings = vec![memlock, rtprio];
    if lowest < 0 {
        let found = format!("niceness down to {floor}; the graph asks for {lowest}");
        findings.push(if allowed.may_schedule || i64::from(lowest) >= floor {
            Finding::ok(area, "nice", found)
        } else {
            let (line, unit) = (format!("nice {lowest}"), format!("LimitNICE={lowest}"));
            Finding::warning(area, "nice", found, without, raise(&line, &unit))
        });
    }
    let files = show(allowed.open_files, &|n| n.to_string());
    findings.push(if allowed.open_files.is_none_or(|n| n >= OPEN_FILES) {
        Finding::ok(area, "open files", files)
    } else {
        Finding::warning(
            area,
            "open files",
            format!("{files}; {OPEN_FILES} are usual"),
            "probes and viewers may fail to attach",
            raise("nofile 4096", "LimitNOFILE=4096"),
        )
    });
    findings
}

/// Checks that the processors of the stages' affinities exist.
pub fn bound_cores(online: &[u32], stages: &StagesConfig) -> Option<Finding> {
    let missing: Vec<String> = Stage::ALL
        .into_iter()
        .flat_map(|stage| {
            let cpus = &stages.of(stage).cpus;
            cpus.iter().filter(|cpu| !online.contains(cpu)).map(move |cpu| format!("{stage}: {cpu}"))
        })
        .collect();
    (!missing.is_empty()).then(|| {
        Finding::warning(
            Area::Limits,
            "cores",
            format!("the graph binds stages to processors that do not exist ({})", missing.join(", ")),
            "the stage logs a warning, and runs on any processor",
            "change `stages.*.cpus` in the graph file",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::super::testing::{MIB, assert_level, levels};
    use super::*;
    use crate::doctor::finding::Level;

    fn with_prober(prober: StageConfig) -> StagesConfig {
        StagesConfig { prober, ..StagesConfig::default() }
    }

    /// Limits only matter if the graph needs more, and privileges lift them.
    #[test]
    fn limits_against_what_is_asked() {
        let low = Allowed {
            locked_bytes: Some(8 * MIB),
            realtime_priority: Some(0),
            nice: Some(0),
            open_files: Some(20_000),
            ..Allowed::default()
        };
        let greedy = with_prober(StageConfig {
            lock_memory: true,
            fifo_priority: Some(50),
            nice: Some(-5),
            ..StageConfig::default()
        });
        let all = |level| [("memlock", level), ("rtprio", level), ("nice", level), ("open files", Level::Ok)];
        let findings = limits(&low, &greedy);
        assert_eq!(levels(&findings), all(Level::Warning));
        assert!(findings[0].found.contains("prober") && findings[1].found.contains("50"), "{findings:?}");
        assert!(findings.iter().all(|f| f.level == Level::Ok || f.advice.contains("limits.d")), "{findings:?}");
        let modest = limits(&low, &StagesConfig::default());
        assert!(modest.iter().all(|f| f.level == Level::Ok), "{modest:?}");
        let privileged = Allowed { may_lock: true, may_schedule: true, ..low };
        assert_eq!(levels(&limits(&privileged, &greedy)), all(Level::Ok));
        let raised = Allowed { locked_bytes: None, realtime_priority: Some(99), nice: Some(25), ..low };
        assert_eq!(levels(&limits(&raised, &greedy)), all(Level::Ok));
        let few = Allowed { open_files: Some(256), ..low };
        assert_eq!(limits(&few, &StagesConfig::default()).last().map(|f| f.level), Some(Level::Warning));
    }

    /// Stages bound to missing processors are reported with their processors.
    #[test]
    fn processors_that_are_not_there() {
        let bound = with_prober(StageConfig { cpus: vec![1, 9], ..StageConfig::default() });
        assert_eq!(bound_cores(&[0, 1, 9], &bound), None);
        let finding = bound_cores(&[0, 1], &bound).unwrap();
        assert_level(&finding, Level::Warning);
        assert!(finding.found.contains("(prober: 9)"), "{finding:?}");
    }
}
