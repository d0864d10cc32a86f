//! Training phases: one loop for all of them, and the folder of a run with its states and metrics.

use crate::{
    TrainingConfig, TrainingError, curves, features,
    records::{METRICS, MetricsLine, names},
};
use carff_evaluation::{PosedImages, Progress};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_networks::{
    encoder::gaussians,
    weights::{self, Tensors},
};
use serde::Serialize;
use std::{
    fs::OpenOptions,
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};
use tch::{Kind, Tensor};

/// Folder of the images from free poses in a run's folder.
pub const FREE_IMAGES: &str = "free-poses";

/// File of the posteriors in a run's folder.
const POSTERIORS: &str = "posteriors.safetensors";

/// Time between two saved states.
const SAVE_EVERY: Duration = Duration::from_secs(45);

/// One training phase: a model that learns in steps, with a state that can be saved after any step.
pub trait Phase {
    /// Record of the metrics file.
    type Record: Serialize;

    /// Name of the phase, one of [`names`].
    fn name(&self) -> &'static str;

    /// Number of steps.
    fn total(&self) -> usize;

    /// Restores a state that was saved after `done` steps; `false` when the state does not fit.
    fn restore(&mut self, done: usize, state: &Tensors) -> bool;

    /// Runs step number `step`, counted from 0.
    fn step(&mut self, step: usize);

    /// Figures after `done` steps.
    fn report(&mut self, done: usize) -> Result<PhaseReport<Self::Record>, TrainingError>;

    /// State to save.
    fn state(&self) -> Tensors;
}

/// Figures after a step; both parts may be absent.
pub struct PhaseReport<R> {
    /// Line of progress.
    pub line: Option<String>,
    /// Record of the metrics file.
    pub record: Option<R>,
}

/// Runs a phase to its end, or resumes it from its saved state. The state is saved at intervals, at the end, and when
/// the user stops the run.
pub fn drive(phase: &mut impl Phase, run: &TrainingRun) -> Result<(), TrainingError> {
    let (name, total) = (phase.name(), phase.total());
    let first = match run.load(name)? {
        Some((done, state)) if phase.restore(done, &state) => done,
        Some(_) => return Err(damaged(&run.state_path(name))),
        None => 0,
    };
    let mut saved = Instant::now();
    for step in first..total {
        phase.step(step);
        let done = step + 1;
        let report = phase.report(done)?;
        if let Some(record) = &report.record {
            run.record(name, record)?;
        }
        if let Some(line) = report.line {
            (run.on_progress)(&Progress { phase: name, done, total, line });
        }
        let stopping = run.stopped();
        if stopping || done == total || saved.elapsed() >= SAVE_EVERY {
            run.save(name, done, phase.state())?;
            saved = Instant::now();
        }
        if stopping {
            return Err(TrainingError::Stopped);
        }
    }
    Ok(())
}

/// Configuration, images and run of one training.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// The training file.
    pub config: &'a TrainingConfig,
    /// Images of the scenario.
    pub posed: &'a PosedImages,
    /// Folder and progress.
    pub run: &'a TrainingRun<'a>,
}

/// Folder, progress and stop flag of one training.
pub struct TrainingRun<'a> {
    /// Folder of the states and metrics.
    pub dir: PathBuf,
    /// Called after each step.
    pub on_progress: &'a (dyn Fn(&Progress) + Sync),
    /// Set by the user to stop after the current step, with the state saved.
    pub stop: &'a AtomicBool,
}

