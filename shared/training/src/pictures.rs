//! The posed pictures of one scenario as tensors: what every training loop reads.

use crate::{TrainingError, config::Augmentation};
use carff_dataset::{Dataset, Equivalence, Frame, Image, Observability, PoseRole, PoseSplit, ScenarioInfo, sensor};
use carff_models::decoder::PICTURE_PX;
use carff_random::Key;
use rand::Rng;
use std::path::Path;
use tch::{Kind, Tensor};

const NO_SCENARIO: &str = "transforms.json has no `scenario`, which says what states there are (docs/book/src/sets-of-pictures.md \
                           shows one); a set of one scene can be imported without: `carff dataset import`";

/// What is known of one picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Label {
    /// State index.
    pub state: usize,
    /// Fixed pose.
    pub view: usize,
    /// How much of the actor's place it shows; sets that do not say count as fully observable.
    pub observability: Observability,
    /// Visible fraction, where known; else 1, 0.5 or 0 by observability.
    pub visible_fraction: f32,
    /// Part of the pose in the split; none for a freely drawn pose.
    pub role: Option<PoseRole>,
}

/// A scenario's pictures, labels, split and equivalences: those of a data set, and behind them those of freely drawn
/// poses, whose views are numbered on.
pub struct Pictures {
    /// The data set.
    pub dataset: Dataset,
    /// Its scenario.
    pub scenario: ScenarioInfo,
    /// All pictures, in the sets' order.
    pub images: Vec<Image>,
    /// What is known of each.
    pub labels: Vec<Label>,
    /// The split of the poses.
    pub split: PoseSplit,
    /// Which states look the same in which view of the data set.
    pub equivalence: Equivalence,
    free_equivalence: Option<Equivalence>,
    /// Per pose the mean over all states, `[V, 3, 128, 128]`, 0..=1.
    pub pose_means: Tensor,
    index: Vec<Option<usize>>,
}

impl Pictures {
    /// Opens a set; it must say its scenario, and every picture its state and view.
    pub fn open(dir: &Path, split_seed: u64) -> Result<Self, TrainingError> {
        let dataset = Dataset::open(dir)?;
        let unfit = |what: &str| TrainingError::Unfit(format!("{}: {what}", dir.display()));
        let scenario = dataset.scenario().cloned().ok_or_else(|| unfit(NO_SCENARIO))?;
        let images = dataset.load_all_images()?;
        let split = PoseSplit::for_dataset(&dataset, split_seed);
        let labels = labels(&dataset, 0, |view| Some(split.role(view))).map_err(|what| unfit(&what))?;
        let states = dataset.state_count();
        let mut index = vec![None; states * dataset.view_count()];
        for (i, label) in labels.iter().enumerate() {
            index[label.view * states + label.state] = Some(i);
        }
        let equivalence = Equivalence::from_dataset(&dataset, &images);
        let means: Vec<Tensor> = (0..dataset.view_count())
            .map(|view| {
                let of_view: Vec<Tensor> =
                    (0..states).filter_map(|state| index[view * states + state]).map(|i| target(&images[i])).collect();
                Tensor::stack(&of_view, 0).mean_dim([0_i64].as_slice(), false, Kind::Float)
            })
            .collect();
        Ok(Self {
            pose_means: Tensor::stack(&means, 0),
            dataset,
            scenario,
            images,
            labels,
            split,
            equivalence,
            free_equivalence: None,
            index,
        })
    }

    /// Adds the pictures of a set of freely drawn poses of the same scenario.
    pub fn add_free(&mut self, dir: &Path) -> Result<(), TrainingError> {
        let unfit = |what: &str| TrainingError::Unfit(format!("{}: {what}", dir.display()));
        let free = Dataset::open(dir)?;
        let same = free.scenario().is_some_and(|s| s.name == self.scenario.name && s.states == self.scenario.states);
        if !same {
            return Err(unfit("another scenario than the data set's: remove the folder, it is rendered again"));
        }
        let images = free.load_all_images()?;
        self.labels.extend(labels(&free, self.dataset.view_count(), |_| None).map_err(|what| unfit(&what))?);
        self.free_equivalence = Some(Equivalence::from_dataset(&free, &images));
        self.images.extend(images);
        Ok(())
    }

    /// Number of poses, the freely drawn ones among them.
    pub fn view_count(&self) -> usize {
        self.labels.iter().map(|l| l.view + 1).max().unwrap_or(0)
    }

    /// The picture of a state from a pose of the data set.
    pub fn at(&self, state: usize, view: usize) -> Option<usize> {
        let states = self.scenario.state_count();
        (state < states).then(|| self.index.get(view * states + state).copied().flatten()).flatten()
    }

    /// The pictures whose pose has one of `roles`.
    pub fn with_roles(&self, roles: &[PoseRole]) -> Vec<usize> {
        (0..self.labels.len()).filter(|&i| self.labels[i].role.is_some_and(|role| roles.contains(&role))).collect()
    }

    /// The data set's pictures that training may use: all but those of unseen poses.
    pub fn trained(&self) -> Vec<usize> {
        self.with_roles(&[PoseRole::Rest, PoseRole::Calibration])
    }

