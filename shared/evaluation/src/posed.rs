//! The posed images of one scenario with their labels: the input of training and evaluation.

use crate::EvaluationError;
use carff_dataset::{
    Dataset, Equivalence, Frame, Image, ImageComparison, NamedBox, Observability, PoseRole, PoseSplit, ScenarioInfo,
    StateInfo,
};
use carff_networks::decoder::IMAGE_PX;
use std::collections::HashMap;
use std::path::Path;
use tch::{Kind, Tensor};

const NO_SCENARIO: &str = "transforms.json has no `scenario`, which lists the states \
                           (`docs/book/src/dataset-format.md` has an example); a dataset of one scene is imported \
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
    /// Role of the pose in the split; `None` for a free pose.
    pub role: Option<PoseRole>,
}

/// Images, labels, split and equivalences of one scenario. The images of free poses follow those of the dataset;
/// their views are numbered after the dataset's views.
pub struct PosedImages {
    /// Dataset without the free poses.
    pub dataset: Dataset,
    /// Scenario of the dataset.
    pub scenario: ScenarioInfo,
    /// All images, in the order of their datasets.
    pub images: Vec<Image>,
    /// One label for each image.
    pub labels: Vec<Label>,
    /// Split of the dataset's poses.
    pub split: PoseSplit,
    /// Visual equivalence of states, for each view of the dataset: the truth, for evaluation.
    pub equivalence: Equivalence,
    /// Visual equivalence as the images show it, which training may use.
    pub seen_equivalence: Equivalence,
    /// The comparison of the dataset's images.
    comparison: ImageComparison,
    /// Standard deviation of the read noise of the dataset's images, of 255; 0 for images that are compared exactly.
    read_noise: f64,
    /// Number of the first view of each dataset of free poses, and its equivalence.
    random_equivalences: Vec<(usize, Equivalence)>,
    /// Rendered images of all states, for each view whose own images cannot be compared.
    rendered: HashMap<usize, Vec<usize>>,
    /// Mean image of each pose over the states in which a pixel is valid, `[V, 3, 128, 128]`, 0..=1.
    pub pose_means: Tensor,
    index: Vec<Option<usize>>,
}

impl PosedImages {
    /// Opens a dataset. It must have a scenario, and each frame must have a state and a view, which may be missing in
    /// some states.
    pub fn open(dir: &Path, split_seed: u64) -> Result<Self, EvaluationError> {
        let dataset = Dataset::open_partial(dir)?;
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
        let comparison = Equivalence::comparison(&dataset, &images);
        let seen_equivalence = Equivalence::from_images(&dataset, &images, comparison);
        let read_noise = match comparison {
            ImageComparison::Exact => 0.0,
            ImageComparison::ThroughNoise => carff_dataset::sensor::read_noise(&images),
        };
        let means: Vec<Tensor> = (0..dataset.view_count())
            .map(|view| {
                let of_view: Vec<usize> = (0..states).filter_map(|state| index[view * states + state]).collect();
                let targets: Vec<Tensor> = of_view.iter().map(|&i| target(&images[i])).collect();
                mean_of_valid(&Tensor::stack(&targets, 0), valid_targets(&dataset, &of_view).as_ref())
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
            seen_equivalence,
            comparison,
            read_noise,
            random_equivalences: Vec::new(),
            rendered: HashMap::new(),
            index,
        })
    }

    /// Adds the images of a dataset of free poses of the same scenario, in which the dynamic vehicle may look
    /// different. They are rendered, so they are compared exactly. Several calls add several datasets.
    pub fn add_free_poses(&mut self, dir: &Path) -> Result<(), EvaluationError> {
        let unfit = |what: &str| EvaluationError::Unfit(format!("{}: {what}", dir.display()));
        let free = Dataset::open(dir)?;
        if !free.scenario().is_some_and(|scenario| same_places(&self.scenario, scenario)) {
            return Err(unfit("this folder belongs to another scenario: remove it, and it is rendered again"));
        }
        let images = free.load_all_images()?;
        let first_view = self.view_count();
        let of_free = labels(&free, first_view, |_| None).map_err(|what| unfit(&what))?;
        let equivalence = Equivalence::from_images(&free, &images, ImageComparison::Exact);
        for (view, from) in self.rendered_poses(&free) {
            self.compare_rendered(view, from, &of_free, &images, &equivalence);
        }
        self.labels.extend(of_free);
        self.random_equivalences.push((first_view, equivalence));
        self.images.extend(images);
        Ok(())
    }

