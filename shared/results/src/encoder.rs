//! Table 2: what the decoder draws, and what the latents tell.

use crate::subject::{ROLES, Subject};
use carff_dataset::PoseRole;
use carff_evaluation::svm::{cross_validated, fit_and_name, grouped_folds, stratified_folds};
use carff_messages::LATENT_DIM;
use carff_training::{
    accuracy::{ByObservability, Centroids, Share, state_accuracy},
    vae::{DecodedQuality, decoded_quality},
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Folds of the support vector machine's cross-validation (the paper's number).
pub const FOLDS: usize = 10;
/// Most pictures that are decoded from other poses than they were seen from.
const MOST_TURNED: usize = 600;

/// Encoder and decoder of one checkpoint. A row of the ablation table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EncoderTable {
    /// The decoder on the pictures of trained poses, each from the posterior mean of the picture itself.
    pub train: DecodedQuality,
    /// The decoder on trained poses, each from the posterior mean of a picture of the same state from another pose: what
    /// the latent tells of the state alone. Inputs are pictures that look like no other state's.
    pub novel_view: DecodedQuality,
    /// Support vector machine on posterior means.
    pub svm: SvmTable,
    /// State accuracy of the nearest centroid, up to what looks the same, by part of the poses (`trained`, `calibration`,
    /// `unseen`) and how much is seen of the actor's place. Absent where some state is shown fully by no trained pose.
    pub state_accuracy: BTreeMap<String, ByObservability>,
}

/// Scores of the support vector machine (RBF, C = 1, gamma = 1 / (8 variance)).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SvmTable {
    /// All trained poses, 10 folds drawn by picture, as the paper does it. Of states that are one picture, the doubles of
    /// a picture that is left out stay in, under other names: that keeps the accuracy below its ceiling.
    pub trained: SvmScore,
    /// The same with 10 folds drawn by pose: no double stays in, and the pose is new to the machine.
    pub trained_by_pose: SvmScore,
    /// Poses never trained on; fitted on all trained ones.
    pub unseen: SvmScore,
}

/// Right answers of the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SvmScore {
    /// Share of states named right, 0..=1.
    pub accuracy: f64,
    /// What is to be expected at best of that, since some states are one picture, 0..=1.
    pub ceiling: f64,
    /// Share of states named right up to what looks the same, 0..=1.
    pub up_to_equivalence: f64,
    /// Pictures.
    pub pictures: usize,
}

impl From<Share> for SvmScore {
    fn from(share: Share) -> Self {
        Self {
            accuracy: share.raw(),
            ceiling: share.ceiling(),
            up_to_equivalence: share.accuracy(),
            pictures: share.trials,
        }
    }
}

/// Scores encoder and decoder.
pub fn encoder_table(subject: &Subject) -> EncoderTable {
    let pictures = &subject.pictures;
    let quality =
        |pairs: &[(usize, [f32; LATENT_DIM])]| decoded_quality(pictures, &subject.decoder, subject.residual(), pairs);
    let own: Vec<_> = pictures.trained().into_iter().map(|i| (i, subject.posteriors[i].mean)).collect();
    let mut table = EncoderTable {
        train: quality(&own),
        novel_view: quality(&turned(subject)),
        svm: svm(subject),
        state_accuracy: BTreeMap::new(),
    };
    if let Some(centroids) = Centroids::fit(pictures, &subject.posteriors) {
        for (role, name) in ROLES {
            let chosen = pictures.with_roles(&[role]);
            let accuracy = state_accuracy(pictures, &subject.posteriors, &centroids, &chosen);
            table.state_accuracy.insert(name.to_owned(), accuracy);
        }
    }
    table
}

/// Pictures of trained poses, each with the posterior mean of another pose's picture of the same state: of the next
/// pose in turn whose picture of it looks like no other state's.
fn turned(subject: &Subject) -> Vec<(usize, [f32; LATENT_DIM])> {
    let pictures = &subject.pictures;
    let trained = pictures.trained();
    let tells = |i: usize| pictures.alike(pictures.labels[i].view, pictures.labels[i].state).len() == 1;
    let mut inputs = vec![Vec::new(); pictures.scenario.state_count()];
    for &i in trained.iter().filter(|i| tells(**i)) {
        inputs[pictures.labels[i].state].push(i);
    }
    let mut pairs = Vec::new();
    for (turn, i) in crate::pictures::spread(&trained, MOST_TURNED).into_iter().enumerate() {
        let of_state = &inputs[pictures.labels[i].state];
        let other = (0..of_state.len())
            .map(|k| of_state[(turn * 7 + k) % of_state.len()])
            .find(|&j| pictures.labels[j].view != pictures.labels[i].view);
        pairs.extend(other.map(|j| (i, subject.posteriors[j].mean)));
    }
    pairs
}

fn svm(subject: &Subject) -> SvmTable {
    let pictures = &subject.pictures;
    let pick = |chosen: &[usize]| -> (Vec<_>, Vec<usize>) {
        chosen.iter().map(|&i| (subject.posteriors[i].mean, pictures.labels[i].state)).unzip()
    };
    let score = |chosen: &[usize], named: &[usize]| {
        let mut share = Share::default();
        for (&i, &name) in chosen.iter().zip(named) {
            let label = pictures.labels[i];
            let alike = pictures.alike(label.view, label.state);
            share.count(alike.contains(&name), name == label.state, alike.len());
        }
        SvmScore::from(share)
    };
    let (trained, unseen) = (pictures.trained(), pictures.with_roles(&[PoseRole::Unseen]));
    let (rows, states) = pick(&trained);
    let views: Vec<usize> = trained.iter().map(|&i| pictures.labels[i].view).collect();
    let seed = subject.options.seed;
    SvmTable {
        trained: score(&trained, &cross_validated(&rows, &states, &stratified_folds(&states, FOLDS, seed))),
        trained_by_pose: score(&trained, &cross_validated(&rows, &states, &grouped_folds(&views, FOLDS, seed))),
        unseen: score(&unseen, &fit_and_name(&rows, &states, &pick(&unseen).0)),
    }
}