    /// As [`Self::trained`], and those of freely drawn poses.
    pub fn trained_and_free(&self) -> Vec<usize> {
        (0..self.labels.len()).filter(|&i| self.labels[i].role != Some(PoseRole::Unseen)).collect()
    }

    /// The states that look the same as `state` in a view, itself among them.
    pub fn alike(&self, view: usize, state: usize) -> Vec<usize> {
        let poses = self.dataset.view_count();
        match &self.free_equivalence {
            Some(free) if view >= poses => free.alike(view - poses, state).collect(),
            _ => self.equivalence.alike(view, state).collect(),
        }
    }

    /// The state that follows: the next timestamp of the branch; the last one follows itself.
    pub fn next_state(&self, state: usize) -> usize {
        if (state + 1).is_multiple_of(self.scenario.timestamps) { state } else { state + 1 }
    }

    /// Clean decoder targets `[N, 3, 128, 128]`, 0..=1.
    pub fn targets(&self, pictures: &[usize]) -> Tensor {
        Tensor::stack(&pictures.iter().map(|&i| target(&self.images[i])).collect::<Vec<_>>(), 0)
    }

    /// Encoder inputs `[N, 3, H, W]`, 0..=1: altered copy number `copy` of each picture. Copy 0 has sensor noise
    /// alone; the same seed gives the same copies.
    pub fn inputs(&self, pictures: &[usize], copy: usize, augmentation: &Augmentation, seed: u64) -> Tensor {
        let mut planes = Vec::with_capacity(pictures.len());
        let mut affine = Vec::with_capacity(pictures.len() * 6);
        for &i in pictures {
            let image = &self.images[i];
            let key = Key { seed, frame: i as u64, step: copy as u32, sample: 0 };
            let mut noisy = vec![0_u8; image.rgb.len()];
            if sensor::apply_noise_into(&image.rgb, &mut noisy, &augmentation.sensor, key).is_err() {
                // The configuration was validated and the lengths are equal: nothing is left that could be wrong.
                noisy.copy_from_slice(&image.rgb);
            }
            planes.push(Tensor::from_slice(&noisy).view([1, i64::from(image.height_px), i64::from(image.width_px), 3]));
            let mut rng = carff_random::stream(Key { sample: 1, ..key });
            let mut within = |limit: f64| if limit > 0.0 { rng.random_range(-limit..=limit) } else { 0.0 };
            let (angle, zoom) = (within(augmentation.rotation_deg).to_radians(), 1.0 + within(augmentation.zoom));
            let (dx, dy) = (2.0 * within(augmentation.shift), 2.0 * within(augmentation.shift));
            let (s, c) = (angle.sin() * zoom, angle.cos() * zoom);
            affine.extend([c, -s, dx, s, c, dy].map(|v| v as f32));
        }
        let one_size = planes.windows(2).all(|pair| pair[0].size() == pair[1].size());
        let pictures = if one_size {
            carff_models::encoder::pictures_from_bytes(&Tensor::cat(&planes, 0))
        } else {
            // Sets may mix sizes: a batch takes that of its first picture.
            let size = planes[0].size();
            let resized = planes.iter().map(|plane| {
                let picture = carff_models::encoder::pictures_from_bytes(plane);
                picture.internal_upsample_bilinear2d_aa([size[1], size[2]], false, None, None)
            });
            Tensor::cat(&resized.collect::<Vec<_>>(), 0)
        };
        if copy == 0 {
            return pictures;
        }
        let size = pictures.size();
        let theta = Tensor::from_slice(&affine).view([-1, 2, 3]);
        let grid = Tensor::affine_grid_generator(&theta, size.as_slice(), false);
        // Bilinear (0), edge pixels repeated (1).
        pictures.grid_sampler(&grid, 0, 1, false)
    }
}

/// What a set knows of its pictures, views numbered from `first_view`; or what a frame lacks.
fn labels(
    dataset: &Dataset,
    first_view: usize,
    role: impl Fn(usize) -> Option<PoseRole>,
) -> Result<Vec<Label>, String> {
    let label = |(i, frame): (usize, &Frame)| {
        let (Some(state), Some(view)) = (frame.state, frame.view) else {
            return Err(format!("frames[{i}] lacks `branch` and `timestamp`, or `view_id`"));
        };
        let observability = frame.observability.unwrap_or(Observability::Full);
        let by_kind = match observability {
            Observability::Full => 1.0,
            Observability::Partial => 0.5,
            Observability::None => 0.0,
        };
        let visible_fraction = frame.visible_fraction.unwrap_or(by_kind);
        Ok(Label { state, view: first_view + view, observability, visible_fraction, role: role(view) })
    };
    dataset.frames().iter().enumerate().map(label).collect()
}

/// One picture as a decoder target `[3, 128, 128]`, 0..=1.
fn target(image: &Image) -> Tensor {
    let bytes = Tensor::from_slice(&image.rgb).view([1, i64::from(image.height_px), i64::from(image.width_px), 3]);
    let picture = carff_models::encoder::pictures_from_bytes(&bytes);
    let picture = if picture.size()[2] == PICTURE_PX && picture.size()[3] == PICTURE_PX {
        picture
    } else {
        picture.internal_upsample_bilinear2d_aa([PICTURE_PX, PICTURE_PX], false, None, None)
    };
    picture.squeeze_dim(0)
}
