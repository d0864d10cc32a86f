//! The graph file's structures, their defaults and their ranges.

use crate::ConfigError;
use crate::error::{Source, read};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// A whole graph: what runs, on which data and models, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GraphConfig {
    /// What the run is about.
    pub run: RunConfig,
    /// How many threads each stage may use.
    #[serde(default)]
    pub threads: ThreadsConfig,
    /// How much each stage logs.
    #[serde(default)]
    pub log: LogConfig,
    /// The camera stage.
    #[serde(default)]
    pub camera: CameraConfig,
    /// The encoder stage.
    #[serde(default)]
    pub encoder: EncoderConfig,
    /// The forecaster stage.
    #[serde(default)]
    pub forecaster: ForecasterConfig,
    /// The prober stage.
    #[serde(default)]
    pub prober: ProberConfig,
    /// The renderer stage.
    #[serde(default)]
    pub renderer: RendererConfig,
    /// The controller stage.
    #[serde(default)]
    pub controller: ControllerConfig,
    /// The launcher.
    #[serde(default)]
    pub launcher: LauncherConfig,
    /// What is given up under overload.
    #[serde(default)]
    pub overload: OverloadConfig,
    /// How the system treats each stage's process.
    #[serde(default)]
    pub realtime: RealtimeConfig,
    /// The folder that relative paths fall back to.
    #[serde(skip)]
    project_root: PathBuf,
}

/// What the run is about.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Names the run's folder and shared memory: 1 to 24 characters out of a-z, A-Z, 0-9, `-` and `_`.
    pub name: String,
    /// Seed of everything that is drawn. Default 1.
    #[serde(default = "one")]
    pub seed: u64,
    /// Folder of the data set.
    pub dataset: PathBuf,
    /// Name of a file in `configs/scenarios`: rendered into `dataset` when that folder is missing. Default: none.
    #[serde(default)]
    pub scenario: Option<String>,
    /// Folder of the trained models.
    pub checkpoint: PathBuf,
    /// Steps that each frame is looked ahead, 1 to 8. Default 2.
    #[serde(default = "two")]
    pub horizon: u32,
    /// Latents drawn from each mixture, 1 to 64. Default 10.
    #[serde(default = "ten")]
    pub samples: u32,
    /// How they are drawn: `stratified` over the components, or `independent`. Default `stratified`.
    #[serde(default)]
    pub sampling: Sampling,
    /// Camera frames a second, 0.1 to 1000. Default 10.
    #[serde(default = "ten_f64")]
    pub frame_rate_hz: f64,
    /// Spin in place of sleeping while waiting: quicker by some 20 to 60 us, at a whole core per stage.
    /// Default false.
    #[serde(default)]
    pub busy_polling: bool,
}

/// How latents are drawn from a mixture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// As many from each component as its weight says, rounded as in systematic resampling.
    #[default]
    Stratified,
    /// Each from a component chosen by chance.
    Independent,
}

/// Threads that each stage may use, 1 to 256 each. Their sum should not be above `total`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ThreadsConfig {
    /// The machine's budget. Default 4: encoder, forecaster and prober take turns on a frame, so that with one thread
    /// each, two cores carry them and the renderer.
    pub total: u32,
    /// Encoder. Default 1.
    pub encoder: u32,
    /// Forecaster. Default 1.
    pub forecaster: u32,
    /// Prober. Default 1.
    pub prober: u32,
    /// Renderer. Default 1.
    pub renderer: u32,
}

impl Default for ThreadsConfig {
    fn default() -> Self {
        Self { total: 4, encoder: 1, forecaster: 1, prober: 1, renderer: 1 }
    }
}

/// How much a stage logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LogLevel {
    /// What stops a stage.
    Error,
    /// What is wrong but goes on.
    Warn,
    /// Starts, stops, what was loaded.
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

/// How the lines of the log look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LogFormat {
    /// `[stage] LEVEL message field=value`.
    #[default]
    Text,
    /// A JSON object a line, with `time` (RFC 3339, UTC), `source` (the stage, or `launcher`), `level`, `message` and the
    /// fields.
    Json,
}

