//! The graph file: its tables, their defaults, and the rules that hold between them.
//!
//! The doc of each field is the user's doc. A range is written once, as a `schemars` attribute: the JSON Schema shows
//! it, and reading a file checks it.

use crate::ConfigError;
use crate::camera::{CalibrationChoice, CameraConfig, CameraSource};
use crate::error::{Source, read};
use crate::launcher::{LauncherConfig, OverloadConfig};
use crate::ranges;
use crate::stages::{StageConfig, StagesConfig};
use carff_dataset::{CalibrationError, CameraCalibration};
use carff_decision::{Approach, Feedback, Sampling, Speeds, StepLength};
use carff_messages::{Rule, Stage};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A whole graph: its stages, their data and models, and their settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GraphConfig {
    /// The subject of the run and the size of its belief.
    pub run: RunConfig,
    /// The process of each stage: threads, deadline, log level, restart policy, scheduling.
    #[serde(default)]
    pub stages: StagesConfig,
    /// The images that the camera stage publishes.
    #[serde(default)]
    pub camera: CameraConfig,
    /// The checks of images against what the model knows.
    #[serde(default)]
    pub checks: ChecksConfig,
    /// The views that the renderer stage publishes.
    #[serde(default)]
    pub renderer: RendererConfig,
    /// The decisions of the controller stage.
    #[serde(default)]
    pub controller: ControllerConfig,
    /// The launcher.
    #[serde(default)]
    pub launcher: LauncherConfig,
    /// The qualities that the graph gives up under overload.
    #[serde(default)]
    pub overload: OverloadConfig,
    /// The folder that relative paths fall back to.
    #[serde(skip)]
    project_root: PathBuf,
}

/// The subject of the run and the size of its belief.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Name of the run's folder and shared memory: 1 to 24 characters out of a-z, A-Z, 0-9, `-` and `_`.
    pub name: String,
    /// Seed of all random draws. Default 1.
    #[serde(default = "one")]
    pub seed: u64,
    /// Folder of the dataset.
    pub dataset: PathBuf,
    /// Name of a file in `configs/scenarios`. The launcher renders it into `dataset` when that folder is missing.
    /// Default: none.
    #[serde(default)]
    pub scenario: Option<String>,
    /// Folder of the trained models.
    pub checkpoint: PathBuf,
    /// Steps of the look-ahead, 1 to 8. Default 2.
    #[schemars(range(min = 1, max = 8))]
    #[serde(default = "two")]
    pub horizon: u32,
    /// Latents drawn from each mixture, 1 to 64. Default 10.
    #[schemars(range(min = 1, max = 64))]
    #[serde(default = "ten")]
    pub samples: u32,
    /// Sampling of the mixture: `stratified` over the components, or `independent`. Default `stratified`.
    #[serde(default)]
    pub sampling: Sampling,
    /// Input of each further step of the look-ahead: `state`, the stored posterior of the most probable known state, or
    /// `latent`, each probed sample itself. Default `state`.
    #[serde(default)]
    pub feedback: Feedback,
    /// Memory of earlier frames: `filter` carries the belief from frame to frame, where the checkpoint has learned it
    /// (`carff checkpoint memory`); with `none`, each image counts by itself. Default `none`.
    #[serde(default)]
    pub memory: MemoryKind,
    /// Camera frames per second, 0.1 to 1000. Default 10.
    #[schemars(range(min = 0.1, max = 1000.0))]
    #[serde(default = "ten_f64")]
    pub frame_rate_hz: f64,
    /// Waits by spinning instead of sleeping: 20 to 60 us faster, at one full core per stage. Default false.
    #[serde(default)]
    pub busy_polling: bool,
}