    /// Views of the dataset whose own images cannot be compared, each with the free pose that is the same.
    fn rendered_poses(&self, free: &Dataset) -> Vec<(usize, usize)> {
        let of = |frame: &Frame| frame.view.map(|view| (frame.camera.world_from_camera, view));
        let mut found: Vec<(usize, usize)> = Vec::new();
        let poses: Vec<_> = free.frames().iter().filter(|frame| frame.state == Some(0)).filter_map(of).collect();
        for (pose, view) in self.dataset.frames().iter().filter_map(of).filter(|(_, view)| !self.is_comparable(*view)) {
            if let Some((_, from)) = poses.iter().find(|(other, _)| same_pose(other, &pose)) {
                found.push((view, *from));
            }
        }
        found.sort_unstable();
        found.dedup();
        found
    }

    /// Compares rendered images of all states in place of a view's own images: which states look the same, the mean
    /// image, the pixels that change, and the visibility of the actor's place if the dataset does not name it.
    fn compare_rendered(
        &mut self,
        view: usize,
        from: usize,
        free: &[Label],
        images: &[Image],
        equivalence: &Equivalence,
    ) {
        let first_view = self.view_count();
        let of_view: Vec<usize> = (0..free.len()).filter(|&i| free[i].view == first_view + from).collect();
        self.seen_equivalence.adopt(view, equivalence, from);
        if !self.is_whole(view) && self.dataset.frames().iter().all(|frame| frame.alike_states.is_none()) {
            self.equivalence.adopt(view, equivalence, from);
        }
        for (label, frame) in self.labels.iter_mut().zip(self.dataset.frames()).filter(|(label, _)| label.view == view)
        {
            let rendered = of_view.iter().find(|&&i| free[i].state == label.state);
            if let (None, Some(&i)) = (frame.observability, rendered) {
                label.observability = free[i].observability;
            }
        }
        let targets: Vec<Tensor> = of_view.iter().map(|&i| target(&images[i])).collect();
        self.pose_means.get(view as i64).copy_(&mean_of_valid(&Tensor::stack(&targets, 0), None));
        self.rendered.insert(view, of_view.iter().map(|i| self.images.len() + i).collect());
    }

    /// Returns true if a view of the dataset has an image of every state.
    fn is_whole(&self, view: usize) -> bool {
        (0..self.scenario.state_count()).all(|state| self.at(state, view).is_some())
    }

    /// Returns true if the images of a view show which states look the same: an image of every state, without noise.
    fn is_comparable(&self, view: usize) -> bool {
        self.is_whole(view) && !self.is_of_camera()
    }

    /// Returns the first trained view that neither has an image of every state nor rendered images, which
    /// [`Self::add_free_poses`] adds.
    pub fn incomplete_view(&self) -> Option<usize> {
        let views = self.trained().into_iter().map(|i| self.labels[i].view);
        views.filter(|&view| !self.is_whole(view) && !self.rendered.contains_key(&view)).min()
    }

    /// Returns true if a camera took the images: they have noise, or poses that are missing in some states. Their poses
    /// then have errors. Images of one state show neither.
    pub fn is_of_camera(&self) -> bool {
        self.comparison == ImageComparison::ThroughNoise && self.scenario.state_count() > 1
    }

    /// Standard deviation of the read noise, of 255, that an image lacks compared with the dataset's: a rendered image has
    /// none. Where it is smaller than the dataset's images, these lose noise as they are reduced to the encoder's input.
    pub fn missing_noise(&self, image: usize) -> f64 {
        let of_dataset = self.images.first().map_or(0, |image| image.width_px);
        match self.labels[image].role {
            Some(_) => 0.0,
            None => self.read_noise * (f64::from(self.images[image].width_px) / f64::from(of_dataset.max(1))).min(1.0),
        }
    }