/// Log level of each stage: `error`, `warn`, `info`, `debug` or `trace`. Default `info`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// How the lines look: `text` or `json`. Default `text`.
    pub format: LogFormat,
    /// Camera.
    pub camera: LogLevel,
    /// Encoder.
    pub encoder: LogLevel,
    /// Forecaster.
    pub forecaster: LogLevel,
    /// Prober.
    pub prober: LogLevel,
    /// Renderer.
    pub renderer: LogLevel,
    /// Controller.
    pub controller: LogLevel,
}

/// Where pictures come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CameraSource {
    /// Drives through a data set.
    #[default]
    Drives,
    /// Drives through the scenario itself (`run.scenario`), rendered as they go: the ego moves, and no pose is one of a
    /// data set.
    FreeDrives,
    /// The pictures of a folder, in the order of their names.
    Folder,
}

/// Which poses drives are taken from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PoseChoice {
    /// Poses that were trained on and chose no threshold.
    #[default]
    Trained,
    /// Poses that were never trained on.
    Unseen,
}

/// The noise of the camera's sensor. All zero: pictures pass unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NoiseConfig {
    /// Read noise of each pixel and channel, standard deviation in units of 1/255, 0 to 64. Default 2.
    pub sigma: f32,
    /// Relative error of a frame's exposure, standard deviation, 0 to 0.5. Default 0.02.
    pub gain_sigma: f32,
    /// Relative error of each channel's gain, standard deviation, 0 to 0.5. Default 0.01.
    pub channel_gain_sigma: f32,
    /// Offset of each channel, standard deviation in units of 1/255, 0 to 64. Default 1.
    pub channel_offset_sigma: f32,
}

impl Default for NoiseConfig {
    fn default() -> Self {
        Self { sigma: 2.0, gain_sigma: 0.02, channel_gain_sigma: 0.01, channel_offset_sigma: 1.0 }
    }
}

/// The camera stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CameraConfig {
    /// `drives` through the data set, `free-drives` through the scenario, or the pictures of a `folder`. Default
    /// `drives`.
    pub source: CameraSource,
    /// The folder, when `source` is `folder`. Default: the data set's `images`.
    pub folder: Option<PathBuf>,
    /// Drives, half of them with the hazard, 1 to 100000. Default 60.
    pub drives: u32,
    /// Frames that each timestamp of a drive is shown for, 1 to 1000. Default 6.
    pub frames_per_timestamp: u32,
    /// The sensor's noise, drawn anew for each frame.
    pub noise: NoiseConfig,
    /// Which poses `drives` are taken from: `trained` (the paper's setting) or `unseen`. Default `trained`.
    pub poses: PoseChoice,
    /// Seed of the split into trained and unseen poses, in place of the checkpoint's. Default: none.
    pub split_seed: Option<u64>,
    /// Begin again at the end, for ever; free drives never repeat, they just go on. Default false.
    pub repeat: bool,
    /// Time to stay after the last frame, so that it can be worked on, milliseconds, 0 to 60000. Default 500.
    pub linger_ms: u64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            source: CameraSource::Drives,
            folder: None,
            drives: 60,
            frames_per_timestamp: 6,
            noise: NoiseConfig::default(),
            poses: PoseChoice::Trained,
            split_seed: None,
            repeat: false,
            linger_ms: 500,
        }
    }
}

/// The encoder stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderConfig {
    /// It calls itself slow when a frame takes longer, milliseconds, 1 to 60000. Default 60.
    pub deadline_ms: u64,
}

impl Default for EncoderConfig {
    fn default() -> Self {
        Self { deadline_ms: 60 }
    }
}

/// The forecaster stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ForecasterConfig {
    /// It calls itself slow when a step takes longer, milliseconds, 1 to 60000. Default 20.
    pub deadline_ms: u64,
}

impl Default for ForecasterConfig {
    fn default() -> Self {
        Self { deadline_ms: 20 }
    }
}

/// The prober stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ProberConfig {
    /// It calls itself slow when a step takes longer, milliseconds, 1 to 60000. Default 30.
    pub deadline_ms: u64,
}

impl Default for ProberConfig {
    fn default() -> Self {
        Self { deadline_ms: 30 }
    }
}

/// A camera of the renderer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ViewChoice {
    /// Straight from above.
    BirdsEye,
    /// One free camera.
    Free,
}

