//! Encoder inputs of the VAE's training.

use super::{Vae, indices};
use crate::{
    TrainingError,
    augmentation::Augmentation,
    features::{self, FeatureFile},
    records::names,
    run::Context,
};
use carff_dataset::sensor::SensorNoise;
use carff_evaluation::Progress;
use carff_messages::Gaussian;
use carff_networks::encoder::gaussians;
use tch::{Kind, Tensor};

/// Encoder inputs of all images, as backbone features where these can be kept.
///
/// Every image has `augmentation.copies` + 1 copies. Training images of the dataset's own poses have
/// `augmentation.own_copies` more, the first of them unchanged.
pub struct Inputs<'a> {
    context: Context<'a>,
    /// For each image, its place among those with further copies.
    own: Vec<Option<usize>>,
    own_count: usize,
    features: Option<Tensor>,
}

/// Images through the backbone at a time: the fastest of 1, 4 and 30, since the maps stay in the caches.
const FEATURE_BATCH: usize = 4;

/// Images on which a head before a trainable backbone is standardised.
const STANDARDISED: usize = 64;

impl<'a> Inputs<'a> {
    /// Computes the features that can be kept, or resumes an interrupted computation. A head before a trainable
    /// backbone is standardised on the initial features.
    pub fn new(context: Context<'a>, vae: &mut Vae) -> Result<Self, TrainingError> {
        let Context { config, posed, run } = context;
        let trained = posed.trained();
        let mut own = vec![None; posed.images.len()];
        for (place, &i) in trained.iter().enumerate() {
            own[i] = Some(place);
        }
        let mut this = Self { context, own, own_count: trained.len(), features: None };
        if config.encoder.backbone.frozen && config.encoder.stem_channels == 0 {
            this.features = Some(this.kept_features(vae, &trained)?);
        } else if run.load(names::VAE)?.is_none() {
            let count = posed.images.len().min(STANDARDISED);
            let some: Vec<usize> = (0..count).map(|i| i * posed.images.len() / count).collect();
            let rows = some.chunks(FEATURE_BATCH).map(|chunk| {
                let inputs = config.augmentation.inputs(posed, chunk, 0, config.seed);
                tch::no_grad(|| vae.encoder.features(&inputs))
            });
            let rows: Vec<Tensor> = rows.collect();
            vae.encoder.standardise(&Tensor::cat(&rows, 0));
        }
        Ok(this)
    }

    /// Features `[copies of all images, C, h, w]` in half precision, from the run's folder as far as they are there.
    fn kept_features(&self, vae: &mut Vae, trained: &[usize]) -> Result<Tensor, TrainingError> {
        let Context { config, posed, run } = self.context;
        let all: Vec<usize> = (0..posed.images.len()).collect();
        let copies = config.augmentation.copies + 1;
        let batches: Vec<(usize, &[usize])> = (0..copies + config.augmentation.own_copies)
            .flat_map(|copy| {
                let of_copy = if copy < copies { &all } else { trained };
                of_copy.chunks(FEATURE_BATCH).map(move |chunk| (copy, chunk))
            })
            .collect();
        let total: usize = batches.iter().map(|(_, chunk)| chunk.len()).sum();
        let [channels, height, width] = vae.encoder.feature_shape();
        let features = Tensor::zeros([total as i64, channels, height, width], (Kind::Half, vae.device()));
        let mut file = FeatureFile::open(&run.dir, &[channels, height, width])?;
        let kept = file.read(&features, batches.iter().map(|(_, chunk)| chunk.len()))?;
        let mut done = 0;
        for (copy, chunk) in batches {
            let rows = features.narrow(0, done as i64, chunk.len() as i64);
            done += chunk.len();
            if done <= kept {
                continue;
            }
            if run.stopped() {
                return Err(TrainingError::Stopped);
            }
            let inputs = self.copies(chunk, copy);
            rows.shallow_clone().copy_(&tch::no_grad(|| vae.encoder.features(&inputs)));
            file.append(&rows)?;
            (run.on_progress)(&Progress { phase: "features", done, total, line: String::new() });
        }
        vae.encoder.standardise(&features.narrow(0, 0, all.len() as i64).to_kind(Kind::Float));
        Ok(features)
    }

