//! A small scenario with its dataset and training file, in a folder of its own.

#![allow(
    dead_code,
    clippy::unwrap_used,
    reason = "not every test uses all of it, and a helper fails a test by panicking"
)]

use carff_scenes::{Extras, Scenario};
use carff_training::{Progress, Training, TrainingConfig, TrainingRun};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// A block drives along a road, or does not; fourteen cameras show it, eight are behind a wall.
pub const SCENARIO: &str = include_str!("../../../../tests/data/small-scenario.toml");

/// libtorch has one random generator per process: two trainings at once, or a training and the initialisation of a
/// model, would change each other's draws.
pub fn exclusive() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

pub struct Place {
    folder: tempfile::TempDir,
    pub config: TrainingConfig,
    pub scenario: Scenario,
}

impl Place {
    /// Renders the dataset `set` of a scenario, and reads a training file.
    pub fn new(scenario: &str, training: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("training.toml");
        std::fs::write(&file, training).unwrap();
        let mut config = TrainingConfig::load(&file).unwrap();
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
        config.pretrained_backbone = Some(root.join("configs/checkpoints/backbones/efficientnet-lite0.safetensors"));
        let scenario = Scenario::parse(Path::new("small.toml"), scenario).unwrap();
        scenario.render_dataset(&folder.path().join("set"), Extras::None, |_, _| ControlFlow::Continue(())).unwrap();
        Self { folder, config, scenario }
    }

    pub fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Works in the run folder `name`, without another training in this process, until `stop_at` (phase, steps done), or
    /// to the end.
    pub fn run<R>(&self, name: &str, stop_at: Option<(&str, usize)>, work: impl FnOnce(&TrainingRun) -> R) -> R {
        let _exclusive = exclusive();
        let stop = AtomicBool::new(false);
        let on_progress = |progress: &Progress| {
            if stop_at.is_some_and(|(phase, done)| progress.phase == phase && progress.done >= done) {
                stop.store(true, Ordering::Relaxed);
            }
        };
        std::fs::create_dir_all(self.at(name)).unwrap();
        work(&TrainingRun { dir: self.at(name), on_progress: &on_progress, stop: &stop })
    }

    pub fn training<'a>(&'a self, dataset: &'a Path, out: &'a Path) -> Training<'a> {
        Training { config: &self.config, dataset, free_poses: &[], scenario: None, out, device: tch::Device::Cpu }
    }
}
