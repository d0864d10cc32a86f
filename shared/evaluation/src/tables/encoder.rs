//! Encoder table: decoder images, support vector machine, and state accuracy (paper table 2).

use super::spread;
use crate::accuracy::{Centroids, state_accuracy};
use crate::stats::svm::{cross_validated, fit_and_name, grouped_folds, stratified_folds};
use crate::{ByRole, DecodedQuality, ROLES, Subject};
use carff_dataset::PoseRole;
use carff_messages::LATENT_DIM;
use carff_trials::{ByObservability, Share};
use serde::{Deserialize, Serialize};

/// Folds of the support vector machine's cross-validation (the paper's number).
const FOLDS: usize = 10;
/// Largest number of images that are decoded from the latent of another pose.
const MOST_NOVEL_VIEWS: usize = 600;

/// Scores of encoder and decoder: a row of the ablation table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderTable {
    /// Decoder on the images of trained poses, each from its own posterior mean.
    pub train: DecodedQuality,
    /// Decoder on trained poses, each from the posterior mean of an unambiguous image of the same state from another
    /// pose: only the state of the latent counts.
    pub novel_view: DecodedQuality,
    /// Support vector machine on posterior means.
    pub svm: SvmTable,
    /// State accuracy of the nearest centroid, up to visual equivalence, by role of the pose and visibility of the
    /// actor's place. Empty where a state has no image from a trained pose.
    pub state_accuracy: ByRole<ByObservability>,
}

/// Scores of the support vector machine (RBF, C = 1, gamma = 1 / (8 variance)).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SvmTable {
    /// All trained poses, 10 folds drawn by image, as in the paper. Duplicates of a left-out image, under the names of
    /// equivalent states, stay in the training folds and keep the accuracy below its ceiling.
    pub trained: SvmScore,
    /// All trained poses, 10 folds drawn by pose: no duplicate stays in, and the pose is new to the machine.
    pub trained_by_pose: SvmScore,
    /// Held-out poses; fitted on all trained poses.
    pub unseen: SvmScore,
}

/// Scores of the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SvmScore {
    /// Exact-state accuracy, 0..=1.
    pub accuracy: f64,
    /// Upper bound of the accuracy, since some states are one image, 0..=1.
    pub ceiling: f64,
    /// Accuracy up to visual equivalence, 0..=1.
    pub up_to_equivalence: f64,
    /// Images.
    pub images: usize,
}

impl From<Share> for SvmScore {
    fn from(share: Share) -> Self {
        Self {
            accuracy: share.raw(),
            ceiling: share.ceiling(),
            up_to_equivalence: share.accuracy(),
            images: share.trials,
        }
    }
}

/// Scores encoder and decoder.
pub fn encoder_table(subject: &Subject) -> EncoderTable {
    let posed = &subject.posed;
    let own: Vec<_> = posed.trained().into_iter().map(|i| (i, subject.posteriors[i].mean)).collect();
    let mut table = EncoderTable {
        train: subject.decoding().quality(&own),
        novel_view: subject.decoding().quality(&from_other_poses(subject)),
        svm: svm(subject),
        state_accuracy: ByRole::default(),
    };
    if let Some(centroids) = Centroids::fit(posed, &subject.posteriors) {
        for role in ROLES {
            let chosen = posed.with_roles(&[role]);
            table.state_accuracy.set(role, state_accuracy(posed, &subject.posteriors, &centroids, &chosen));
        }
    }
    table
}

/// Images of trained poses, each with the posterior mean of an unambiguous image of the same state from another pose.
/// Other poses are taken in rotation.
fn from_other_poses(subject: &Subject) -> Vec<(usize, [f32; LATENT_DIM])> {
    let posed = &subject.posed;
    let trained = posed.trained();
    let mut inputs = vec![Vec::new(); posed.scenario.state_count()];
    for &i in trained.iter().filter(|i| posed.is_unambiguous(**i)) {
        inputs[posed.labels[i].state].push(i);
    }
    let mut pairs = Vec::new();
    for (turn, i) in spread(&trained, MOST_NOVEL_VIEWS).into_iter().enumerate() {
        let of_state = &inputs[posed.labels[i].state];
        let other = (0..of_state.len())
            .map(|k| of_state[(turn * 7 + k) % of_state.len()])
            .find(|&j| posed.labels[j].view != posed.labels[i].view);
        pairs.extend(other.map(|j| (i, subject.posteriors[j].mean)));
    }
    pairs
}

fn svm(subject: &Subject) -> SvmTable {
    let posed = &subject.posed;
    let pick = |chosen: &[usize]| -> (Vec<_>, Vec<usize>) {
        chosen.iter().map(|&i| (subject.posteriors[i].mean, posed.labels[i].state)).unzip()
    };
    let score = |chosen: &[usize], named: &[usize]| {
        let mut share = Share::default();
        for (&i, &name) in chosen.iter().zip(named) {
            let label = posed.labels[i];
            let equivalent = posed.equivalent_states(label.view, label.state);
            share.count(equivalent.contains(&name), name == label.state, equivalent.len());
        }
        SvmScore::from(share)
    };
    let (trained, unseen) = (posed.trained(), posed.with_roles(&[PoseRole::Unseen]));
    let (rows, states) = pick(&trained);
    let views: Vec<usize> = trained.iter().map(|&i| posed.labels[i].view).collect();
    let seed = subject.options.seed;
    SvmTable {
        trained: score(&trained, &cross_validated(&rows, &states, &stratified_folds(&states, FOLDS, seed))),
        trained_by_pose: score(&trained, &cross_validated(&rows, &states, &grouped_folds(&views, FOLDS, seed))),
        unseen: score(&unseen, &fit_and_name(&rows, &states, &pick(&unseen).0)),
    }
}
