//! Training phase of the pose-conditional VAE.

use super::{
    Inputs, Vae, indices,
    losses::{contrastive, cross_entropy, kl_divergence, reconstruction_error, reparameterised},
    other_poses::OtherPoses,
};
use crate::{
    TrainingError,
    config::VaeTraining,
    records::{VaeRecord, names},
    run::{Context, Phase, PhaseReport, cosine},
};
use carff_base::random::Key;
use carff_evaluation::PosedImages;
use carff_networks::{adam::Adam, weights::Tensors};
use rand::{Rng, seq::SliceRandom};
use tch::{Tensor, nn::Module};

/// Epochs between two measurements of the decoder's images.
const QUALITY_EVERY: usize = 10;

/// Training phase of the VAE: one step is an epoch.
pub struct VaePhase<'a> {
    context: Context<'a>,
    vae: &'a Vae,
    inputs: &'a Inputs<'a>,
    adam: Adam,
    /// Images of trained and free poses, and those of the dataset's own poses.
    trained: Vec<usize>,
    own: Vec<usize>,
    /// For each image, the distribution over the equivalent states of its view, `[N, S]`.
    state_targets: Tensor,
    /// Present when the decoder is asked for other poses than the input's.
    other_poses: Option<OtherPoses>,
    means: Means,
}

/// Means over an epoch.
#[derive(Clone, Copy, Default)]
struct Means {
    loss: f64,
    reconstruction: f64,
    kl: f64,
    state: f64,
}

/// Terms of one batch.
struct Losses {
    /// Absent for a batch with images of free poses.
    reconstruction: Option<Tensor>,
    kl: Tensor,
    state: Option<Tensor>,
    contrastive: Option<Tensor>,
}

/// Epochs with the same images and terms.
struct Part<'b> {
    images: &'b [usize],
    own_passes: usize,
    /// Epochs before this part.
    before: usize,
    epochs: usize,
    decoder_only: bool,
}

impl<'a> VaePhase<'a> {
    /// The phase before its first epoch.
    pub fn new(context: Context<'a>, vae: &'a Vae, inputs: &'a Inputs<'a>) -> Self {
        let posed = context.posed;
        Self {
            context,
            vae,
            inputs,
            adam: Adam::new(&vae.stores(), context.config.vae.weight_decay),
            trained: posed.trained_and_random(),
            own: posed.trained(),
            state_targets: state_targets(posed).to_device(vae.device()),
            other_poses: (context.config.vae.other_poses > 0).then(|| OtherPoses::new(posed, vae.device())),
            means: Means::default(),
        }
    }

    fn settings(&self) -> &'a VaeTraining {
        &self.context.config.vae
    }

    fn part(&self, epoch: usize) -> Part<'_> {
        let settings = self.settings();
        let joint = settings.joint_epochs();
        if epoch >= joint {
            let (before, epochs) = (joint, settings.decoder_epochs);
            Part { images: &self.own, own_passes: 1, before, epochs, decoder_only: true }
        } else {
            let (own_passes, epochs) = (settings.own_passes, joint);
            Part { images: &self.trained, own_passes, before: 0, epochs, decoder_only: false }
        }
    }

    /// Weighted sum of the terms.
    fn loss(&self, losses: &Losses, kl_weight: f64, decoder_only: bool) -> Tensor {
        let settings = self.settings();
        let reconstruction = losses.reconstruction.as_ref().map(|term| term * settings.reconstruction_weight);
        match reconstruction {
            Some(term) if decoder_only => term,
            reconstruction => {
                let mut loss = &losses.kl * kl_weight;
                if let Some(term) = reconstruction {
                    loss = &loss + term;
                }
                if let Some(term) = &losses.state {
                    loss = &loss + term * settings.state_weight;
                }
                if let Some(term) = &losses.contrastive {
                    loss = &loss + term * settings.contrastive_weight;
                }
                loss
            }
        }
    }

    /// Terms of one batch of images, each in its own copy. With `decoder_only` the encoder works as after training, and
    /// gets no gradient.
    fn losses(&self, chosen: &[(usize, usize)], decoder_only: bool, rng: &mut impl Rng) -> Losses {
        let (settings, posed, vae) = (self.settings(), self.context.posed, self.vae);
        let images = || chosen.iter().map(|&(i, _)| i);
        let features = self.inputs.features(vae, chosen);
        let (mean, log_variance) = vae.encoder.posterior(&features, if decoder_only { 0.0 } else { settings.dropout });
        let latent = reparameterised(&mean, &log_variance, &Tensor::randn_like(&mean));
        let latent = if decoder_only { latent.detach() } else { latent };
        let reconstruction = match (&self.other_poses, &vae.small_decoder) {
            (Some(other_poses), Some(decoder)) if !decoder_only => {
                let inputs: Vec<_> = images().map(|i| (posed.labels[i].state, posed.labels[i].view)).collect();
                other_poses.error(decoder, &latent, &inputs, settings, rng)
            }
            _ => self.own_poses(&latent, &images().collect::<Vec<_>>()),
        };
        let kl = kl_divergence(&mean, &log_variance);
        let state = (settings.state_weight > 0.0).then(|| {
            let rows = indices(images(), self.state_targets.device());
            cross_entropy(&vae.read_out.forward(&latent), &self.state_targets.index_select(0, &rows))
        });
        let contrastive = (settings.contrastive_weight > 0.0).then(|| {
            let states = indices(images().map(|i| posed.labels[i].state), mean.device());
            contrastive(&mean, &states, settings.contrastive_temperature)
        });
        Losses { reconstruction, kl, state, contrastive }
    }

    /// Weighted squared error of the decoder on the first images of a batch, each at its own pose. `None` for a batch
    /// with images of free poses: the decoder knows only the dataset's poses, and learns from batches of them.
    fn own_poses(&self, latents: &Tensor, images: &[usize]) -> Option<Tensor> {
        let (posed, device, settings) = (self.context.posed, latents.device(), self.settings());
        if images.iter().any(|&i| posed.labels[i].role.is_none()) {
            return None;
        }
        let decoded = &images[..images.len().min(settings.decoder_batch)];
        let views = indices(decoded.iter().map(|&i| posed.labels[i].view), tch::Device::Cpu);
        let targets = posed.targets(decoded).to_device(device);
        let means = posed.pose_means.index_select(0, &views).to_device(device);
        let made = self.vae.decoder.forward(&latents.narrow(0, 0, decoded.len() as i64), &views.to_device(device));
        let valid = posed.valid_targets(decoded).map(|valid| valid.to_device(device));
        Some(reconstruction_error(&made, &targets, &means, valid.as_ref(), settings))
    }
}

