//! A dataset in memory: frames with cameras and states, and their scenario.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use carff_base::geometry::PinholeCamera;
use rayon::prelude::*;

use crate::error::DatasetError;
use crate::image::{Image, dimensions, load_mask};
use crate::lens::Lens;
use crate::scenario::{Frame, ScenarioInfo};
use crate::seen;
use crate::transforms::{self, Transforms};
use crate::views::Views;

/// A posed image dataset; images are loaded on demand.
#[derive(Clone, Debug)]
pub struct Dataset {
    dir: PathBuf,
    frames: Vec<Frame>,
    masks: Vec<Mask>,
    scenario: Option<ScenarioInfo>,
    view_count: usize,
    warnings: Vec<String>,
}

impl Dataset {
    /// Reads and checks `transforms.json`, or else `transforms_train.json`, `transforms_val.json` and
    /// `transforms_test.json` together. It checks that the images exist but does not decode them. Exception: if a
    /// dataset with several branches has no observability, it is derived from the images, with a warning.
    ///
    /// # Errors
    ///
    /// Names file, frame and key. All missing images and masks are listed.
    pub fn open(dir: &Path) -> Result<Self, DatasetError> {
        Self::open_with(dir, Views::InEveryState)
    }

    /// Opens a dataset as [`Self::open`] does, but a view of a scenario may be missing in some states: a camera that
    /// drives by takes each image from another pose.
    pub fn open_partial(dir: &Path) -> Result<Self, DatasetError> {
        Self::open_with(dir, Views::InSomeStates)
    }

    fn open_with(dir: &Path, views: Views) -> Result<Self, DatasetError> {
        let mut read = transforms::read(dir, views)?;
        DatasetError::of_all(read.faults.drain(..).map(|(_, fault)| fault).collect())?;
        Self::of(dir, read)
    }

    /// Reads a dataset and all of its images for a check. Images and masks that are missing or broken are listed, and
    /// the dataset is without their frames; a scenario is without their views, and its other views are renumbered. It is
    /// `None` if nothing remains. A scenario's views may be missing in some states, with a warning.
    ///
    /// # Errors
    ///
    /// Errors of the transforms file, as in [`Self::open`].
    pub fn survey(dir: &Path) -> Result<(Option<Self>, Vec<DatasetError>), DatasetError> {
        let mut read = transforms::read(dir, Views::InSomeStates)?;
        let mut faults: Vec<Option<DatasetError>> = read.frames.iter().map(|_| None).collect();
        for (frame, fault) in read.faults.drain(..) {
            faults[frame] = Some(fault);
        }
        faults.par_iter_mut().zip(&read.frames).enumerate().filter(|(_, (fault, _))| fault.is_none()).for_each(
            |(i, (fault, frame))| {
                *fault = load(i, frame).err().or_else(|| masks(std::slice::from_ref(frame)).err());
            },
        );
        drop_broken(&mut read, |frame| faults[frame].is_some());
        let faults = faults.into_iter().flatten().collect();
        let remains = !read.frames.is_empty();
        read.warnings.extend(missing_states(&read));
        Ok((remains.then(|| Self::of(dir, read)).transpose()?, faults))
    }