/// The checks of images against what the model knows. An image that is not usable leads to the safe action with its
/// condition as the reason; something unknown on the lanes adds to the hazard.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ChecksConfig {
    /// Checks the camera: black, white, frozen, covered, unfocused, badly exposed images, another lens, its clock.
    /// Default true.
    pub camera: bool,
    /// Time for which an image may repeat before the camera counts as frozen, milliseconds, 50 to 60000. A camera of
    /// rendered images without sensor noise may repeat images indefinitely. Default 300.
    #[schemars(range(min = 50, max = 60_000))]
    pub frozen_ms: u64,
    /// Renders the known states from the camera's pose and compares them with the image: `same-frame`, `next-frame` or
    /// `off`. A checkpoint without `known.json` has no comparison. Default `same-frame`.
    pub compare: CompareImages,
    /// Meaning of something unknown for every decision rule that looks at the belief: `hazard` or `ignored`. Default
    /// `hazard`.
    pub unknown: UnknownIs,
}

impl Default for ChecksConfig {
    fn default() -> Self {
        Self { camera: true, frozen_ms: 300, compare: CompareImages::SameFrame, unknown: UnknownIs::Hazard }
    }
}

impl ChecksConfig {
    /// Returns true if something unknown means nothing to the decision rules.
    pub fn ignores_unknown(&self) -> bool {
        self.unknown == UnknownIs::Ignored
    }
}

/// The belief that the comparison of an image counts for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CompareImages {
    /// None: images are not compared.
    Off,
    /// The belief about the same frame, which waits for it.
    SameFrame,
    /// The belief about the next frame, which then does not wait. In the first frame of a take, and after five frames
    /// without a comparison, something unknown is nearly certain.
    NextFrame,
}

/// Meaning of something unknown for the decision rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum UnknownIs {
    /// A hazard.
    Hazard,
    /// Nothing: only the belief's hazard probability counts.
    Ignored,
}

/// A camera that the renderer looks through.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ViewChoice {
    /// Straight down.
    BirdsEye,
    /// From a corner of the region.
    Free,
}

/// The views that the renderer stage publishes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RendererConfig {
    /// Width of a view, pixels, 16 to 1024. Default 64.
    #[schemars(range(min = 16, max = 1024))]
    pub width_px: u32,
    /// Height of a view, pixels, 16 to 1024. Default 64.
    #[schemars(range(min = 16, max = 1024))]
    pub height_px: u32,
    /// Cameras for each hypothesis: `birds-eye`, `free`, or both. Default both.
    #[schemars(length(min = 1))]
    pub views: Vec<ViewChoice>,
    /// Largest number of hypotheses rendered, the most probable first, 1 to 64. Default 2.
    #[schemars(range(min = 1, max = 64))]
    pub hypotheses: u32,
    /// Largest number of views per second, 0.1 to 100. Default 2.
    #[schemars(range(min = 0.1, max = 100.0))]
    pub max_rate_hz: f64,
}

impl Default for RendererConfig {
    fn default() -> Self {
        Self {
            width_px: 64,
            height_px: 64,
            views: vec![ViewChoice::BirdsEye, ViewChoice::Free],
            hypotheses: 2,
            max_rate_hz: 2.0,
        }
    }
}

/// The decisions of the controller stage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ControllerConfig {
    /// Decision rule: `calibrated`, `paper`, `underconfident` or `overconfident`. Default `calibrated`.
    pub rule: Rule,
    /// Rate of actions, in addition to the one that follows each belief, 1 to 1000 per second. Default 20.
    #[schemars(range(min = 1.0, max = 1000.0))]
    pub rate_hz: f64,
    /// Largest age of a belief since capture, and longest validity of a decision; the car then halts. Milliseconds, 1 to
    /// 60000. Default 150.
    #[schemars(range(min = 1, max = 60_000))]
    pub deadline_ms: u64,
    /// Threshold on the hazard probability for the calibrated rule, 0 to 1. Default: the checkpoint's threshold, and with
    /// an `approach` at most the probability that a hazard leaves that is hidden in one known state.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub threshold: Option<f64>,
    /// Behaviour of the vehicle while the rule does not let it advance: `stop`, or, where the topic `ego/motion` is
    /// published, `phantom`, `peek` or `look`. Default `stop`.
    pub approach: Approach,
    /// Target speed of `advance`, m/s, 0.1 to 60. Default 5.
    #[schemars(range(min = 0.1, max = 60.0))]
    pub advance_mps: f64,
    /// Highest target speed of `creep` where nothing can be learned from further on, m/s, 0.1 to 10. Default 1.5.
    #[schemars(range(min = 0.1, max = 10.0))]
    pub creep_mps: f64,
    /// Highest speed of others, m/s, 0 to 60. With the approach `look`, the vehicle crosses their lane where the image
    /// shows it clear so far that nobody arrives in time, even if the belief has the hazard. Default 0: never.
    #[schemars(range(min = 0.0, max = 60.0))]
    pub others_mps: f64,
}