impl TrainingRun<'_> {
    /// Adds one record to the metrics file, under the name of its phase.
    pub fn record(&self, phase: &str, record: &impl Serialize) -> Result<(), TrainingError> {
        let path = self.dir.join(METRICS);
        let line = serde_json::to_string(&MetricsLine { phase: phase.to_owned(), record })
            .map_err(|e| TrainingError::Format { path: path.clone(), what: e.to_string() })?;
        let failed = |source| TrainingError::File { path: path.clone(), source };
        let mut file = OpenOptions::new().create(true).append(true).open(&path).map_err(failed)?;
        writeln!(file, "{line}").map_err(failed)
    }

    /// Returns true if the user stopped the run.
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// File of a phase's state.
    fn state_path(&self, phase: &str) -> PathBuf {
        self.dir.join(state_file(phase))
    }

    /// Saves a state atomically, in full precision, and draws the curves.
    pub fn save(&self, phase: &str, done: usize, mut state: Tensors) -> Result<(), TrainingError> {
        state.insert("run.done".into(), Tensor::from_slice(&[done as i64]));
        weights::write(&self.state_path(phase), &state, Kind::Float)?;
        curves::draw(&self.dir)
    }

    /// Saves posteriors `[copy][image]`, so that later phases need no backbone.
    pub fn save_posteriors(&self, posteriors: &[Vec<Gaussian>]) -> Result<(), TrainingError> {
        let all = || posteriors.iter().flatten();
        let shape = [posteriors.len() as i64, -1, LATENT_DIM as i64];
        let rows = |values: Vec<f32>| Tensor::from_slice(&values).view(shape);
        let tensors = Tensors::from([
            ("mean".into(), rows(all().flat_map(|g| g.mean).collect())),
            ("log_variance".into(), rows(all().flat_map(|g| g.log_variance).collect())),
        ]);
        Ok(weights::write(&self.dir.join(POSTERIORS), &tensors, Kind::Float)?)
    }

    /// Saved posteriors; `None` when there are none, or those of other images.
    pub fn load_posteriors(&self, copies: usize, images: usize) -> Result<Option<Vec<Vec<Gaussian>>>, TrainingError> {
        let path = self.dir.join(POSTERIORS);
        if !path.is_file() {
            return Ok(None);
        }
        let tensors = weights::read(&path)?;
        let shape = [copies as i64, images as i64, LATENT_DIM as i64];
        let (Some(mean), Some(log_variance)) = (tensors.get("mean"), tensors.get("log_variance")) else {
            return Ok(None);
        };
        if mean.size() != shape || log_variance.size() != shape {
            return Ok(None);
        }
        let flat = gaussians(&mean.flatten(0, 1), &log_variance.flatten(0, 1));
        Ok(Some(flat.chunks(images.max(1)).map(<[_]>::to_vec).collect()))
    }

    /// A saved state and its number of steps, if there is one.
    pub fn load(&self, phase: &str) -> Result<Option<(usize, Tensors)>, TrainingError> {
        let path = self.state_path(phase);
        if !path.is_file() {
            return Ok(None);
        }
        let mut state = weights::read(&path)?;
        let done = state.remove("run.done").map(|t| t.int64_value(&[0]).max(0) as usize);
        let done = done.ok_or_else(|| damaged(&path))?;
        Ok(Some((done, state)))
    }

    /// Restores the state of a finished phase. An unfinished phase is an error.
    pub fn load_finished(
        &self,
        phase: &str,
        total: usize,
        restore: impl FnOnce(&Tensors) -> bool,
    ) -> Result<(), TrainingError> {
        match self.load(phase)? {
            Some((done, state)) if done >= total => {
                if restore(&state) {
                    Ok(())
                } else {
                    Err(damaged(&self.state_path(phase)))
                }
            }
            unfinished => {
                let done = unfinished.map_or(0, |(done, _)| done);
                Err(TrainingError::Unfinished { phase: phase.to_owned(), done, total })
            }
        }
    }
}

fn state_file(phase: &str) -> String {
    format!("{phase}.state.safetensors")
}

/// Removes all states, features, metrics and free poses of a run's folder.
pub fn forget_run(dir: &Path) -> Result<(), TrainingError> {
    use names::{FIELD, FREE_POSES, MIXTURE, ONE_STAGE, VAE};
    let states = [VAE, FIELD, MIXTURE, FREE_POSES, ONE_STAGE].map(state_file);
    let others = [POSTERIORS, features::FEATURES, METRICS].map(str::to_owned);
    let gone = |path: PathBuf, removed: std::io::Result<()>| match removed {
        Err(source) if source.kind() != ErrorKind::NotFound => Err(TrainingError::File { path, source }),
        _ => Ok(()),
    };
    for path in states.into_iter().chain(others).map(|name| dir.join(name)) {
        gone(path.clone(), std::fs::remove_file(&path))?;
    }
    let images = dir.join(FREE_IMAGES);
    gone(images.clone(), std::fs::remove_dir_all(&images))
}

/// Error of a state file that cannot be used.
fn damaged(path: &Path) -> TrainingError {
    TrainingError::Format {
        path: path.into(),
        what: "this saved state belongs to another configuration or is damaged; remove the file to start anew".into(),
    }
}

/// Tensors under a prefix, without the prefix.
pub fn part(state: &Tensors, prefix: &str) -> Tensors {
    state.iter().filter_map(|(k, t)| k.strip_prefix(prefix).map(|k| (k.to_owned(), t.shallow_clone()))).collect()
}

/// Adds a prefix to every name.
pub fn prefixed(prefix: &str, tensors: Tensors) -> impl Iterator<Item = (String, Tensor)> {
    tensors.into_iter().map(move |(k, t)| (format!("{prefix}{k}"), t))
}

/// Cosine schedule from 1 at the start to 0.02 at the end.
pub fn cosine(done: usize, total: usize) -> f64 {
    let t = (done as f64 / total.max(1) as f64).min(1.0);
    0.02 + 0.98 * 0.5 * (1.0 + (std::f64::consts::PI * t).cos())
}