/// The renderer stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RendererConfig {
    /// Width of a view, pixels, 16 to 1024. Default 64.
    pub width_px: u32,
    /// Height of a view, pixels, 16 to 1024. Default 64.
    pub height_px: u32,
    /// Cameras for each hypothesis: `birds-eye`, `free`, or both. Default both.
    pub views: Vec<ViewChoice>,
    /// Most hypotheses rendered, 1 to 64, the most probable first. Default 2.
    pub hypotheses: u32,
    /// Views a second at most, 0.1 to 100. Default 2.
    pub max_rate_hz: f64,
    /// How far it gives way to the decision path, as in `nice`, 0 to 19. Default 19.
    pub nice: u32,
    /// It calls itself slow when a view takes longer, milliseconds, 1 to 60000. Default 2000.
    pub deadline_ms: u64,
}

impl Default for RendererConfig {
    fn default() -> Self {
        Self {
            width_px: 64,
            height_px: 64,
            views: vec![ViewChoice::BirdsEye, ViewChoice::Free],
            hypotheses: 2,
            max_rate_hz: 2.0,
            nice: 19,
            deadline_ms: 2000,
        }
    }
}

/// A decision rule.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// Halt when the hazard probability is above the checkpoint's calibrated threshold.
    #[default]
    Calibrated,
    /// Halt when the samples disagree or any shows the actor.
    Paper,
    /// Always halt.
    Underconfident,
    /// Always advance.
    Overconfident,
}

/// The controller stage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ControllerConfig {
    /// `calibrated`, `paper`, `underconfident` or `overconfident`. Default `calibrated`.
    pub rule: Rule,
    /// Actions a second besides those that a belief brings at once, 1 to 1000. Default 20.
    pub rate_hz: f64,
    /// A belief older than this (since capture) is not acted on, and after this time without a new one the car halts.
    /// Milliseconds, 1 to 60000. Default 150.
    pub deadline_ms: u64,
    /// Halt from this hazard probability on, 0 to 1, in place of the checkpoint's calibrated threshold. Default: none.
    pub threshold: Option<f64>,
}

impl Default for ControllerConfig {
    fn default() -> Self {
        Self { rule: Rule::Calibrated, rate_hz: 20.0, deadline_ms: 150, threshold: None }
    }
}

/// What happens when a stage dies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case", rename_all_fields = "snake_case", deny_unknown_fields)]
pub enum RestartPolicy {
    /// The run ends with an error.
    Never,
    /// It is started again.
    OnFailure {
        /// Pause before the first restart, milliseconds, 0 to 60000; it doubles with each further one, up to 16 times.
        backoff_ms: u64,
        /// Restarts within `within_s` before it counts as lost, 1 to 1000.
        max_restarts: u32,
        /// How long a restart counts, seconds, 1 to 86400. Default 60.
        #[serde(default = "sixty")]
        within_s: u64,
    },
}

const FEW_RESTARTS: RestartPolicy = RestartPolicy::OnFailure { backoff_ms: 100, max_restarts: 5, within_s: 60 };

/// Restart policy of each stage: `"never"`, or `{ on-failure = { backoff_ms = 100, max_restarts = 5, within_s = 60 } }`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RestartConfig {
    /// Camera. Default on-failure, 100 ms, 5; it goes on with the frame after its last one.
    pub camera: RestartPolicy,
    /// Encoder. Default on-failure, 100 ms, 5.
    pub encoder: RestartPolicy,
    /// Forecaster. Default on-failure, 100 ms, 5.
    pub forecaster: RestartPolicy,
    /// Prober. Default on-failure, 100 ms, 5.
    pub prober: RestartPolicy,
    /// Renderer. Default on-failure, 100 ms, 5.
    pub renderer: RestartPolicy,
    /// Controller. Default on-failure, 100 ms, 5.
    pub controller: RestartPolicy,
}

impl Default for RestartConfig {
    fn default() -> Self {
        Self {
            camera: FEW_RESTARTS,
            encoder: FEW_RESTARTS,
            forecaster: FEW_RESTARTS,
            prober: FEW_RESTARTS,
            renderer: FEW_RESTARTS,
            controller: FEW_RESTARTS,
        }
    }
}

