//! A dataset in memory: frames with cameras and states, and their scenario.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::error::DatasetError;
use crate::image::Image;
use crate::scenario::{Frame, ScenarioInfo};
use crate::{seen, transforms};

/// A posed image dataset; images are loaded on demand.
#[derive(Clone, Debug)]
pub struct Dataset {
    dir: PathBuf,
    frames: Vec<Frame>,
    scenario: Option<ScenarioInfo>,
    view_count: usize,
    warnings: Vec<String>,
}

impl Dataset {
    /// Reads and checks `transforms.json`, or else `transforms_train.json`, `transforms_val.json` and
    /// `transforms_test.json` together. It checks that the images exist but does not decode them. Exception: if a
    /// dataset with several branches has no observability, it is derived from the images, with a warning.
    pub fn open(dir: &Path) -> Result<Self, DatasetError> {
        let read = transforms::read(dir, transforms::Pictures::Png)?;
        let view_count = read.frames.iter().filter_map(|f| f.view).max().map_or(0, |v| v + 1);
        let mut set = Self {
            dir: dir.to_owned(),
            frames: read.frames,
            scenario: read.scenario,
            view_count,
            warnings: read.warnings,
        };
        let several = set.scenario.as_ref().is_some_and(|s| s.branches.len() > 1);
        if several && set.frames.iter().all(|f| f.observability.is_none()) {
            let told = seen::told_by_pictures(&set.frames, view_count, |i| set.load_image(i))?;
            for (frame, observability) in set.frames.iter_mut().zip(told) {
                frame.observability = observability;
            }
            set.warnings.push(
                "no frame has an `observability`, so it is derived from the images: `none` if each other branch looks \
                 the same at that timestamp, `full` if none does, else `partial`"
                    .into(),
            );
        }
        Ok(set)
    }

    /// Returns the dataset's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns all frames, in the order of the file.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// Returns the scenario, if the dataset has one.
    pub fn scenario(&self) -> Option<&ScenarioInfo> {
        self.scenario.as_ref()
    }

    /// Returns the number of fixed camera poses; 0 if frames have no view index.
    pub fn view_count(&self) -> usize {
        self.view_count
    }

    /// Returns the number of states; without a scenario, it follows from the frames and is at least one.
    pub fn state_count(&self) -> usize {
        match &self.scenario {
            Some(scenario) => scenario.state_count(),
            None => self.frames.iter().filter_map(|f| f.state).max().map_or(1, |s| s + 1),
        }
    }

    /// Returns the index of the frame of a state from a view.
    pub fn frame_index(&self, state: usize, view: usize) -> Option<usize> {
        self.frames.iter().position(|f| f.state == Some(state) && f.view == Some(view))
    }

    /// Returns warnings about accepted but unusual values, for `check` to print.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Decodes an image and checks that its size matches its intrinsics.
    pub fn load_image(&self, frame_index: usize) -> Result<Image, DatasetError> {
        let frame = self
            .frames
            .get(frame_index)
            .ok_or(DatasetError::NoSuchFrame { index: frame_index, count: self.frames.len() })?;
        let image = Image::load_png(&frame.image_path)?;
        let (w, h) = (frame.camera.width_px, frame.camera.height_px);
        if (image.width_px, image.height_px) != (w, h) {
            return Err(DatasetError::Image {
                path: frame.image_path.clone(),
                problem: format!(
                    "frame {frame_index} is {}x{} pixels, but its intrinsics (keys `w` and `h`) are {w}x{h}",
                    image.width_px, image.height_px
                ),
            });
        }
        Ok(image)
    }

    /// Decodes all images in parallel, in the order of the frames. Returns the first error.
    pub fn load_all_images(&self) -> Result<Vec<Image>, DatasetError> {
        let images: Vec<_> = (0..self.frames.len()).into_par_iter().map(|i| self.load_image(i)).collect();
        images.into_iter().collect()
    }
}
