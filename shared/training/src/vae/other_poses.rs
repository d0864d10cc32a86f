//! Reconstruction at other poses: the images that the decoder is asked for when the encoder saw another pose of the same
//! state (paper section 3.1).

use super::{indices, losses::reconstruction_error};
use crate::config::VaeTraining;
use carff_evaluation::PosedImages;
use carff_networks::decoder::{SMALL_PX, SmallDecoder};
use rand::Rng;
use tch::{Device, Kind, Tensor};

/// Small images of the dataset's trained poses, and where to find those of a state.
pub struct OtherPoses {
    /// `[N, 3, 32, 32]`, 0..=1.
    targets: Tensor,
    /// Mean images of the poses, `[V, 3, 32, 32]`.
    means: Tensor,
    /// `[N, 1, 32, 32]`, 0 or 1.
    valid: Option<Tensor>,
    /// Pose of each row of `targets`.
    views: Vec<usize>,
    /// Rows of each state.
    by_state: Vec<Vec<usize>>,
}

impl OtherPoses {
    /// Shrinks the images of the trained poses.
    pub fn new(posed: &PosedImages, device: Device) -> Self {
        let trained = posed.trained();
        let small = |t: Tensor| t.internal_upsample_bilinear2d_aa([SMALL_PX, SMALL_PX], false, None, None);
        let mut by_state = vec![Vec::new(); posed.scenario.state_count()];
        for (row, &i) in trained.iter().enumerate() {
            by_state[posed.labels[i].state].push(row);
        }
        Self {
            targets: small(posed.targets(&trained)).to_device(device),
            means: small(posed.pose_means.shallow_clone()).to_device(device),
            valid: posed
                .valid_targets(&trained)
                .map(|valid| small(valid).ge(0.999).to_kind(Kind::Float).to_device(device)),
            views: trained.iter().map(|&i| posed.labels[i].view).collect(),
            by_state,
        }
    }

    /// Draws `count` rows of a state whose pose is not `view`; fewer if the state has no other pose.
    fn draw(&self, state: usize, view: usize, count: usize, rng: &mut impl Rng) -> Vec<usize> {
        let others: Vec<usize> = self.by_state[state].iter().copied().filter(|&row| self.views[row] != view).collect();
        (0..if others.is_empty() { 0 } else { count }).map(|_| others[rng.random_range(0..others.len())]).collect()
    }

    /// Weighted squared error of `decoder` at `settings.other_poses` poses for each of the inputs, (state, view) with
    /// one row of `latents` each. `None` if no input's state is seen from another pose.
    pub fn error(
        &self,
        decoder: &SmallDecoder,
        latents: &Tensor,
        inputs: &[(usize, usize)],
        settings: &VaeTraining,
        rng: &mut impl Rng,
    ) -> Option<Tensor> {
        let (mut of_input, mut rows) = (Vec::new(), Vec::new());
        for (input, &(state, view)) in inputs.iter().enumerate() {
            let drawn = self.draw(state, view, settings.other_poses, rng);
            of_input.extend(drawn.iter().map(|_| input));
            rows.extend(drawn);
        }
        if rows.is_empty() {
            return None;
        }
        let device = latents.device();
        let views = indices(rows.iter().map(|&row| self.views[row]), device);
        let rows = indices(rows, device);
        let made = decoder.forward(&latents.index_select(0, &indices(of_input, device)), &views);
        let valid = self.valid.as_ref().map(|valid| valid.index_select(0, &rows));
        let (targets, means) = (self.targets.index_select(0, &rows), self.means.index_select(0, &views));
        Some(reconstruction_error(&made, &targets, &means, valid.as_ref(), settings))
    }
}