impl Phase for VaePhase<'_> {
    type Record = VaeRecord;

    fn name(&self) -> &'static str {
        names::VAE
    }

    fn total(&self) -> usize {
        self.settings().all_epochs()
    }

    fn restore(&mut self, _done: usize, state: &Tensors) -> bool {
        self.vae.restore(Some(&mut self.adam), state)
    }

    fn step(&mut self, epoch: usize) {
        let (settings, seed) = (self.settings(), self.context.config.seed);
        let Part { images, own_passes, before, epochs, decoder_only } = self.part(epoch);
        let per_epoch = (images.len() + (own_passes - 1) * self.own.len()).div_ceil(settings.batch).max(1);
        let mut rng = carff_base::random::stream(Key::named(names::VAE, seed, epoch as u64));
        let batches = batches(self.context.posed, images, own_passes, settings.batch, &mut rng);
        let mut sums = Means::default();
        let mut decoded_batches = 0_usize;
        for (b, batch) in batches.iter().enumerate() {
            let step = (epoch - before) * per_epoch + b;
            let at = step as f64 / (epochs * per_epoch) as f64;
            let kl_weight =
                settings.kl_weight * ((at - settings.kl_delay) / settings.kl_ramp.max(1e-9)).clamp(0.0, 1.0);
            let chosen: Vec<(usize, usize)> =
                batch.iter().map(|&i| (i, rng.random_range(0..self.inputs.copies_of(i)))).collect();
            tch::manual_seed(seed as i64 ^ ((step as i64) << 20) ^ i64::from(decoder_only));
            let losses = self.losses(&chosen, decoder_only, &mut rng);
            let loss = self.loss(&losses, kl_weight, decoder_only);
            self.adam.step(&loss, settings.learning_rate * cosine(step, epochs * per_epoch), 5.0);
            let value = |t: &Tensor| t.double_value(&[]);
            sums.loss += value(&loss);
            sums.reconstruction += losses.reconstruction.as_ref().map_or(0.0, value);
            decoded_batches += usize::from(losses.reconstruction.is_some());
            sums.kl += value(&losses.kl);
            sums.state += losses.state.as_ref().map_or(0.0, value);
        }
        let count = batches.len() as f64;
        self.means = Means {
            loss: sums.loss / count,
            reconstruction: sums.reconstruction / decoded_batches.max(1) as f64,
            kl: sums.kl / count,
            state: sums.state / count,
        };
    }

    fn report(&mut self, done: usize) -> Result<PhaseReport<VaeRecord>, TrainingError> {
        let image_quality = done == self.total() || done.is_multiple_of(QUALITY_EVERY);
        let figures = self.vae.figures(self.context, &self.inputs.posteriors(self.vae, 0), image_quality)?;
        let Means { loss, reconstruction, kl, state } = self.means;
        let percent = |accuracy: carff_evaluation::Accuracy| 100.0 * accuracy.accuracy;
        let line = format!(
            "loss {loss:.3} = {reconstruction:.3} {state:.3}  kl {kl:.1}  state accuracy trained {:.1}/{:.1}/{:.1} % \
             held-out {:.1}/{:.1} %{}",
            percent(figures.trained.full),
            percent(figures.trained.partial),
            percent(figures.trained.none),
            percent(figures.unseen.full),
            percent(figures.unseen.partial),
            figures.psnr_db.map_or(String::new(), |p| format!("  psnr {p:.2} dB")),
        );
        let record = VaeRecord { epoch: done as u64, loss, reconstruction, kl, state, figures };
        Ok(PhaseReport { line: Some(line), record: Some(record) })
    }

    fn state(&self) -> Tensors {
        self.vae.state(&self.adam)
    }
}

