//! The soak file: the faults, their frequency, and the contract that the graph must keep.

use crate::ConfigError;
use crate::error::{Source, read};
use crate::ranges;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A soak test: a graph, the faults injected into it, and its contract.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SoakConfig {
    /// The graph file.
    pub graph: PathBuf,
    /// Relative frequency of each kind of fault, 0 to 1000. A kind that is left out never occurs.
    pub faults: Weights,
    /// The timing of the faults.
    #[serde(default)]
    pub pace: Pace,
    /// The contract of the graph.
    #[serde(default)]
    pub contract: Contract,
}

macro_rules! weights {
    ($($(#[$doc:meta])* $field:ident => $kind:ident),+ $(,)?) => {
        /// Relative frequency of each kind of fault.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        #[serde(deny_unknown_fields, default)]
        pub struct Weights { $($(#[$doc])* #[schemars(range(min = 0, max = 1000))] pub $field: u32),+ }

        /// Kinds of faults.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum FaultKind { $($(#[$doc])* $kind),+ }

        impl FaultKind {
            /// All of them.
            pub const ALL: &[Self] = &[$(Self::$kind),+];

            /// The name in soak files and reports.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$kind => stringify!($field)),+ }
            }
        }

        impl Weights {
            /// The weight of a kind.
            pub fn of(&self, kind: FaultKind) -> u32 {
                match kind { $(FaultKind::$kind => self.$field),+ }
            }
        }
    };
}

weights! {
    /// SIGKILL of a stage.
    kill => Kill,
    /// SIGSTOP of a stage or of the launcher, SIGCONT later.
    stop => Stop,
    /// A stage that gets a fraction of its time: stopped and continued in turn.
    slow => Slow,
    /// Tens of frames at once.
    burst => Burst,
    /// A frame that comes again when it is old.
    late => Late,
    /// A frame that comes twice.
    duplicate => Duplicate,
    /// Frames in the wrong order.
    reorder => Reorder,
    /// Frames that never come: the camera stands still for some.
    drop => Drop,
    /// The camera's device is gone for a while: its process is killed, and cannot start until its images are back.
    device_loss => DeviceLoss,
    /// The camera delivers nothing for a while: SIGSTOP, SIGCONT later.
    stall => Stall,
    /// Frames of other sizes in mid-stream.
    resolution => Resolution,
    /// Frames of random pixels, of the wrong length, and without pixels.
    corrupt => Corrupt,
    /// Messages with a NaN.
    nan => Nan,
    /// Messages of random bits.
    garbage => Garbage,
    /// Messages of another schema version.
    schema => Schema,
    /// Messages of another run.
    foreign_run => ForeignRun,
    /// Shared memory without a free byte, for a while.
    full_memory => FullMemory,
    /// A disk that fills under a recorder.
    full_disk => FullDisk,
    /// A camera whose images are black. This and the following kinds stop the camera and publish in its place; the safe
    /// action must come with the condition as its reason.
    black => Black,
    /// A camera whose images are white.
    white => White,
    /// A camera that repeats an image.
    frozen => Frozen,
    /// A camera with half of its lens covered.
    covered => Covered,
    /// A camera out of focus.
    unfocused => Unfocused,
    /// A camera with too little light.
    underexposed => Underexposed,
    /// A camera with too much light.
    overexposed => Overexposed,
    /// A camera whose capture times stand still.
    clock_stall => ClockStall,
    /// A camera whose clock has jumped, forward or back.
    clock_jump => ClockJump,
    /// Subscribers that come, go and are killed.
    probe_storm => ProbeStorm,
    /// The graph is interrupted and started again.
    start_stop => StartStop,
    /// SIGKILL of the launcher; the graph is started again.
    kill_launcher => KillLauncher,
    /// Weights are damaged and their stage killed; they are put right later.
    checkpoint => Checkpoint,
}

/// The timing of the faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Pace {
    /// Shortest pause between a recovery and the next fault, milliseconds, 0 to 600000. Default 300.
    #[schemars(range(min = 0, max = 600_000))]
    pub min_pause_ms: u64,
    /// Longest one. Default 1500.
    #[schemars(range(min = 0, max = 600_000))]
    pub max_pause_ms: u64,
    /// Longest time that a process is stopped or slowed, or that memory is full, milliseconds, 50 to 60000.
    /// Default 3000.
    #[schemars(range(min = 50, max = 60_000))]
    pub max_hold_ms: u64,
}

impl Default for Pace {
    fn default() -> Self {
        Self { min_pause_ms: 300, max_pause_ms: 1500, max_hold_ms: 3000 }
    }
}

/// The contract of the graph. Times in which the soak test itself had no processor do not count.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Contract {
    /// From the end of a fault until all stages are well and a decision has been made, milliseconds, 100 to 600000.
    /// Default 5000.
    #[schemars(range(min = 100, max = 600_000))]
    pub recovery_ms: u64,
    /// From an interrupt to the end of everything, milliseconds, 100 to 600000. Default 5000.
    #[schemars(range(min = 100, max = 600_000))]
    pub stop_ms: u64,
    /// From the expiry of a decision to the safe action, and beyond the period of actions, milliseconds, 1 to 60000.
    /// Default 150.
    #[schemars(range(min = 1, max = 60_000))]
    pub slack_ms: u64,
    /// Growth of a process's memory, percent an hour, over lives of at least `memory_span_s` after `warm_up_s`, 0 to
    /// 1000. Default 1.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub memory_growth_percent_per_hour: f64,
    /// Age from which on a process's memory counts, seconds, 0 to 86400. Default 120.
    #[schemars(range(min = 0, max = 86_400))]
    pub warm_up_s: u64,
    /// Shortest time over which its growth is judged, seconds, 1 to 604800. Default 1800.
    #[schemars(range(min = 1, max = 604_800))]
    pub memory_span_s: u64,
    /// The 99th percentile of the time from camera to action may grow by so much from the first to the last
    /// `p99_frames` undisturbed frames, percent, 0 to 1000. Default 20.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub p99_drift_percent: f64,
    /// Frames in each, 100 to 1000000; with fewer than twice as many, drift is not judged. Default 1000.
    #[schemars(range(min = 100, max = 1_000_000))]
    pub p99_frames: usize,
}

impl Default for Contract {
    fn default() -> Self {
        Self {
            recovery_ms: 5000,
            stop_ms: 5000,
            slack_ms: 150,
            memory_growth_percent_per_hour: 1.0,
            warm_up_s: 120,
            memory_span_s: 1800,
            p99_drift_percent: 20.0,
            p99_frames: 1000,
        }
    }
}

impl SoakConfig {
    /// Reads and checks a soak file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(&read(path, "soak")?, path)
    }

    /// The same for a text; `path` is what errors name.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let source = Source { path, text };
        let config: Self = ranges::read(&source)?;
        config.check(&source)?;
        Ok(config)
    }

    fn check(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        if FaultKind::ALL.iter().all(|&kind| self.faults.of(kind) == 0) {
            return Err(source.range("faults", "without a weight".into(), "at least one weight above 0".into()));
        }
        let Pace { min_pause_ms, max_pause_ms, .. } = self.pace;
        if max_pause_ms < min_pause_ms {
            return Err(source.range(
                "pace.max_pause_ms",
                max_pause_ms.to_string(),
                format!("{min_pause_ms} to 600000"),
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Wrong soak files are named by line and key, with what is allowed.
    #[test]
    fn wrong_files_are_refused() {
        let wrong = |text: &str| SoakConfig::parse(text, "s.toml".as_ref()).unwrap_err().to_string();
        assert!(wrong("graph = \"g\"\n[faults]\n").contains("at least one weight above 0"));
        assert!(wrong("graph = \"g\"\n[faults]\nkil = 1\n").contains("kil"));
        let late = "graph = \"g\"\n[faults]\nkill = 1\n[pace]\nmax_hold_ms = 1\n";
        assert!(wrong(late).starts_with("s.toml:5: `pace.max_hold_ms` is 1"), "{}", wrong(late));
        let unmeasurable = "graph = \"g\"\n[faults]\nkill = 1\n[contract]\np99_drift_percent = nan\n";
        assert!(wrong(unmeasurable).contains("0 to 1000"), "{}", wrong(unmeasurable));
    }
}