    /// Returns true if the images of each view show which states look the same: an image of every state, without noise.
    pub fn are_comparable(&self) -> bool {
        (0..self.dataset.view_count()).all(|view| self.is_comparable(view))
    }

    /// Images of the states from a view of the dataset: its own, or where these cannot be compared and rendered images
    /// were added, the rendered ones.
    pub fn of_view(&self, view: usize) -> Vec<usize> {
        match self.rendered.get(&view) {
            Some(rendered) => rendered.clone(),
            None => (0..self.scenario.state_count()).filter_map(|state| self.at(state, view)).collect(),
        }
    }

    /// Number of poses, including free poses.
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

    /// Images of [`Self::trained`] and of free poses.
    pub fn trained_and_random(&self) -> Vec<usize> {
        (0..self.labels.len()).filter(|&i| self.labels[i].role != Some(PoseRole::Unseen)).collect()
    }

    /// States that look the same as `state` from a view of the dataset, including `state`.
    pub fn equivalent_states(&self, view: usize, state: usize) -> Vec<usize> {
        self.equivalence.alike(view, state).collect()
    }

    /// States whose images from a view of the dataset or of a free pose look the same, including `state`.
    pub fn seen_alike(&self, view: usize, state: usize) -> Vec<usize> {
        match self.random_equivalences.iter().rev().find(|(first, _)| view >= *first) {
            Some((first, free)) => free.alike(view - first, state).collect(),
            None => self.seen_equivalence.alike(view, state).collect(),
        }
    }

    /// Returns true if no other state looks the same from the image's pose.
    pub fn is_unambiguous(&self, image: usize) -> bool {
        let label = self.labels[image];
        self.equivalent_states(label.view, label.state).len() == 1
    }

    /// Clean decoder targets `[N, 3, 128, 128]`, 0..=1.
    pub fn targets(&self, chosen: &[usize]) -> Tensor {
        Tensor::stack(&chosen.iter().map(|&i| target(&self.images[i])).collect::<Vec<_>>(), 0)
    }

    /// Flags of the valid pixels of decoder targets, `[N, 1, 128, 128]`, 0 or 1; `None` if all are valid.
    pub fn valid_targets(&self, chosen: &[usize]) -> Option<Tensor> {
        valid_targets(&self.dataset, chosen)
    }
}

/// Returns true for two poses that are equal up to the rounding of a transforms file.
fn same_pose(one: &[[f64; 4]; 4], other: &[[f64; 4]; 4]) -> bool {
    one.iter().flatten().zip(other.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-6)
}

fn valid_targets(dataset: &Dataset, chosen: &[usize]) -> Option<Tensor> {
    let all = || Tensor::ones([1, IMAGE_PX, IMAGE_PX], (Kind::Float, tch::Device::Cpu));
    let flags = |frame: &usize| {
        let Some(mask) = dataset.valid_pixels(*frame) else { return all() };
        let camera = &dataset.frames()[*frame].camera;
        let mask = Tensor::from_slice(&mask.iter().map(|&valid| f32::from(u8::from(valid))).collect::<Vec<_>>());
        // A pixel is valid if all pixels that it is made of are.
        at_target_size(&mask.view([1, 1, i64::from(camera.height_px), i64::from(camera.width_px)]))
            .ge(0.999)
            .to_kind(Kind::Float)
    };
    let masked = chosen.iter().any(|&frame| dataset.valid_pixels(frame).is_some());
    masked.then(|| Tensor::stack(&chosen.iter().map(flags).collect::<Vec<_>>(), 0))
}