/// The launcher.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LauncherConfig {
    /// Longest time that a stage may take to be ready, milliseconds, 100 to 600000. Default 30000.
    pub start_timeout_ms: u64,
    /// Time that a stage has to end before it is killed, milliseconds, 50 to 60000. Default 1000.
    pub stop_timeout_ms: u64,
    /// A stage without a heartbeat for this long, or whose loop stands still for this long (and for ten times its own
    /// deadline), hangs: it is killed and started again. Milliseconds, 500 to 600000. Default 2000.
    pub hang_timeout_ms: u64,
    /// What happens when a stage that decisions need is lost. Default `end`.
    pub when_lost: WhenLost,
    /// Frames that the launcher remembers for the report, the newest, 100 to 10000000. Default 100000.
    pub keep_frames: u64,
    /// What happens when a stage dies.
    pub restart: RestartConfig,
}

impl Default for LauncherConfig {
    fn default() -> Self {
        Self {
            start_timeout_ms: 30_000,
            stop_timeout_ms: 1000,
            hang_timeout_ms: 2000,
            when_lost: WhenLost::End,
            keep_frames: 100_000,
            restart: RestartConfig::default(),
        }
    }
}

/// What happens when a stage that decisions need is lost. A lost renderer ends nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum WhenLost {
    /// The run ends with an error; the controller's last action is the safe one.
    #[default]
    End,
    /// The controller goes on with the safe action until somebody stops the run, which then ends with the error. A lost
    /// controller ends the run in any case: its last action expires.
    Halt,
}

/// Something that can be given up under overload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Quality {
    /// Width and height of the rendered views: halved, then quartered.
    Resolution,
    /// Latents drawn from each mixture: halved down to `min_samples`.
    Samples,
    /// Steps looked ahead: one fewer at a time, down to 1.
    Horizon,
}

/// What is given up when the machine cannot keep up, beyond frames that are skipped, and got back when there is room.
/// Decisions then depend on the machine's pace; each message says how many samples and steps it rests on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OverloadConfig {
    /// In which order: of `resolution`, `samples`, `horizon`, each at most once. Default none: only frames are skipped.
    pub order: Vec<Quality>,
    /// A frame whose belief took longer than this share of `controller.deadline_ms`, or that came after a skipped one,
    /// is a sign of overload; 0.05 to 1. Default 0.8.
    pub latency_share: f64,
    /// Fewest latents drawn, 1 to 64. Default 4.
    pub min_samples: u32,
    /// Frames that are looked at before something is given up, 2 to 1000: half of them with a sign. Default 10.
    pub window: u32,
    /// Frames without a sign before something is got back, 2 to 100000. Twice as many after each time that it had to be
    /// given up again at once, up to 16 times. Default 50.
    pub patience: u32,
}

impl Default for OverloadConfig {
    fn default() -> Self {
        Self { order: Vec::new(), latency_share: 0.8, min_samples: 4, window: 10, patience: 50 }
    }
}

/// How the system treats one process. What it refuses is a warning, and the stage goes on without.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StageRealtime {
    /// Processors that it may run on, by number from 0. Default: all.
    pub cpus: Vec<u32>,
    /// Niceness, -20 to 19; below 0 needs a privilege. Default: as inherited.
    pub nice: Option<i32>,
    /// Priority under `SCHED_FIFO`, 1 to 99; needs a privilege. Default: the ordinary scheduler.
    pub fifo_priority: Option<u32>,
    /// Keep all its memory resident (`mlockall`), once its models are loaded; needs a privilege or a high limit.
    /// Default false.
    pub lock_memory: bool,
    /// Heap that is touched before the first frame, so that no page fault comes later, MiB, 0 to 4096. Default 0.
    pub prefault_mb: u32,
}

/// How the system treats each stage's process.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RealtimeConfig {
    /// Camera.
    pub camera: StageRealtime,
    /// Encoder.
    pub encoder: StageRealtime,
    /// Forecaster.
    pub forecaster: StageRealtime,
    /// Prober.
    pub prober: StageRealtime,
    /// Renderer; `renderer.nice` is added to this one's.
    pub renderer: StageRealtime,
    /// Controller.
    pub controller: StageRealtime,
}