    fn of(dir: &Path, read: Transforms) -> Result<Self, DatasetError> {
        let mut set = Self {
            dir: dir.to_owned(),
            masks: masks(&read.frames)?,
            view_count: read.frames.iter().filter_map(|f| f.view).max().map_or(0, |v| v + 1),
            frames: read.frames,
            scenario: read.scenario,
            warnings: read.warnings,
        };
        let several = set.scenario.as_ref().is_some_and(|s| s.branches.len() > 1);
        if several && set.frames.iter().all(|f| f.observability.is_none()) {
            let seen = seen::seen_in_images(&set.frames, |i| set.load_image(i), |pair| set.valid_in_all(&pair))?;
            for (frame, observability) in seen.into_iter().enumerate() {
                set.frames[frame].observability = observability;
            }
            if set.frames.iter().any(|frame| frame.observability.is_some()) {
                set.warnings.push(
                    "no frame has an `observability`, so it is derived from the images: `none` if each other branch \
                     looks the same at that timestamp, `full` if none does, else `partial`"
                        .into(),
                );
            }
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

    /// Returns the camera that most frames were taken with, at the first one's pose: the size and the field of view that
    /// models are trained for.
    pub fn usual_camera(&self) -> Option<PinholeCamera> {
        let key = |c: &PinholeCamera| {
            let numbers = [c.fl_x_px, c.fl_y_px, c.cx_px, c.cy_px].map(f64::to_bits);
            (c.width_px, c.height_px, numbers)
        };
        let mut counts: HashMap<_, (usize, usize)> = HashMap::new();
        for (i, frame) in self.frames.iter().enumerate() {
            counts.entry(key(&frame.camera)).or_insert((0, i)).0 += 1;
        }
        let (_, first) = counts.into_values().max_by_key(|(count, first)| (*count, std::cmp::Reverse(*first)))?;
        Some(self.frames[first].camera)
    }

    /// Returns the index of the frame of a state from a view.
    pub fn frame_index(&self, state: usize, view: usize) -> Option<usize> {
        self.frames.iter().position(|f| f.state == Some(state) && f.view == Some(view))
    }

    /// Returns warnings about accepted but unusual values, for `check` to print.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Decodes an image, checks that its size matches its intrinsics, and undoes the distortion of its lens. Masked
    /// pixels are part of the image; see [`Self::valid_pixels`].
    pub fn load_image(&self, frame_index: usize) -> Result<Image, DatasetError> {
        let missing = DatasetError::NoSuchFrame { index: frame_index, count: self.frames.len() };
        load(frame_index, self.frames.get(frame_index).ok_or(missing)?)
    }

    /// Decodes all images in parallel, in the order of the frames. All errors are listed.
    pub fn load_all_images(&self) -> Result<Vec<Image>, DatasetError> {
        collected((0..self.frames.len()).into_par_iter().map(|i| self.load_image(i)).collect())
    }

    /// Returns a flag for each pixel of an image, row by row: false for pixels that its mask excludes, or that its lens
    /// does not show. They are not targets of training and not part of measurements. `None`: all pixels are valid.
    pub fn valid_pixels(&self, frame_index: usize) -> Option<&[bool]> {
        self.masks.get(frame_index)?.as_deref()
    }

    /// Returns a test of pixels: true for a pixel that is valid in all of these images.
    pub fn valid_in_all(&self, frames: &[usize]) -> impl Fn(usize) -> bool + use<'_> {
        let masks: Vec<&[bool]> = frames.iter().filter_map(|&frame| self.valid_pixels(frame)).collect();
        move |pixel| masks.iter().all(|mask| mask.get(pixel) != Some(&false))
    }
}

/// Decodes the image of a frame as its camera would have taken it.
fn load(index: usize, frame: &Frame) -> Result<Image, DatasetError> {
    let image = Image::load(&frame.image_path)?;
    let (w, h) = (frame.camera.width_px, frame.camera.height_px);
    if (image.width_px, image.height_px) != (w, h) {
        return Err(DatasetError::Image {
            path: frame.image_path.clone(),
            problem: format!(
                "frame {index} is {}x{} pixels, but its intrinsics (keys `w` and `h`) are {w}x{h}",
                image.width_px, image.height_px
            ),
        });
    }
    Ok(if frame.lens == Lens::Pinhole { image } else { frame.lens.undistorted(&image, &frame.camera) })
}

/// Valid pixels of a frame; `None`: all.
type Mask = Option<Arc<[bool]>>;

/// Reads the masks of all frames. Frames with equal lenses and without a mask share one. An image of another size than its
/// camera has none, because it cannot be loaded.
fn masks(frames: &[Frame]) -> Result<Vec<Mask>, DatasetError> {
    let key = |frame: &Frame| {
        format!("{:?}", (frame.lens, PinholeCamera { world_from_camera: [[0.0; 4]; 4], ..frame.camera }))
    };
    let size = |frame: &Frame| (frame.camera.width_px, frame.camera.height_px);
    let fits = |frame: &Frame| dimensions(&frame.image_path).is_ok_and(|found| found == size(frame));
    let mut of_lens: HashMap<String, Arc<[bool]>> = HashMap::new();
    for frame in frames.iter().filter(|f| f.lens != Lens::Pinhole && f.mask_path.is_none() && fits(f)) {
        of_lens.entry(key(frame)).or_insert_with(|| frame.lens.valid(&frame.camera, None).into());
    }
    let mask = |frame: &Frame| {
        let valid: Arc<[bool]> = match (&frame.mask_path, frame.lens) {
            (None, Lens::Pinhole) => return Ok(None),
            (None, _) => match of_lens.get(&key(frame)).filter(|_| fits(frame)) {
                Some(shared) => shared.clone(),
                None => return Ok(None),
            },
            (Some(path), lens) => lens.valid(&frame.camera, Some(&load_mask(path, size(frame))?)).into(),
        };
        if !valid.contains(&true) {
            let path = frame.mask_path.as_ref().unwrap_or(&frame.image_path).clone();
            let problem = "no pixel remains: the mask and the lens exclude all of them".to_owned();
            return Err(DatasetError::Image { path, problem });
        }
        Ok(valid.contains(&false).then_some(valid))
    };
    collected(frames.par_iter().map(mask).collect())
}

/// Returns all values, or an error that lists all errors.
pub(crate) fn collected<T>(results: Vec<Result<T, DatasetError>>) -> Result<Vec<T>, DatasetError> {
    let (mut values, mut errors) = (Vec::with_capacity(results.len()), Vec::new());
    for result in results {
        match result {
            Ok(value) => values.push(value),
            Err(error) => errors.push(error),
        }
    }
    DatasetError::of_all(errors).map(|()| values)
}

/// Returns the warning about views of a scenario that are missing in some states.
fn missing_states(read: &Transforms) -> Option<String> {
    let states = read.scenario.as_ref()?.state_count();
    let mut of_view: HashMap<usize, usize> = HashMap::new();
    for view in read.frames.iter().filter_map(|frame| frame.view) {
        *of_view.entry(view).or_default() += 1;
    }
    let partial = of_view.values().filter(|&&count| count < states).count();
    let warning = format!(
        "{partial} of {} views are missing in some states: `carff train` accepts that, `carff launch` does not",
        of_view.len()
    );
    (partial > 0).then_some(warning)
}

/// Removes frames, and in a scenario their views, because it needs every view in every state.
fn drop_broken(read: &mut Transforms, broken: impl Fn(usize) -> bool) {
    let of_scenario = |frame: &Frame| frame.view.filter(|_| read.scenario.is_some());
    let views: BTreeSet<usize> =
        read.frames.iter().enumerate().filter(|(i, _)| broken(*i)).filter_map(|(_, f)| of_scenario(f)).collect();
    let mut index = 0..;
    let keep = |f: &Frame| index.next().is_some_and(|i| !broken(i)) && f.view.is_none_or(|v| !views.contains(&v));
    read.frames.retain(keep);
    let renumbered = |view: usize| (!views.contains(&view)).then(|| view - views.range(..view).count());
    if let Some(scenario) = &mut read.scenario {
        scenario.bev_view = scenario.bev_view.and_then(renumbered);
        read.frames.iter_mut().for_each(|f| f.view = f.view.and_then(renumbered));
    }
}