/// Mean over the images `[N, 3, H, W]` in which a pixel is valid, and over all images where it is valid in none.
fn mean_of_valid(images: &Tensor, valid: Option<&Tensor>) -> Tensor {
    let over_images = |t: &Tensor| t.sum_dim_intlist([0_i64].as_slice(), false, Kind::Float);
    let mean = images.mean_dim([0_i64].as_slice(), false, Kind::Float);
    let Some(valid) = valid else { return mean };
    let count = over_images(valid);
    (over_images(&(images * valid)) / count.clamp_min(1.0)).where_self(&count.gt(0.0), &mean)
}

/// Returns true if both scenarios have the same states, with a box at the same place of the ground for each box of the
/// other.
fn same_places(one: &ScenarioInfo, other: &ScenarioInfo) -> bool {
    let near = |a: &NamedBox, b: &NamedBox| {
        let (a, b) = (a.oriented_box.center, b.oriented_box.center);
        (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-3
    };
    let same = |(a, b): (&StateInfo, &StateInfo)| {
        let boxes = a.boxes.len() == b.boxes.len() && a.boxes.iter().zip(&b.boxes).all(|(a, b)| near(a, b));
        (a.branch, a.timestamp) == (b.branch, b.timestamp) && boxes
    };
    one.name == other.name && one.states.len() == other.states.len() && one.states.iter().zip(&other.states).all(same)
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
        Ok(Label { state, view: first_view + view, observability, role: role(view) })
    };
    dataset.frames().iter().enumerate().map(label).collect()
}

/// Decoder target of one image `[3, 128, 128]`, 0..=1.
fn target(image: &Image) -> Tensor {
    let bytes = Tensor::from_slice(&image.rgb).view([1, i64::from(image.height_px), i64::from(image.width_px), 3]);
    at_target_size(&carff_networks::encoder::images_from_bytes(&bytes))
}

/// Resizes one image `[1, C, H, W]` to `[C, 128, 128]`.
fn at_target_size(image: &Tensor) -> Tensor {
    let image = if image.size()[2] == IMAGE_PX && image.size()[3] == IMAGE_PX {
        image.shallow_clone()
    } else {
        image.internal_upsample_bilinear2d_aa([IMAGE_PX, IMAGE_PX], false, None, None)
    };
    image.squeeze_dim(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::OrientedBox;

    /// A pixel's mean is over the images in which it is valid, and over all where it is valid in none.
    #[test]
    fn means_are_of_valid_pixels() {
        let images = Tensor::from_slice(&[0.2_f32, 0.4, 0.6, 0.8, 1.0, 0.0]).view([2, 1, 1, 3]);
        let valid = Tensor::from_slice(&[1.0_f32, 1.0, 0.0, 1.0, 0.0, 0.0]).view([2, 1, 1, 3]);
        let mean = mean_of_valid(&images, Some(&valid));
        assert!(mean.allclose(&Tensor::from_slice(&[0.5_f32, 0.4, 0.3]).view([1, 1, 3]), 1e-6, 1e-6, false));
    }

    /// Another vehicle at the same places is the same scenario; a vehicle at another place, and another number of states,
    /// is not.
    #[test]
    fn appearances_keep_their_places() {
        let named = |at: [f64; 3], size_m: f64| NamedBox {
            name: "actor".into(),
            role: None,
            oriented_box: OrientedBox { center: at, half_size: [size_m; 3], yaw: 0.0 },
            dynamic: true,
        };
        let scenario = |states: usize, at: [f64; 3], size_m: f64| ScenarioInfo {
            name: "small".into(),
            bounds: [[-9.0; 3], [9.0; 3]],
            branches: vec!["moves".into()],
            timestamps: states,
            step_s: None,
            bev_view: None,
            states: (0..states)
                .map(|timestamp| StateInfo { branch: 0, timestamp, boxes: vec![named(at, size_m)] })
                .collect(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        let own = scenario(2, [1.0, 2.0, 0.9], 0.9);
        assert!(same_places(&own, &own) && same_places(&own, &scenario(2, [1.0, 2.0, 1.2], 1.2)));
        assert!(!same_places(&own, &scenario(2, [1.5, 2.0, 0.9], 0.9)));
        assert!(!same_places(&own, &scenario(3, [1.0, 2.0, 0.9], 0.9)));
    }
}
