//! What every training loop does the same way: report, save, stop.

use crate::{TrainingError, curves};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_models::{
    encoder::gaussians,
    weights::{self, Tensors},
};
use serde_json::Value;
use std::{
    fs::OpenOptions,
    io::Write,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};
use tch::{Kind, Tensor};

/// One line of progress.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress<'a> {
    /// `vae`, `nerf` or `mdn`.
    pub stage: &'a str,
    /// Steps (or epochs) done.
    pub done: usize,
    /// Steps (or epochs) in all.
    pub total: usize,
    /// The figures, as one line for a person.
    pub line: String,
}

/// Where a training keeps its files, whom it tells, and who may stop it.
pub struct Run<'a> {
    /// The folder of this run: states and metrics.
    pub dir: PathBuf,
    /// Told of each step.
    pub on_progress: &'a (dyn Fn(&Progress) + Sync),
    /// Set from outside (Ctrl-C) to stop after the current step, with the state saved.
    pub stop: &'a AtomicBool,
}

/// File of the posteriors.
const POSTERIORS: &str = "posteriors.safetensors";

/// How long a training goes on before it saves its state.
const SAVE_EVERY: Duration = Duration::from_secs(45);

impl Run<'_> {
    /// Adds one line to `metrics.jsonl`.
    pub fn metric(&self, record: &Value) -> Result<(), TrainingError> {
        let path = self.dir.join("metrics.jsonl");
        let failed = |source| TrainingError::File { path: path.clone(), source };
        let mut file = OpenOptions::new().create(true).append(true).open(&path).map_err(failed)?;
        writeln!(file, "{record}").map_err(failed)
    }

    /// Whether somebody asked to stop.
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// The file of a stage's state.
    pub fn state_path(&self, stage: &str) -> PathBuf {
        self.dir.join(format!("{stage}.state.safetensors"))
    }

    /// Saves a state, whole or not at all, in full precision, and draws the curves up to it.
    pub fn save(&self, stage: &str, done: usize, mut state: Tensors) -> Result<(), TrainingError> {
        state.insert("run.done".into(), Tensor::from_slice(&[done as i64]));
        weights::write(&self.state_path(stage), &state, Kind::Float)?;
        curves::draw(&self.dir)
    }

    /// Keeps posteriors `[copy][picture]`, so that later stages need no picture to pass the backbone again.
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

    /// Posteriors that were kept; `None` when there are none, or those of other pictures.
    pub fn load_posteriors(&self, copies: usize, pictures: usize) -> Result<Option<Vec<Vec<Gaussian>>>, TrainingError> {
        let path = self.dir.join(POSTERIORS);
        if !path.is_file() {
            return Ok(None);
        }
        let tensors = weights::read(&path)?;
        let shape = [copies as i64, pictures as i64, LATENT_DIM as i64];
        let (Some(mean), Some(log_variance)) = (tensors.get("mean"), tensors.get("log_variance")) else {
            return Ok(None);
        };
        if mean.size() != shape || log_variance.size() != shape {
            return Ok(None);
        }
        let flat = gaussians(&mean.flatten(0, 1), &log_variance.flatten(0, 1));
        Ok(Some(flat.chunks(pictures.max(1)).map(<[_]>::to_vec).collect()))
    }

    /// A saved state and the steps done, if there is one.
    pub fn load(&self, stage: &str) -> Result<Option<(usize, Tensors)>, TrainingError> {
        let path = self.state_path(stage);
        if !path.is_file() {
            return Ok(None);
        }
        let mut state = weights::read(&path)?;
        let done = state.remove("run.done").map(|t| t.int64_value(&[0]).max(0) as usize);
        let done = done.ok_or_else(|| damaged(&path))?;
        Ok(Some((done, state)))
    }
}

/// The error for a state file that cannot be used.
pub fn damaged(path: &Path) -> TrainingError {
    TrainingError::Format {
        path: path.into(),
        what: "this saved state belongs to another configuration or is damaged; remove the file to start anew".into(),
    }
}

/// Says when it is time to save.
pub struct SaveClock(Instant);

impl Default for SaveClock {
    fn default() -> Self {
        Self(Instant::now())
    }
}

impl SaveClock {
    /// True once in a while.
    pub fn is_due(&mut self) -> bool {
        let due = self.0.elapsed() >= SAVE_EVERY;
        if due {
            self.0 = Instant::now();
        }
        due
    }
}

/// Splits a state by a prefix, which is taken off.
pub fn part(state: &Tensors, prefix: &str) -> Tensors {
    state.iter().filter_map(|(k, t)| k.strip_prefix(prefix).map(|k| (k.to_owned(), t.shallow_clone()))).collect()
}

/// Puts a prefix before every name.
pub fn prefixed(prefix: &str, tensors: Tensors) -> impl Iterator<Item = (String, Tensor)> {
    tensors.into_iter().map(move |(k, t)| (format!("{prefix}{k}"), t))
}

/// Cosine from 1 at the start to 0.02 at the end.
pub fn cosine(done: usize, total: usize) -> f64 {
    let t = (done as f64 / total.max(1) as f64).min(1.0);
    0.02 + 0.98 * 0.5 * (1.0 + (std::f64::consts::PI * t).cos())
}
