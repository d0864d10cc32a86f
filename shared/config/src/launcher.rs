//! The graph file's tables for the launcher: how long it waits, and the qualities that it gives up under overload.

use crate::stages::LogFormat;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The launcher.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LauncherConfig {
    /// Threads that the machine has for encoder, forecaster, prober and renderer together, 1 to 1024; more are warned
    /// of. Default 4: the first three work on a frame one after the other, so that two cores carry all four.
    #[schemars(range(min = 1, max = 1024))]
    pub thread_budget: u32,
    /// Format of log lines: `text` or `json`. Default `text`.
    pub log_format: LogFormat,
    /// Longest time from the start of a stage until it is ready, milliseconds, 100 to 600000. Default 30000.
    #[schemars(range(min = 100, max = 600_000))]
    pub start_timeout_ms: u64,
    /// Longest time from an interrupt until a stage has ended; it is then killed. Milliseconds, 50 to 60000. Default
    /// 1000.
    #[schemars(range(min = 50, max = 60_000))]
    pub stop_timeout_ms: u64,
    /// Longest time without a heartbeat, and without progress of a stage's loop (at least ten times the stage's own
    /// deadline). A stage that exceeds it is killed and restarted. Milliseconds, 500 to 600000. Default 2000.
    #[schemars(range(min = 500, max = 600_000))]
    pub hang_timeout_ms: u64,
    /// Behaviour when a stage that decisions need is lost: `end` or `halt`. Default `end`.
    pub when_lost: WhenLost,
    /// Number of newest frames that the report covers, 100 to 10000000. Default 100000.
    #[schemars(range(min = 100, max = 10_000_000))]
    pub keep_frames: u64,
}

impl Default for LauncherConfig {
    fn default() -> Self {
        Self {
            thread_budget: 4,
            log_format: LogFormat::Text,
            start_timeout_ms: 30_000,
            stop_timeout_ms: 1000,
            hang_timeout_ms: 2000,
            when_lost: WhenLost::End,
            keep_frames: 100_000,
        }
    }
}

/// Behaviour when a stage that decisions need is lost. A lost renderer does not end a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum WhenLost {
    /// The run ends with an error; the controller's last action is the safe action.
    #[default]
    End,
    /// The controller continues with the safe action until the run is stopped, which then ends with the error. A lost
    /// controller always ends the run, since its last action expires.
    Halt,
}

/// A quality that the graph gives up under overload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Reduction {
    /// Width and height of the rendered views: halved, then quartered.
    Resolution,
    /// Latents drawn from each mixture: halved down to `min_samples`.
    Samples,
    /// Steps of the look-ahead: one fewer at a time, down to 1.
    Horizon,
}

/// The qualities that the graph gives up when the machine is too slow, in addition to skipping frames, and restores
/// when it is fast enough again. Decisions then depend on the speed of the machine; each message states its number of
/// samples and steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OverloadConfig {
    /// Order of giving up: `resolution`, `samples`, `horizon`, each at most once. Default: none, only frames are
    /// skipped.
    pub order: Vec<Reduction>,
    /// Share of `controller.deadline_ms` above which a frame's belief is a sign of overload, as a skipped frame is;
    /// 0.05 to 1. Default 0.8.
    #[schemars(range(min = 0.05, max = 1.0))]
    pub latency_share: f64,
    /// Smallest number of latents drawn, 1 to 64. Default 4.
    #[schemars(range(min = 1, max = 64))]
    pub min_samples: u32,
    /// Number of newest frames, 2 to 1000; a quality is given up when half of them show a sign of overload. Default 10.
    #[schemars(range(min = 2, max = 1000))]
    pub window: u32,
    /// Frames without a sign after which a quality is restored, 2 to 100000. The number doubles each time that the
    /// quality must be given up again at once, up to 16 times. Default 50.
    #[schemars(range(min = 2, max = 100_000))]
    pub patience: u32,
}

impl Default for OverloadConfig {
    fn default() -> Self {
        Self { order: Vec::new(), latency_share: 0.8, min_samples: 4, window: 10, patience: 50 }
    }
}