fn one() -> u64 {
    1
}
fn two() -> u32 {
    2
}
fn sixty() -> u64 {
    60
}
fn ten() -> u32 {
    10
}
fn ten_f64() -> f64 {
    10.0
}

impl GraphConfig {
    /// Reads and checks a graph file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(&read(path, "graph")?, path)
    }

    /// The same for a text; `path` is what errors name, and where relative paths are looked for.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let source = Source { path, text };
        let mut graph: Self = toml::from_str(text).map_err(|e| source.syntax(&e))?;
        graph.check(&source)?;
        let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        graph.project_root = absolute
            .ancestors()
            .skip(1)
            .find(|folder| folder.join("configs").is_dir())
            .or(absolute.parent())
            .map(Path::to_owned)
            .unwrap_or_default();
        Ok(graph)
    }

    /// Where a path of this file lies: absolute as it is; relative in the current directory if it exists there,
    /// else in the root of the project.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        if path.is_absolute() || path.exists() { path.to_owned() } else { self.project_root.join(path) }
    }

    /// The scenario file that renders the data set, where one is named.
    pub fn scenario_path(&self) -> Option<PathBuf> {
        let name = self.run.scenario.as_ref()?;
        Some(self.resolve(&Path::new("configs/scenarios").join(format!("{name}.toml"))))
    }

    /// What is allowed but looks wrong, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let threads = &self.threads;
        let sum = threads.encoder + threads.forecaster + threads.prober + threads.renderer;
        let mut warnings = Vec::new();
        if sum > threads.total {
            warnings
                .push(format!("the stages' threads add up to {sum}, more than `threads.total` = {}", threads.total));
        }
        let frame_ms = 1000.0 / self.run.frame_rate_hz;
        if self.controller.deadline_ms as f64 <= frame_ms {
            warnings.push(format!(
                "`controller.deadline_ms` = {} is not above the {frame_ms:.0} ms between two frames: every action will \
                 end in the safe one",
                self.controller.deadline_ms
            ));
        }
        warnings
    }

    fn check(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        fn within<T: PartialOrd + Display + Copy>(
            source: &Source<'_>,
            key: &str,
            value: T,
            range: RangeInclusive<T>,
        ) -> Result<(), ConfigError> {
            if range.contains(&value) {
                return Ok(());
            }
            Err(source.range(key, value.to_string(), format!("{} to {}", range.start(), range.end())))
        }
        let run = &self.run;
        let plain = |b: u8| b.is_ascii_alphanumeric() || b == b'-' || b == b'_';
        if !(1..=24).contains(&run.name.len()) || !run.name.bytes().all(plain) {
            let allowed = "1 to 24 characters out of a-z, A-Z, 0-9, `-` and `_`".to_owned();
            return Err(source.range("run.name", format!("\"{}\"", run.name), allowed));
        }
        within(source, "run.horizon", run.horizon, 1..=8)?;
        within(source, "run.samples", run.samples, 1..=64)?;
        within(source, "run.frame_rate_hz", run.frame_rate_hz, 0.1..=1000.0)?;
        let threads = &self.threads;
        within(source, "threads.total", threads.total, 1..=1024)?;
        within(source, "threads.encoder", threads.encoder, 1..=256)?;
        within(source, "threads.forecaster", threads.forecaster, 1..=256)?;
        within(source, "threads.prober", threads.prober, 1..=256)?;
        within(source, "threads.renderer", threads.renderer, 1..=256)?;
        let camera = &self.camera;
        within(source, "camera.drives", camera.drives, 1..=100_000)?;
        if camera.source == CameraSource::FreeDrives && run.scenario.is_none() {
            let allowed = "`free-drives` where `run.scenario` says what to render".to_owned();
            return Err(source.range("camera.source", "\"free-drives\"".to_owned(), allowed));
        }
        within(source, "camera.frames_per_timestamp", camera.frames_per_timestamp, 1..=1000)?;
        within(source, "camera.noise.sigma", camera.noise.sigma, 0.0..=64.0)?;
        within(source, "camera.noise.gain_sigma", camera.noise.gain_sigma, 0.0..=0.5)?;
        within(source, "camera.noise.channel_gain_sigma", camera.noise.channel_gain_sigma, 0.0..=0.5)?;
        within(source, "camera.noise.channel_offset_sigma", camera.noise.channel_offset_sigma, 0.0..=64.0)?;
        within(source, "camera.linger_ms", camera.linger_ms, 0..=60_000)?;
        within(source, "encoder.deadline_ms", self.encoder.deadline_ms, 1..=60_000)?;
        within(source, "forecaster.deadline_ms", self.forecaster.deadline_ms, 1..=60_000)?;
        within(source, "prober.deadline_ms", self.prober.deadline_ms, 1..=60_000)?;
        let renderer = &self.renderer;
        within(source, "renderer.width_px", renderer.width_px, 16..=1024)?;
        within(source, "renderer.height_px", renderer.height_px, 16..=1024)?;
        within(source, "renderer.hypotheses", renderer.hypotheses, 1..=64)?;
        within(source, "renderer.max_rate_hz", renderer.max_rate_hz, 0.1..=100.0)?;
        within(source, "renderer.nice", renderer.nice, 0..=19)?;
        within(source, "renderer.deadline_ms", renderer.deadline_ms, 1..=60_000)?;
        if renderer.views.is_empty() {
            let allowed = "`birds-eye`, `free`, or both".to_owned();
            return Err(source.range("renderer.views", "[]".to_owned(), allowed));
        }
        let controller = &self.controller;
        within(source, "controller.rate_hz", controller.rate_hz, 1.0..=1000.0)?;
        within(source, "controller.deadline_ms", controller.deadline_ms, 1..=60_000)?;
        if let Some(threshold) = controller.threshold {
            within(source, "controller.threshold", threshold, 0.0..=1.0)?;
        }
        let launcher = &self.launcher;
        within(source, "launcher.start_timeout_ms", launcher.start_timeout_ms, 100..=600_000)?;
        within(source, "launcher.stop_timeout_ms", launcher.stop_timeout_ms, 50..=60_000)?;
        within(source, "launcher.hang_timeout_ms", launcher.hang_timeout_ms, 500..=600_000)?;
        within(source, "launcher.keep_frames", launcher.keep_frames, 100..=10_000_000)?;
        let overload = &self.overload;
        within(source, "overload.latency_share", overload.latency_share, 0.05..=1.0)?;
        within(source, "overload.min_samples", overload.min_samples, 1..=64)?;
        within(source, "overload.window", overload.window, 2..=1000)?;
        within(source, "overload.patience", overload.patience, 2..=100_000)?;
        if (1..overload.order.len()).any(|i| overload.order[..i].contains(&overload.order[i])) {
            let allowed = "`resolution`, `samples`, `horizon`, each at most once".to_owned();
            return Err(source.range("overload.order", format!("{:?}", overload.order), allowed));
        }
        let realtime = &self.realtime;
        for (stage, settings) in [
            ("camera", &realtime.camera),
            ("encoder", &realtime.encoder),
            ("forecaster", &realtime.forecaster),
            ("prober", &realtime.prober),
            ("renderer", &realtime.renderer),
            ("controller", &realtime.controller),
        ] {
            let key = |name: &str| format!("realtime.{stage}.{name}");
            for &cpu in &settings.cpus {
                within(source, &key("cpus"), cpu, 0..=1023)?;
            }
            if let Some(nice) = settings.nice {
                within(source, &key("nice"), nice, -20..=19)?;
            }
            if let Some(priority) = settings.fifo_priority {
                within(source, &key("fifo_priority"), priority, 1..=99)?;
            }
            within(source, &key("prefault_mb"), settings.prefault_mb, 0..=4096)?;
        }
        let restart = &launcher.restart;
        for (stage, policy) in [
            ("camera", restart.camera),
            ("encoder", restart.encoder),
            ("forecaster", restart.forecaster),
            ("prober", restart.prober),
            ("renderer", restart.renderer),
            ("controller", restart.controller),
        ] {
            if let RestartPolicy::OnFailure { backoff_ms, max_restarts, within_s } = policy {
                let key = |name: &str| format!("launcher.restart.{stage}.on-failure.{name}");
                within(source, &key("backoff_ms"), backoff_ms, 0..=60_000)?;
                within(source, &key("max_restarts"), max_restarts, 1..=1000)?;
                within(source, &key("within_s"), within_s, 1..=86_400)?;
            }
        }
        Ok(())
    }
}