/// One pass over the images, in batches of whole poses. All states of a pose are in one batch, so that differences
/// between poses do not hide those between states. Poses of the dataset, the only ones that the decoder knows, share
/// batches: from a few images of a pose at a time the decoder learned only the mean images. Images of a batch are
/// shuffled, so that a decoder that takes the first ones sees all states. All `own_passes` over the dataset's poses
/// except the first are for the encoder only, among the free poses.
fn batches(
    posed: &PosedImages,
    trained: &[usize],
    own_passes: usize,
    size: usize,
    rng: &mut impl rand::Rng,
) -> Vec<Vec<usize>> {
    let mut by_view = vec![Vec::new(); posed.view_count()];
    for &i in trained {
        by_view[posed.labels[i].view].push(i);
    }
    by_view.retain(|v| !v.is_empty());
    by_view.shuffle(rng);
    let (known, random) = by_view.into_iter().partition(|v| posed.labels[v[0]].role.is_some());
    whole_poses(known, random, own_passes, size, rng)
}

/// Batches of at least `size` images, except the last batch of each kind, from the images of each pose.
fn whole_poses(
    known: Vec<Vec<usize>>,
    mut random: Vec<Vec<usize>>,
    own_passes: usize,
    size: usize,
    rng: &mut impl rand::Rng,
) -> Vec<Vec<usize>> {
    if own_passes > 1 {
        random.extend((1..own_passes).flat_map(|_| known.clone()));
        random.shuffle(rng);
    }
    let mut batches = Vec::new();
    for views in [known, random] {
        let mut batch = Vec::new();
        for view in views {
            batch.extend(view);
            if batch.len() >= size {
                batches.push(std::mem::take(&mut batch));
            }
        }
        batches.extend((!batch.is_empty()).then_some(batch));
    }
    for batch in &mut batches {
        batch.shuffle(rng);
    }
    batches.shuffle(rng);
    batches
}

/// For each image, the distribution over the states that look the same from its view, `[N, S]`.
fn state_targets(posed: &PosedImages) -> Tensor {
    let states = posed.scenario.state_count();
    let mut rows = Vec::with_capacity(posed.labels.len() * states);
    for label in &posed.labels {
        let equivalent = posed.seen_alike(label.view, label.state);
        let share = 1.0 / equivalent.len() as f32;
        rows.extend((0..states).map(|s| if equivalent.contains(&s) { share } else { 0.0 }));
    }
    Tensor::from_slice(&rows).view([-1, states as i64])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pass uses each image of the dataset's own poses `own_passes` times, once in batches of only such images, and
    /// each image of a free pose once. Images of one pose share a batch.
    #[test]
    fn a_pass_takes_own_images_own_passes_times() {
        let poses =
            |of: std::ops::Range<usize>| of.map(|pose| (3 * pose..3 * pose + 3).collect()).collect::<Vec<Vec<_>>>();
        let mut rng = carff_base::random::stream(Key { seed: 1, frame: 0, step: 0, sample: 0 });
        for own_passes in [1, 4] {
            let batches = whole_poses(poses(0..10), poses(10..60), own_passes, 30, &mut rng);
            let mut taken = [0; 180];
            batches.iter().flatten().for_each(|&image| taken[image] += 1);
            assert!(taken[..30].iter().all(|&times| times == own_passes), "{taken:?}");
            assert!(taken[30..].iter().all(|&times| times == 1), "{taken:?}");
            let own = batches.iter().filter(|batch| batch.iter().all(|&image| image < 30)).count();
            assert_eq!((own, batches.len()), (1, (own_passes * 30 + 150) / 30));
            let together = |batch: &[usize], image: usize| batch.iter().filter(|&&p| p / 3 == image / 3).count() % 3;
            assert!(batches.iter().all(|batch| batch.iter().all(|&image| together(batch, image) == 0)));
        }
    }
}
