//! Input images: from a dataset, from a file, or from a running camera.

use crate::models::SessionModels;
use carff_base::geometry::PinholeCamera;
use carff_checkpoint::{CheckpointError, ScenarioIdentity};
use carff_dataset::{Dataset, DatasetError, Image, Observability};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An image with its metadata.
#[derive(Clone, Debug, PartialEq)]
pub struct ChosenImage {
    /// Name of the image in the window.
    pub title: String,
    /// Pixels of the image.
    pub image: Image,
    /// The camera of the image, if known.
    pub camera: Option<PinholeCamera>,
    /// True state of the image, if known.
    pub truth: Option<Truth>,
    /// Number that names the random draws of its forecasts: the frame's number, or the index in the dataset.
    pub frame: u64,
    /// The seed of the run that sent the image; `None`: the window's own seed.
    pub seed: Option<u64>,
}

/// The true state of an image. It is only displayed; nothing is computed from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Truth {
    /// The hidden branch.
    pub branch: usize,
    /// Time step of the branch.
    pub timestamp: usize,
    /// The camera pose.
    pub view: usize,
    /// Visibility of the actor or its place, if known.
    pub observability: Option<Observability>,
}

impl ChosenImage {
    /// Creates an input without metadata, for example from a file.
    pub fn of_image(title: impl Into<String>, image: Image) -> Arc<Self> {
        Arc::new(Self { title: title.into(), image, camera: None, truth: None, frame: 0, seed: None })
    }

    /// Reads an input from a PNG file.
    pub fn load_png(path: &Path) -> Result<Arc<Self>, DatasetError> {
        let title = path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
        Ok(Self::of_image(title, Image::load(path)?))
    }
}

/// Reason why a dataset cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AlbumError {
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The dataset's scenario differs from the checkpoint's.
    #[error(transparent)]
    Scenario(#[from] CheckpointError),
    /// The dataset does not name the states of its images.
    #[error("{path}: transforms.json has no `scenario`, or images without `view_id`: nothing to choose states from")]
    NoScenario {
        /// Path of the dataset's folder.
        path: PathBuf,
    },
}

/// A dataset, indexed by state and view.
#[derive(Debug)]
pub struct Album {
    dataset: Dataset,
    steps: usize,
    /// Maps `state * views + view` to the frame.
    index: Vec<Option<usize>>,
}

impl Album {
    /// Opens a dataset of the checkpoint's scenario.
    pub fn open(dir: &Path, models: &SessionModels) -> Result<Self, AlbumError> {
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

    /// Returns the dataset.
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Returns the number of time steps of each branch.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Returns the number of camera poses.
    pub fn view_count(&self) -> usize {
        self.dataset.view_count()
    }

    fn frame(&self, state: usize, view: usize) -> Option<usize> {
        let views = self.view_count();
        (view < views).then(|| self.index.get(state * views + view).copied().flatten()).flatten()
    }

    /// Returns how much of the actor or its place an image shows, if that is known.
    pub fn observability(&self, state: usize, view: usize) -> Option<Observability> {
        self.dataset.frames()[self.frame(state, view)?].observability
    }

    /// Returns the next view of a state with a visibility (`None`: any), forwards or backwards, with wrap-around.
    pub fn next_view(&self, state: usize, from: usize, forwards: bool, shows: Option<Observability>) -> Option<usize> {
        let views = self.view_count();
        (1..=views).map(|i| if forwards { (from + i) % views } else { (from % views + 2 * views - i) % views }).find(
            |&view| self.frame(state, view).is_some() && (shows.is_none() || self.observability(state, view) == shows),
        )
    }

    /// Returns the image of a state from a view, or `None` if the dataset has none.
    pub fn input(
        &self,
        state: usize,
        view: usize,
        models: &SessionModels,
    ) -> Result<Option<Arc<ChosenImage>>, AlbumError> {
        let Some(index) = self.frame(state, view) else { return Ok(None) };
        let frame = &self.dataset.frames()[index];
        Ok(Some(Arc::new(ChosenImage {
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