impl Default for ControllerConfig {
    fn default() -> Self {
        Self {
            rule: Rule::Calibrated,
            rate_hz: 20.0,
            deadline_ms: 150,
            threshold: None,
            approach: Approach::Stop,
            advance_mps: 5.0,
            creep_mps: 1.5,
            others_mps: 0.0,
        }
    }
}

impl ControllerConfig {
    /// Returns the speeds of the vehicle.
    pub fn speeds(&self) -> Speeds {
        Speeds { advance_mps: self.advance_mps, creep_mps: self.creep_mps, others_mps: self.others_mps }
    }
}

/// Sets one dotted key; `None` if the setting has no `=`, or if a part of the key is not a table.
fn set(table: &mut toml::Table, setting: &str) -> Option<()> {
    let (key, text) = setting.split_once('=')?;
    let parsed = toml::from_str::<toml::Table>(&format!("value = {text}")).ok().and_then(|mut t| t.remove("value"));
    let (tables, name) = key.trim().rsplit_once('.').unwrap_or(("", key.trim()));
    let mut inner = table;
    for part in tables.split('.').filter(|part| !part.is_empty()) {
        inner = inner.entry(part).or_insert_with(|| toml::Table::new().into()).as_table_mut()?;
    }
    inner.insert(name.to_owned(), parsed.unwrap_or_else(|| text.into()));
    Some(())
}

fn one() -> u64 {
    1
}
fn two() -> u32 {
    2
}
fn ten() -> u32 {
    10
}
fn ten_f64() -> f64 {
    10.0
}

/// Memory of earlier frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum MemoryKind {
    /// Each image counts by itself.
    #[default]
    None,
    /// The belief is carried from frame to frame.
    Filter,
}

/// Returns true for a file that only this process can read, or that can be read only once: a pipe, or a descriptor
/// (`/dev/stdin`).
pub fn is_stream(path: &Path) -> bool {
    let is_descriptor = ["/dev/fd", "/dev/stdin", "/proc"].iter().any(|folder| path.starts_with(folder));
    is_descriptor || path.metadata().is_ok_and(|found| !found.is_file() && !found.is_dir())
}

impl GraphConfig {
    /// Reports whether the belief has a memory, if the checkpoint has learned one.
    pub fn remembers(&self) -> bool {
        self.run.memory == MemoryKind::Filter
    }

    /// Returns the length of a time step; `step_s` is the scenario's, seconds. `None` for a real camera of a scenario
    /// without one.
    pub fn step_length(&self, step_s: Option<f64>) -> Option<StepLength> {
        match self.camera.source {
            CameraSource::Drives | CameraSource::FreeDrives => {
                Some(StepLength::Frames(u64::from(self.camera.frames_per_timestamp)))
            }
            _ => step_s.map(|step_s| StepLength::TimeNs((step_s * 1e9) as u64)),
        }
    }