    /// Number of copies of an image.
    pub(crate) fn copies_of(&self, image: usize) -> usize {
        let augmentation = &self.context.config.augmentation;
        let more = if self.own[image].is_some() { augmentation.own_copies } else { 0 };
        augmentation.copies + 1 + more
    }

    /// Encoder inputs: one copy of each image.
    fn copies(&self, images: &[usize], copy: usize) -> Tensor {
        let Context { config, posed, .. } = self.context;
        let augmentation = &config.augmentation;
        if copy == augmentation.copies + 1 {
            let unchanged = Augmentation { sensor: SensorNoise::OFF, ..augmentation.clone() };
            return unchanged.inputs(posed, images, 0, config.seed);
        }
        augmentation.inputs(posed, images, copy, config.seed)
    }

    /// Features of some images, each in its own copy.
    pub(crate) fn features(&self, vae: &Vae, chosen: &[(usize, usize)]) -> Tensor {
        if let Some(features) = &self.features {
            let copies = self.context.config.augmentation.copies + 1;
            let rows = chosen.iter().map(|&(i, copy)| feature_row(&self.own, self.own_count, copies, i, copy));
            return features.index_select(0, &indices(rows, features.device())).to_kind(Kind::Float);
        }
        let inputs: Vec<Tensor> = chosen.iter().map(|&(i, copy)| self.copies(&[i], copy)).collect();
        vae.encoder.features(&Tensor::cat(&inputs, 0))
    }

    /// Posteriors `[copy][image]` of all images in all copies. They replace the features in the run's folder.
    pub fn all_posteriors(&self, vae: &Vae) -> Result<Vec<Vec<Gaussian>>, TrainingError> {
        let Context { config, run, .. } = self.context;
        let all: Vec<_> = (0..=config.augmentation.copies).map(|copy| self.posteriors(vae, copy)).collect();
        run.save_posteriors(&all)?;
        features::remove(&run.dir)?;
        Ok(all)
    }

    /// Posteriors of all images, in one copy.
    pub(crate) fn posteriors(&self, vae: &Vae, copy: usize) -> Vec<Gaussian> {
        let all: Vec<usize> = (0..self.context.posed.images.len()).collect();
        tch::no_grad(|| {
            all.chunks(FEATURE_BATCH * 4)
                .flat_map(|chunk| {
                    let chosen: Vec<(usize, usize)> = chunk.iter().map(|&i| (i, copy)).collect();
                    let (mean, log_variance) = vae.encoder.posterior(&self.features(vae, &chosen), 0.0);
                    gaussians(&mean, &log_variance)
                })
                .collect()
        })
    }
}

/// Row of a copy's features: first all images copy by copy, `copies` times, then the further copies of the images with
/// a place in `own`.
fn feature_row(own: &[Option<usize>], own_count: usize, copies: usize, image: usize, copy: usize) -> usize {
    match own[image] {
        Some(place) if copy >= copies => copies * own.len() + (copy - copies) * own_count + place,
        _ => copy * own.len() + image,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Features are stored in the order in which they are computed: every copy of all images, then every further copy
    /// of the images that have more.
    #[test]
    fn features_are_found_where_they_were_put() {
        let own = [Some(0), None, Some(1), None, Some(2)];
        let all = (0..2).flat_map(|copy| (0..5).map(move |image| (image, copy)));
        let further = (2..5).flat_map(|copy| [0, 2, 4].map(|image| (image, copy)));
        for (row, (image, copy)) in all.chain(further).enumerate() {
            assert_eq!(feature_row(&own, 3, 2, image, copy), row, "image {image}, copy {copy}");
        }
    }
}
