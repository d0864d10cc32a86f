//! The table that each stage has: how its process runs.

use crate::ConfigError;
use crate::error::Source;
use carff_messages::Stage;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The processes of the graph, one table a stage.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StagesConfig {
    /// Camera. A restarted camera continues after its last frame.
    pub camera: StageConfig,
    /// Encoder.
    pub encoder: StageConfig,
    /// Forecaster.
    pub forecaster: StageConfig,
    /// Prober.
    pub prober: StageConfig,
    /// Renderer.
    pub renderer: StageConfig,
    /// Controller.
    pub controller: StageConfig,
}

/// The process of one stage: its threads, its deadline, and its place on the machine. The stage warns of a setting that
/// the system refuses, and continues without it.
///
/// ```
/// use carff_config::{GraphConfig, RestartPolicy};
/// use carff_messages::Stage;
/// let run = "[run]\nname = \"x\"\ndataset = \"d\"\ncheckpoint = \"c\"\n";
/// let stages = "[stages.encoder]\nthreads = 2\nrestart = \"never\"\n";
/// let graph = GraphConfig::parse(&format!("{run}{stages}"), "x.toml".as_ref())?;
/// assert_eq!(graph.stage(Stage::Encoder).threads, 2);
/// assert_eq!(graph.stage(Stage::Encoder).restart, RestartPolicy::Never);
/// # Ok::<(), carff_config::ConfigError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StageConfig {
    /// Threads that compute, 1 to 256. The controller only uses one. Default 1.
    #[schemars(range(min = 1, max = 256))]
    pub threads: u32,
    /// Library that computes the encoder's network: `onnx` (ONNX Runtime) or `tch` (libtorch; the program
    /// `carff-encoder-tch`). Only the encoder has it. Default `onnx`.
    pub backend: Option<Backend>,
    /// Time for one output above which the stage reports that it is slow, milliseconds, 1 to 60000. Default: encoder
    /// 60, forecaster 20, prober 30, renderer 2000; camera one period of `run.frame_rate_hz`, controller
    /// `controller.deadline_ms`.
    #[schemars(range(min = 1, max = 60_000))]
    pub deadline_ms: Option<u64>,
    /// Log level: `error`, `warn`, `info`, `debug` or `trace`. Default `info`.
    pub log: LogLevel,
    /// Restart policy: `"never"`, or `{ on-failure = { backoff_ms = 100, max_restarts = 5, within_s = 60 } }`, which is
    /// the default.
    pub restart: RestartPolicy,
    /// Processors that the stage may run on, by number from 0 to 1023. Default: all.
    #[schemars(inner(range(min = 0, max = 1023)))]
    pub cpus: Vec<u32>,
    /// Niceness, -20 to 19; a value below 0 needs a privilege. Default: renderer 19, the others as inherited.
    #[schemars(range(min = -20, max = 19))]
    pub nice: Option<i32>,
    /// Priority under `SCHED_FIFO`, 1 to 99; needs a privilege. Default: the ordinary scheduler.
    #[schemars(range(min = 1, max = 99))]
    pub fifo_priority: Option<u32>,
    /// Keeps all memory resident (`mlockall`) once the models are loaded; needs a privilege or a high limit. Default
    /// false.
    pub lock_memory: bool,
    /// Heap that is touched before the first frame, so that no page fault comes later, MiB, 0 to 4096. Default 0.
    #[schemars(range(min = 0, max = 4096))]
    pub prefault_mb: u32,
}

impl Default for StageConfig {
    fn default() -> Self {
        Self {
            threads: 1,
            backend: None,
            deadline_ms: None,
            log: LogLevel::Info,
            restart: RestartPolicy::OnFailure { backoff_ms: 100, max_restarts: 5, within_s: 60 },
            cpus: Vec::new(),
            nice: None,
            fifo_priority: None,
            lock_memory: false,
            prefault_mb: 0,
        }
    }
}

impl StagesConfig {
    /// The table of a stage.
    pub fn of(&self, stage: Stage) -> &StageConfig {
        match stage {
            Stage::Camera => &self.camera,
            Stage::Encoder => &self.encoder,
            Stage::Forecaster => &self.forecaster,
            Stage::Prober => &self.prober,
            Stage::Renderer => &self.renderer,
            Stage::Controller => &self.controller,
        }
    }

    /// The library that computes the encoder's network.
    pub fn encoder_backend(&self) -> Backend {
        self.encoder.backend.unwrap_or_default()
    }

    /// The name of a stage's program.
    pub fn program(&self, stage: Stage) -> String {
        match (stage, self.encoder_backend()) {
            (Stage::Encoder, Backend::Tch) => "carff-encoder-tch".to_owned(),
            _ => format!("carff-{stage}"),
        }
    }

    /// Checks the settings that not every stage has.
    pub(crate) fn check(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        if self.controller.threads != 1 {
            return Err(source.range("stages.controller.threads", self.controller.threads.to_string(), "1".to_owned()));
        }
        let other = Stage::ALL.into_iter().find(|&s| s != Stage::Encoder && self.of(s).backend.is_some());
        other.map_or(Ok(()), |stage| {
            let found = self.of(stage).backend.unwrap_or_default().name().to_owned();
            Err(source.range(
                &format!("stages.{stage}.backend"),
                found,
                "only `stages.encoder` has a backend".to_owned(),
            ))
        })
    }

    /// The table of a stage, to be changed.
    pub fn of_mut(&mut self, stage: Stage) -> &mut StageConfig {
        match stage {
            Stage::Camera => &mut self.camera,
            Stage::Encoder => &mut self.encoder,
            Stage::Forecaster => &mut self.forecaster,
            Stage::Prober => &mut self.prober,
            Stage::Renderer => &mut self.renderer,
            Stage::Controller => &mut self.controller,
        }
    }
}

/// A library that computes networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Backend {
    /// ONNX Runtime.
    #[default]
    Onnx,
    /// libtorch.
    Tch,
}

impl Backend {
    /// Returns the name in the graph file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Onnx => "onnx",
            Self::Tch => "tch",
        }
    }
}

/// The launcher's answer to a stage that dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case", rename_all_fields = "snake_case", deny_unknown_fields)]
pub enum RestartPolicy {
    /// The run ends with an error.
    Never,
    /// The launcher starts the stage again.
    OnFailure {
        /// Pause before the first restart, milliseconds, 0 to 60000. It doubles with each further restart, up to 16
        /// times.
        #[schemars(range(min = 0, max = 60_000))]
        backoff_ms: u64,
        /// Restarts within `within_s` after which the stage counts as lost, 1 to 1000.
        #[schemars(range(min = 1, max = 1000))]
        max_restarts: u32,
        /// Time for which a restart counts, seconds, 1 to 86400. Default 60.
        #[schemars(range(min = 1, max = 86_400))]
        #[serde(default = "sixty")]
        within_s: u64,
    },
}

/// The least severe level that a stage logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LogLevel {
    /// Errors that stop a stage.
    Error,
    /// Problems after which the stage continues.
    Warn,
    /// Start, stop, and loaded files.
    #[default]
    Info,
    /// Decisions of the stage.
    Debug,
    /// Each frame.
    Trace,
}

impl LogLevel {
    /// The name, as `tracing` filters know it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
            Self::Debug => "debug",
            Self::Trace => "trace",
        }
    }
}

/// The format of log lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LogFormat {
    /// `[stage] LEVEL message field=value`.
    #[default]
    Text,
    /// One JSON object a line, with `time` (RFC 3339, UTC), `source` (the stage, or `launcher`), `level`, `message` and
    /// the fields.
    Json,
}

fn sixty() -> u64 {
    60
}