    /// Returns the time of a frame, seconds since an arbitrary start. A rendered camera's frames follow each other at the run's
    /// rate, however fast they are rendered; a real camera's have their capture times.
    pub fn frame_time_s(&self, frame_id: u64, capture_time_ns: u64) -> f64 {
        match self.camera.source {
            CameraSource::Drives | CameraSource::FreeDrives => frame_id as f64 / self.run.frame_rate_hz,
            _ => capture_time_ns as f64 * 1e-9,
        }
    }

    /// Reads and checks a graph file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(&read(path, "graph")?, path)
    }

    /// Reads a graph file, and sets keys in it: each setting is `key=value` with a dotted key, such as
    /// `run.samples=35`. The value is TOML, or else a string.
    ///
    /// # Errors
    ///
    /// As [`Self::load`], and for a setting without `=` or below a key that is not a table.
    pub fn load_with(path: &Path, settings: &[String]) -> Result<Self, ConfigError> {
        let text = read(path, "graph")?;
        if settings.is_empty() {
            return Self::parse(&text, path);
        }
        let mut table: toml::Table = toml::from_str(&text).map_err(|e| Source { path, text: &text }.syntax(&e))?;
        for setting in settings {
            set(&mut table, setting).ok_or_else(|| ConfigError::Setting { setting: setting.clone() })?;
        }
        Self::parse(&table.to_string(), path)
    }

    /// Returns the effective configuration as TOML, with absolute paths.
    ///
    /// # Errors
    ///
    /// If a path is not UTF-8.
    pub fn to_toml(&self) -> Result<String, toml::ser::Error> {
        let mut graph = self.clone();
        graph.run.dataset = self.resolve(&self.run.dataset);
        graph.run.checkpoint = self.resolve(&self.run.checkpoint);
        graph.camera.paths_mut().for_each(|path| *path = self.resolve(path));
        for path in [&mut graph.run.dataset, &mut graph.run.checkpoint].into_iter().chain(graph.camera.paths_mut()) {
            *path = std::path::absolute(&*path).unwrap_or_else(|_| path.clone());
        }
        // The copy may lie outside the project, where the scenario's name would not be found.
        let scenario = self.scenario_path().and_then(|path| std::path::absolute(path).ok());
        graph.run.scenario = scenario.map(|path| path.with_extension("").display().to_string());
        toml::to_string(&graph)
    }

    /// Reads and checks the text of a graph file; errors name `path`, and relative paths are resolved from there.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let source = Source { path, text };
        source.refuse_moved(&MOVED)?;
        let mut graph: Self = ranges::read(&source)?;
        graph.check(&source)?;
        // A pipe has no place of its own: its paths are those of the folder in which its text was written.
        let path = if is_stream(path) { Path::new("graph.toml") } else { path };
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

    /// Resolves a path of this file: an absolute path is unchanged; a relative one is taken from the current directory
    /// if it exists there, else from the root of the project.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        if path.is_absolute() || path.exists() { path.to_owned() } else { self.project_root.join(path) }
    }

    /// The calibration of a real camera, where there is one.
    ///
    /// # Errors
    ///
    /// If its file cannot be read.
    pub fn calibration(&self) -> Result<Option<CameraCalibration>, CalibrationError> {
        self.camera
            .calibration
            .as_ref()
            .map(|choice| match choice {
                CalibrationChoice::File(path) => CameraCalibration::load(&self.resolve(path)),
                CalibrationChoice::Table(table) => Ok(table.clone()),
            })
            .transpose()
    }

    /// The scenario file that the dataset is rendered from, where one is named.
    pub fn scenario_path(&self) -> Option<PathBuf> {
        let name = self.run.scenario.as_ref()?;
        Some(self.resolve(&Path::new("configs/scenarios").join(format!("{name}.toml"))))
    }

    /// Returns one sentence for each setting that is allowed but unusual.
    pub fn warnings(&self) -> Vec<String> {
        let computing = [Stage::Encoder, Stage::Forecaster, Stage::Prober, Stage::Renderer];
        let sum: u32 = computing.map(|stage| self.stage(stage).threads).iter().sum();
        let budget = self.launcher.thread_budget;
        let mut warnings = Vec::new();
        if sum > budget {
            warnings
                .push(format!("the stages' threads add up to {sum}, more than `launcher.thread_budget` = {budget}"));
        }
        let frame_ms = 1000.0 / self.run.frame_rate_hz;
        if self.controller.deadline_ms as f64 <= frame_ms {
            warnings.push(format!(
                "`controller.deadline_ms` = {} is not above the {frame_ms:.0} ms between two frames: every action will \
                 end in the safe action",
                self.controller.deadline_ms
            ));
        }
        warnings
    }

    /// The process of a stage.
    pub fn stage(&self, stage: Stage) -> &StageConfig {
        self.stages.of(stage)
    }

    /// Time for one output above which a stage reports that it is slow, milliseconds.
    pub fn stage_deadline_ms(&self, stage: Stage) -> u64 {
        self.stage(stage).deadline_ms.unwrap_or(match stage {
            Stage::Camera => ((1000.0 / self.run.frame_rate_hz) as u64).max(1),
            Stage::Encoder => 60,
            Stage::Forecaster => 20,
            Stage::Prober => 30,
            Stage::Renderer => 2000,
            Stage::Controller => self.controller.deadline_ms,
        })
    }

    /// Niceness of a stage's process; `None` where it is inherited. The renderer yields to the decision path by
    /// default.
    pub fn stage_nice(&self, stage: Stage) -> Option<i32> {
        self.stage(stage).nice.or((stage == Stage::Renderer).then_some(19))
    }

    /// Checks the rules that a single range cannot express.
    fn check(&self, source: &Source<'_>) -> Result<(), ConfigError> {
        let name = &self.run.name;
        let plain = |b: u8| b.is_ascii_alphanumeric() || b == b'-' || b == b'_';
        if !(1..=24).contains(&name.len()) || !name.bytes().all(plain) {
            let allowed = "1 to 24 characters out of a-z, A-Z, 0-9, `-` and `_`".to_owned();
            return Err(source.range("run.name", format!("\"{name}\""), allowed));
        }
        if self.camera.source == CameraSource::FreeDrives && self.run.scenario.is_none() {
            let allowed = "`free-drives` with a `run.scenario` to render".to_owned();
            return Err(source.range("camera.source", "\"free-drives\"".to_owned(), allowed));
        }
        self.camera.check(source)?;
        self.stages.check(source)?;
        let order = &self.overload.order;
        if (1..order.len()).any(|i| order[..i].contains(&order[i])) {
            let allowed = "`resolution`, `samples`, `horizon`, each at most once".to_owned();
            return Err(source.range("overload.order", format!("{order:?}"), allowed));
        }
        Ok(())
    }
}

/// Keys of earlier versions and their present names; `*` stands for a stage.
const MOVED: [(&str, &str); 15] = [
    ("threads.total", "launcher.thread_budget"),
    ("threads.*", "stages.*.threads"),
    ("log.format", "launcher.log_format"),
    ("log.*", "stages.*.log"),
    ("encoder.deadline_ms", "stages.encoder.deadline_ms"),
    ("forecaster.deadline_ms", "stages.forecaster.deadline_ms"),
    ("prober.deadline_ms", "stages.prober.deadline_ms"),
    ("renderer.deadline_ms", "stages.renderer.deadline_ms"),
    ("renderer.nice", "stages.renderer.nice"),
    ("realtime.*.cpus", "stages.*.cpus"),
    ("realtime.*.nice", "stages.*.nice"),
    ("realtime.*.fifo_priority", "stages.*.fifo_priority"),
    ("realtime.*.lock_memory", "stages.*.lock_memory"),
    ("realtime.*.prefault_mb", "stages.*.prefault_mb"),
    ("launcher.restart.*", "stages.*.restart"),
];
