//! What is looked at: an image of a dataset, of a file, or of a running camera; and the dataset to choose from.

use crate::models::Models;
use carff_checkpoint::{CheckpointError, ScenarioIdentity};
use carff_dataset::{Dataset, DatasetError, Image, Observability};
use carff_geometry::PinholeCamera;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An image, and what is known of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// What it is called in the window.
    pub title: String,
    /// Its pixels.
    pub image: Image,
    /// The camera that took it, if that is known.
    pub camera: Option<PinholeCamera>,
    /// What it really shows, if that is known.
    pub truth: Option<Truth>,
    /// Names the draws of forecasts that rest on it: the frame's number, or its place in the dataset.
    pub frame: u64,
    /// The seed of the run that it comes from; `None`: the window's own.
    pub seed: Option<u64>,
}

/// What an image really shows. Nothing is computed from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Truth {
    /// The hidden branch.
    pub branch: usize,
    /// Step of it.
    pub timestamp: usize,
    /// The camera pose.
    pub view: usize,
    /// How much of the actor or its place is seen, if that is known.
    pub observability: Option<Observability>,
}

impl Input {
    /// An image alone: of a file, say.
    pub fn of_picture(title: impl Into<String>, image: Image) -> Arc<Self> {
        Arc::new(Self { title: title.into(), image, camera: None, truth: None, frame: 0, seed: None })
    }

    /// Reads a PNG image.
    pub fn load_png(path: &Path) -> Result<Arc<Self>, DatasetError> {
        let title = path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
        Ok(Self::of_picture(title, Image::load_png(path)?))
    }
}

/// Why a dataset cannot be chosen from.
#[derive(Debug, thiserror::Error)]
pub enum AlbumError {
    /// It cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// It shows another scenario than the checkpoint knows.
    #[error(transparent)]
    Scenario(#[from] CheckpointError),
    /// It does not say which states its images show.
    #[error("{path}: transforms.json has no `scenario`, or images without `view_id`: nothing to choose states from")]
    NoScenario {
        /// The dataset's folder.
        path: PathBuf,
    },
}

/// A dataset, by state and view.
#[derive(Debug)]
pub struct Album {
    dataset: Dataset,
    steps: usize,
    /// `state * views + view` to the frame.
    index: Vec<Option<usize>>,
}

impl Album {
    /// Opens a dataset that shows the checkpoint's scenario.
    pub fn open(dir: &Path, models: &Models) -> Result<Self, AlbumError> {
        let dataset = Dataset::open(dir)?;
        let nothing = || AlbumError::NoScenario { path: dir.to_owned() };
        let scenario = dataset.scenario().ok_or_else(nothing)?;
        let (states, views) = (dataset.state_count(), dataset.view_count());
        models.manifest.check_scenario(&models.dir, &ScenarioIdentity::of(scenario, views))?;
        let steps = scenario.timestamps.max(1);
        let mut index = vec![None; states * views];
        for (i, frame) in dataset.frames().iter().enumerate() {
            if let (Some(state), Some(view)) = (frame.state, frame.view)
                && let Some(place) = index.get_mut(state * views + view)
            {
                *place = Some(i);
            }
        }
        if index.iter().all(Option::is_none) {
            return Err(nothing());
        }
        Ok(Self { dataset, steps, index })
    }

    /// The dataset.
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Steps of each branch.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Number of camera poses.
    pub fn view_count(&self) -> usize {
        self.dataset.view_count()
    }

    fn frame(&self, state: usize, view: usize) -> Option<usize> {
        let views = self.view_count();
        (view < views).then(|| self.index.get(state * views + view).copied().flatten()).flatten()
    }

    /// How much of the actor or its place an image shows, if that is known.
    pub fn observability(&self, state: usize, view: usize) -> Option<Observability> {
        self.dataset.frames()[self.frame(state, view)?].observability
    }

    /// The next view of a state, forwards or backwards and around the end, that shows so much (`None`: any).
    pub fn next_view(&self, state: usize, from: usize, forwards: bool, shows: Option<Observability>) -> Option<usize> {
        let views = self.view_count();
        (1..=views).map(|i| if forwards { (from + i) % views } else { (from % views + 2 * views - i) % views }).find(
            |&view| self.frame(state, view).is_some() && (shows.is_none() || self.observability(state, view) == shows),
        )
    }

    /// The image of a state from a view; `None` when the set has none.
    pub fn input(&self, state: usize, view: usize, models: &Models) -> Result<Option<Arc<Input>>, AlbumError> {
        let Some(index) = self.frame(state, view) else { return Ok(None) };
        let frame = &self.dataset.frames()[index];
        Ok(Some(Arc::new(Input {
            title: format!("{}, view {view}", models.state_name(Some(state))),
            image: self.dataset.load_image(index)?,
            camera: Some(frame.camera),
            truth: Some(Truth {
                branch: state / self.steps,
                timestamp: state % self.steps,
                view,
                observability: frame.observability,
            }),
            frame: index as u64,
            seed: None,
        })))
    }
}
