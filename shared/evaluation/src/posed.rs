//! The posed images of one scenario with their labels: the input of training and evaluation.

use crate::EvaluationError;
use carff_dataset::{Dataset, Equivalence, Frame, Image, Observability, PoseRole, PoseSplit, ScenarioInfo};
use carff_networks::decoder::PICTURE_PX;
use std::path::Path;
use tch::{Kind, Tensor};

const NO_SCENARIO: &str = "transforms.json has no `scenario`, which lists the states \
                           (`docs/book/src/sets-of-pictures.md` has an example); a dataset of one scene is imported \
                           without it: `carff dataset import`";

/// Label of one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Label {
    /// State that it shows.
    pub state: usize,
    /// Camera pose.
    pub view: usize,
    /// Visibility of the actor's place; full where the dataset does not name it.
    pub observability: Observability,
    /// Visible fraction of the actor's place, 0..=1; where unknown, 1, 0.5 or 0 by observability.
    pub visible_fraction: f32,
    /// Role of the pose in the split; `None` for a random pose.
    pub role: Option<PoseRole>,
}

/// Images, labels, split and equivalences of one scenario. The images of random poses follow those of the dataset;
/// their views are numbered after the dataset's views.
pub struct PosedImages {
    /// Dataset without the random poses.
    pub dataset: Dataset,
    /// Scenario of the dataset.
    pub scenario: ScenarioInfo,
    /// All images, in the order of their datasets.
    pub images: Vec<Image>,
    /// One label for each image.
    pub labels: Vec<Label>,
    /// Split of the dataset's poses.
    pub split: PoseSplit,
    /// Visual equivalence of states, for each view of the dataset.
    pub equivalence: Equivalence,
    random_equivalence: Option<Equivalence>,
    /// Mean image of each pose over all states, `[V, 3, 128, 128]`, 0..=1.
    pub pose_means: Tensor,
    index: Vec<Option<usize>>,
}

impl PosedImages {
    /// Opens a dataset. It must have a scenario, and each frame must have a state and a view.
    pub fn open(dir: &Path, split_seed: u64) -> Result<Self, EvaluationError> {
        let dataset = Dataset::open(dir)?;
        let unfit = |what: &str| EvaluationError::Unfit(format!("{}: {what}", dir.display()));
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
            random_equivalence: None,
            index,
        })
    }

    /// Adds the images of a dataset of random poses of the same scenario.
    pub fn add_random_poses(&mut self, dir: &Path) -> Result<(), EvaluationError> {
        let unfit = |what: &str| EvaluationError::Unfit(format!("{}: {what}", dir.display()));
        let free = Dataset::open(dir)?;
        let same = free.scenario().is_some_and(|s| s.name == self.scenario.name && s.states == self.scenario.states);
        if !same {
            return Err(unfit("this folder belongs to another scenario: remove it, and it is rendered again"));
        }
        let images = free.load_all_images()?;
        self.labels.extend(labels(&free, self.dataset.view_count(), |_| None).map_err(|what| unfit(&what))?);
        self.random_equivalence = Some(Equivalence::from_dataset(&free, &images));
        self.images.extend(images);
        Ok(())
    }

    /// Number of poses, including random poses.
    pub fn view_count(&self) -> usize {
        self.labels.iter().map(|l| l.view + 1).max().unwrap_or(0)
    }

    /// Image of a state from a pose of the dataset.
    pub fn at(&self, state: usize, view: usize) -> Option<usize> {
        let states = self.scenario.state_count();
        (state < states).then(|| self.index.get(view * states + state).copied().flatten()).flatten()
    }

    /// Images whose pose has one of `roles`.
    pub fn with_roles(&self, roles: &[PoseRole]) -> Vec<usize> {
        (0..self.labels.len()).filter(|&i| self.labels[i].role.is_some_and(|role| roles.contains(&role))).collect()
    }

    /// Images of the dataset that training may use: all except those of held-out poses.
    pub fn trained(&self) -> Vec<usize> {
        self.with_roles(&[PoseRole::Rest, PoseRole::Calibration])
    }

    /// Images of [`Self::trained`] and of random poses.
    pub fn trained_and_random(&self) -> Vec<usize> {
        (0..self.labels.len()).filter(|&i| self.labels[i].role != Some(PoseRole::Unseen)).collect()
    }

    /// States that look the same as `state` from a view, including `state`.
    pub fn equivalent_states(&self, view: usize, state: usize) -> Vec<usize> {
        let poses = self.dataset.view_count();
        match &self.random_equivalence {
            Some(free) if view >= poses => free.alike(view - poses, state).collect(),
            _ => self.equivalence.alike(view, state).collect(),
        }
    }

    /// Returns true if no other state looks the same from the image's pose.
    pub fn is_unambiguous(&self, image: usize) -> bool {
        let label = self.labels[image];
        self.equivalent_states(label.view, label.state).len() == 1
    }

    /// Per state, the unambiguous images of trained and random poses. The posterior of any other image correctly lies
    /// between states. A state without an unambiguous image has the images that show at least half of the actor's
    /// place.
    pub fn unambiguous_by_state(&self) -> Vec<Vec<usize>> {
        let mut by_state = vec![Vec::new(); self.scenario.state_count()];
        let mut fallback = by_state.clone();
        for i in self.trained_and_random() {
            let label = self.labels[i];
            if self.is_unambiguous(i) {
                by_state[label.state].push(i);
            } else if label.visible_fraction >= 0.5 {
                fallback[label.state].push(i);
            }
        }
        by_state.into_iter().zip(fallback).map(|(own, rest)| if own.is_empty() { rest } else { own }).collect()
    }

    /// Clean decoder targets `[N, 3, 128, 128]`, 0..=1.
    pub fn targets(&self, chosen: &[usize]) -> Tensor {
        Tensor::stack(&chosen.iter().map(|&i| target(&self.images[i])).collect::<Vec<_>>(), 0)
    }
}

/// Labels of a dataset with views numbered from `first_view`. The error names what a frame lacks.
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

/// Decoder target of one image `[3, 128, 128]`, 0..=1.
fn target(image: &Image) -> Tensor {
    let bytes = Tensor::from_slice(&image.rgb).view([1, i64::from(image.height_px), i64::from(image.width_px), 3]);
    let image = carff_networks::encoder::pictures_from_bytes(&bytes);
    let image = if image.size()[2] == PICTURE_PX && image.size()[3] == PICTURE_PX {
        image
    } else {
        image.internal_upsample_bilinear2d_aa([PICTURE_PX, PICTURE_PX], false, None, None)
    };
    image.squeeze_dim(0)
}
