//! The training loop of the pose-conditional VAE (paper section 3.2).
//!
//! The plain recipe (KL and squared error alone) ends in a dead latent that PSNR does not show. What keeps it alive
//! here: the decoder learns the residual over the pose's mean picture, pixels that change weigh more, and a linear
//! read-out of the sampled latent must name the state, up to the states that look the same in that view. The last
//! term asks a view that hides the actor for an even answer, so its posterior lies between the states.

use crate::{
    TrainingError,
    accuracy::{Centroids, state_accuracy},
    config::{Augmentation, TrainingConfig, VaeTraining},
    features::{self, FeatureFile},
    pictures::Pictures,
    run::{Progress, Run, SaveClock, cosine, damaged, part, prefixed},
};
use carff_dataset::{PoseRole, sensor::SensorNoise};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_models::{
    ModelError,
    adam::Adam,
    decoder::Decoder,
    encoder::{Encoder, gaussians},
    weights::{self, Tensors},
};
use carff_random::Key;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::path::Path;
use tch::{Device, Kind, Tensor, nn, nn::Module, nn::VarStore};

/// Encoder, decoder and the read-out that only training uses.
pub struct Vae {
    /// The encoder.
    pub encoder: Encoder,
    /// The decoder.
    pub decoder: Decoder,
    read_out: nn::Linear,
    backbone: VarStore,
    head: VarStore,
    decoder_store: VarStore,
    read_out_store: VarStore,
    frozen: bool,
}

impl Vae {
    /// Fresh weights on `device` from the global generator (seed it first); the backbone's from `pretrained`.
    pub fn new(
        config: &TrainingConfig,
        poses: usize,
        states: usize,
        pretrained: Option<&Path>,
        device: Device,
    ) -> Result<Self, ModelError> {
        let [mut backbone, head, decoder_store, read_out_store] = [(); 4].map(|()| VarStore::new(device));
        let encoder =
            Encoder::new(&config.encoder, &(backbone.root() / "backbone"), &(head.root() / "encoder"), pretrained)?;
        let decoder = Decoder::new(&(decoder_store.root() / "decoder"), &config.decoder, poses as i64);
        let read_out = nn::linear(
            read_out_store.root() / "read_out",
            LATENT_DIM as i64,
            states as i64,
            nn::LinearConfig::default(),
        );
        let frozen = config.encoder.backbone.frozen;
        if frozen {
            backbone.freeze();
        }
        Ok(Self { encoder, decoder, read_out, backbone, head, decoder_store, read_out_store, frozen })
    }

    /// Weights that a checkpoint keeps: (encoder head, decoder, backbone).
    pub fn weights(&self) -> (Tensors, Tensors, Tensors) {
        (weights::of_store(&self.head), weights::of_store(&self.decoder_store), weights::of_store(&self.backbone))
    }

    /// Where it computes.
    pub fn device(&self) -> Device {
        self.head.device()
    }

    fn stores(&self) -> Vec<&VarStore> {
        let mut stores = vec![&self.head, &self.decoder_store, &self.read_out_store];
        if !self.frozen {
            stores.push(&self.backbone);
        }
        stores
    }

    fn state(&self, adam: &Adam) -> Tensors {
        let mut all: Tensors = prefixed("adam.", adam.state()).collect();
        for store in self.stores() {
            all.extend(prefixed("weights.", weights::of_store(store)));
        }
        all
    }

    fn restore(&self, adam: Option<&mut Adam>, state: &Tensors) -> bool {
        let saved = part(state, "weights.");
        for store in self.stores() {
            let own: Tensors = weights::of_store(store)
                .into_keys()
                .filter_map(|k| saved.get(&k).map(|t| (k, t.shallow_clone())))
                .collect();
            if weights::fill_store(store, &own).is_err() {
                return false;
            }
        }
        adam.is_none_or(|adam| adam.restore(&part(state, "adam.")))
    }

    /// Puts the weights of a saved training back; `false` when they do not fit.
    #[must_use]
    pub fn restore_weights(&self, state: &Tensors) -> bool {
        self.restore(None, state)
    }
}

/// Backbone features of the pictures' copies, where they can be kept.
///
/// Every picture has `augmentation.copies` + 1 copies; those that the data set's own poses are trained with have
/// `augmentation.own_copies` more, the first of them the picture as it is.
pub struct Inputs<'a> {
    config: &'a TrainingConfig,
    pictures: &'a Pictures,
    /// Per picture its place among those with more copies.
    own: Vec<Option<usize>>,
    own_count: usize,
    features: Option<Tensor>,
}

/// Pictures through the backbone at a time: measured best among 1, 4 and 30, since the maps stay in the caches.
const FEATURE_BATCH: usize = 4;

/// Pictures that a head before a learning backbone is standardised on.
const STANDARDISED: usize = 64;

impl<'a> Inputs<'a> {
    /// Computes what can be kept, or reads it where an earlier call was interrupted: features
    /// `[copies of all pictures, C, h, w]` in half precision.
    pub fn new(
        config: &'a TrainingConfig,
        pictures: &'a Pictures,
        vae: &mut Vae,
        run: &Run,
    ) -> Result<Self, TrainingError> {
        let keep = config.encoder.backbone.frozen && config.encoder.stem_channels == 0;
        let trained = pictures.trained();
        let mut own = vec![None; pictures.images.len()];
        for (place, &i) in trained.iter().enumerate() {
            own[i] = Some(place);
        }
        let mut this = Self { config, pictures, own, own_count: trained.len(), features: None };
        if keep {
            let all: Vec<usize> = (0..pictures.images.len()).collect();
            let copies = config.augmentation.copies + 1;
            let batches: Vec<(usize, &[usize])> = (0..copies + config.augmentation.own_copies)
                .flat_map(|copy| {
                    let of_copy = if copy < copies { &all } else { &trained };
                    of_copy.chunks(FEATURE_BATCH).map(move |chunk| (copy, chunk))
                })
                .collect();
            let total: usize = batches.iter().map(|(_, chunk)| chunk.len()).sum();
            let [channels, height, width] = vae.encoder.feature_shape();
            let features = Tensor::zeros([total as i64, channels, height, width], (Kind::Half, vae.device()));
            let mut file = FeatureFile::open(run, &[channels, height, width])?;
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
                let inputs = this.copies(chunk, copy);
                rows.shallow_clone().copy_(&tch::no_grad(|| vae.encoder.features(&inputs)));
                file.append(&rows)?;
                (run.on_progress)(&Progress { stage: "features", done, total, line: String::new() });
            }
            vae.encoder.standardise(&features.narrow(0, 0, all.len() as i64).to_kind(Kind::Float));
            this.features = Some(features);
        } else if run.load("vae")?.is_none() {
            // A backbone that learns changes its features; the head is set to how they are at first, and learns the rest.
            let count = pictures.images.len().min(STANDARDISED);
            let some: Vec<usize> = (0..count).map(|i| i * pictures.images.len() / count).collect();
            let rows = some.chunks(FEATURE_BATCH).map(|chunk| {
                let inputs = pictures.inputs(chunk, 0, &config.augmentation, config.seed);
                tch::no_grad(|| vae.encoder.features(&inputs))
            });
            let rows: Vec<Tensor> = rows.collect();
            vae.encoder.standardise(&Tensor::cat(&rows, 0));
        }
        Ok(this)
    }

    /// How many copies there are of a picture.
    fn copies_of(&self, picture: usize) -> usize {
        let more = if self.own[picture].is_some() { self.config.augmentation.own_copies } else { 0 };
        self.config.augmentation.copies + 1 + more
    }

    /// Encoder inputs: one copy of each picture.
    fn copies(&self, pictures: &[usize], copy: usize) -> Tensor {
        let augmentation = &self.config.augmentation;
        if copy == augmentation.copies + 1 {
            let as_it_is = Augmentation { sensor: SensorNoise::OFF, ..augmentation.clone() };
            return self.pictures.inputs(pictures, 0, &as_it_is, self.config.seed);
        }
        self.pictures.inputs(pictures, copy, augmentation, self.config.seed)
    }

    /// Features of some pictures, each in its own copy.
    fn features(&self, vae: &Vae, chosen: &[(usize, usize)]) -> Tensor {
        if let Some(features) = &self.features {
            let copies = self.config.augmentation.copies + 1;
            let rows: Vec<i64> = chosen
                .iter()
                .map(|&(i, copy)| feature_row(&self.own, self.own_count, copies, i, copy) as i64)
                .collect();
            return features.index_select(0, &indices(&rows, features.device())).to_kind(Kind::Float);
        }
        let inputs: Vec<Tensor> = chosen.iter().map(|&(i, copy)| self.copies(&[i], copy)).collect();
        vae.encoder.features(&Tensor::cat(&inputs, 0))
    }

    /// The posteriors of all pictures in all copies, `[copy][picture]`; kept in the run's folder, in place of the features.
    pub fn all_posteriors(&self, vae: &Vae, run: &Run) -> Result<Vec<Vec<Gaussian>>, TrainingError> {
        let all: Vec<_> = (0..=self.config.augmentation.copies).map(|copy| self.posteriors(vae, copy)).collect();
        run.save_posteriors(&all)?;
        features::remove(&run.dir)?;
        Ok(all)
    }

    /// The posteriors of all pictures, in one copy.
    fn posteriors(&self, vae: &Vae, copy: usize) -> Vec<Gaussian> {
        let all: Vec<usize> = (0..self.pictures.images.len()).collect();
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

/// Where a copy's features lie: first all pictures copy by copy, `copies` times, then the further copies of those that
/// have a place in `own`.
fn feature_row(own: &[Option<usize>], own_count: usize, copies: usize, picture: usize, copy: usize) -> usize {
    match own[picture] {
        Some(place) if copy >= copies => copies * own.len() + (copy - copies) * own_count + place,
        _ => copy * own.len() + picture,
    }
}

/// Trains the VAE, or goes on where an earlier run stopped.
pub fn train(
    config: &TrainingConfig,
    pictures: &Pictures,
    vae: &Vae,
    inputs: &Inputs,
    run: &Run,
) -> Result<(), TrainingError> {
    let settings = &config.vae;
    let mut adam = Adam::new(&vae.stores(), settings.weight_decay);
    let mut first = 0;
    if let Some((done, state)) = run.load("vae")? {
        if !vae.restore(Some(&mut adam), &state) {
            return Err(damaged(&run.state_path("vae")));
        }
        first = done;
    }
    let (trained, own) = (pictures.trained_and_free(), pictures.trained());
    let state_targets = state_targets(pictures).to_device(vae.device());
    let mut clock = SaveClock::default();
    for epoch in first..settings.all_epochs() {
        let decoder_alone = epoch >= settings.epochs;
        let (learnt, own_passes, epochs_before, epochs) = if decoder_alone {
            (&own, 1, settings.epochs, settings.decoder_epochs)
        } else {
            (&trained, settings.own_passes, 0, settings.epochs)
        };
        let per_epoch = (learnt.len() + (own_passes - 1) * own.len()).div_ceil(settings.batch).max(1);
        let mut rng =
            carff_random::stream(Key { seed: config.seed, frame: epoch as u64, step: 0x7661_6500, sample: 0 });
        let batches = batches(pictures, learnt, own_passes, settings.batch, &mut rng);
        let mut sums = [0.0_f64; 4];
        let mut decoded_batches = 0_usize;
        for (b, batch) in batches.iter().enumerate() {
            let step = (epoch - epochs_before) * per_epoch + b;
            let at = step as f64 / (epochs * per_epoch) as f64;
            let kl_weight =
                settings.kl_weight * ((at - settings.kl_delay) / settings.kl_ramp.max(1e-9)).clamp(0.0, 1.0);
            let chosen: Vec<(usize, usize)> =
                batch.iter().map(|&i| (i, rand::Rng::random_range(&mut rng, 0..inputs.copies_of(i)))).collect();
            tch::manual_seed(config.seed as i64 ^ ((step as i64) << 20) ^ i64::from(decoder_alone));
            let losses = losses(config, pictures, vae, inputs, &chosen, &state_targets, decoder_alone);
            let reconstruction = losses.reconstruction.as_ref().map(|term| term * settings.reconstruction_weight);
            let loss = match reconstruction {
                Some(term) if decoder_alone => term,
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
            };
            adam.step(&loss, settings.learning_rate * cosine(step, epochs * per_epoch), 5.0);
            let value = |t: &Tensor| t.double_value(&[]);
            sums[0] += value(&loss);
            sums[1] += losses.reconstruction.as_ref().map_or(0.0, value);
            decoded_batches += usize::from(losses.reconstruction.is_some());
            sums[2] += value(&losses.kl);
            sums[3] += losses.state.as_ref().map_or(0.0, value);
        }
        let mut means = sums.map(|s| s / batches.len() as f64);
        means[1] = sums[1] / decoded_batches.max(1) as f64;
        let posteriors = inputs.posteriors(vae, 0);
        let last = epoch + 1 == settings.all_epochs();
        let report = evaluate(config, pictures, vae, &posteriors, last || epoch % 10 == 9)?;
        let mut record = json!({
            "stage": "vae", "epoch": epoch + 1, "loss": means[0], "reconstruction": means[1], "kl": means[2],
            "state": means[3],
        });
        if let (Some(to), Some(from)) = (record.as_object_mut(), report.as_object()) {
            to.extend(from.clone());
        }
        run.metric(&record)?;
        let figure = |role: &str, kind: &str| report[role][kind]["accuracy"].as_f64().unwrap_or(0.0) * 100.0;
        (run.on_progress)(&Progress {
            stage: "vae",
            done: epoch + 1,
            total: settings.all_epochs(),
            line: format!(
                "loss {:.3} = {:.3} {:.3}  kl {:.1}  state accuracy trained {:.1}/{:.1}/{:.1} % unseen {:.1}/{:.1} %{}",
                means[0],
                means[1],
                means[3],
                means[2],
                figure("trained", "full"),
                figure("trained", "partial"),
                figure("trained", "none"),
                figure("unseen", "full"),
                figure("unseen", "partial"),
                report["psnr_db"].as_f64().map_or(String::new(), |p| format!("  psnr {p:.2} dB")),
            ),
        });
        let stopping = run.stopped();
        if stopping || clock.is_due() || last {
            run.save("vae", epoch + 1, vae.state(&adam))?;
        }
        if stopping {
            return Err(TrainingError::Stopped);
        }
    }
    Ok(())
}

/// One pass over the pictures, in batches made of whole poses: all states of a pose stand in one batch, so that what
/// tells states apart is not drowned by what tells poses apart. Poses of the data set, which alone the decoder knows,
/// stand together: a few pictures of one pose at a time never got it away from the mean pictures. Within a batch
/// pictures are shuffled, so that a decoder that takes the first few sees all states. Of `own_passes` over the data set's
/// poses all but the first are for the encoder, among the free poses.
fn batches(
    pictures: &Pictures,
    trained: &[usize],
    own_passes: usize,
    size: usize,
    rng: &mut impl rand::Rng,
) -> Vec<Vec<usize>> {
    let mut by_view = vec![Vec::new(); pictures.view_count()];
    for &i in trained {
        by_view[pictures.labels[i].view].push(i);
    }
    by_view.retain(|v| !v.is_empty());
    by_view.shuffle(rng);
    let (known, free) = by_view.into_iter().partition(|v| pictures.labels[v[0]].role.is_some());
    whole_poses(known, free, own_passes, size, rng)
}

/// Batches of at least `size` pictures, but for the last of each kind, from the pictures of each pose.
fn whole_poses(
    known: Vec<Vec<usize>>,
    mut free: Vec<Vec<usize>>,
    own_passes: usize,
    size: usize,
    rng: &mut impl rand::Rng,
) -> Vec<Vec<usize>> {
    if own_passes > 1 {
        free.extend((1..own_passes).flat_map(|_| known.clone()));
        free.shuffle(rng);
    }
    let mut batches = Vec::new();
    for views in [known, free] {
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

/// Per picture the distribution over the states that look the same in its view, `[N, S]`.
fn state_targets(pictures: &Pictures) -> Tensor {
    let states = pictures.scenario.state_count();
    let mut rows = Vec::with_capacity(pictures.labels.len() * states);
    for label in &pictures.labels {
        let alike = pictures.alike(label.view, label.state);
        let share = 1.0 / alike.len() as f32;
        rows.extend((0..states).map(|s| if alike.contains(&s) { share } else { 0.0 }));
    }
    Tensor::from_slice(&rows).view([-1, states as i64])
}

struct Losses {
    /// None when the batch has pictures of freely drawn poses.
    reconstruction: Option<Tensor>,
    kl: Tensor,
    state: Option<Tensor>,
    contrastive: Option<Tensor>,
}

/// Weighted squared error of the decoder on some pictures of the data set, from a latent each.
fn reconstruction(
    config: &TrainingConfig,
    pictures: &Pictures,
    vae: &Vae,
    latents: &Tensor,
    decoded: &[usize],
) -> Tensor {
    let settings = &config.vae;
    let views: Vec<i64> = decoded.iter().map(|&i| pictures.labels[i].view as i64).collect();
    let views = Tensor::from_slice(&views);
    let device = latents.device();
    let targets = pictures.targets(decoded).to_device(device);
    let means = pictures.pose_means.index_select(0, &views).to_device(device);
    reconstruction_error(&vae.decoder.forward(latents, &views.to_device(device)), &targets, &means, settings)
}

/// The terms of one batch. For a decoder that learns alone the encoder is as it is used later, and out of the loss's reach.
fn losses(
    config: &TrainingConfig,
    pictures: &Pictures,
    vae: &Vae,
    inputs: &Inputs,
    chosen: &[(usize, usize)],
    state_targets: &Tensor,
    decoder_alone: bool,
) -> Losses {
    let settings = &config.vae;
    let only: Vec<usize> = chosen.iter().map(|&(i, _)| i).collect();
    let features = inputs.features(vae, chosen);
    let (mean, log_variance) = vae.encoder.posterior(&features, if decoder_alone { 0.0 } else { settings.dropout });
    let latent = reparameterised(&mean, &log_variance, &Tensor::randn_like(&mean));
    let latent = if decoder_alone { latent.detach() } else { latent };
    // The decoder knows the data set's poses alone, and learns of batches of them.
    let known = only.iter().all(|&i| pictures.labels[i].role.is_some());
    let reconstruction = known.then(|| {
        let decoded = &only[..only.len().min(settings.decoder_batch)];
        reconstruction(config, pictures, vae, &latent.narrow(0, 0, decoded.len() as i64), decoded)
    });
    let kl = kl_divergence(&mean, &log_variance);
    let state = (settings.state_weight > 0.0).then(|| {
        let rows: Vec<i64> = only.iter().map(|&i| i as i64).collect();
        let wanted = state_targets.index_select(0, &indices(&rows, state_targets.device()));
        cross_entropy(&vae.read_out.forward(&latent), &wanted)
    });
    let contrastive = (settings.contrastive_weight > 0.0).then(|| {
        let states: Vec<i64> = only.iter().map(|&i| pictures.labels[i].state as i64).collect();
        contrastive(&mean, &indices(&states, mean.device()), settings.contrastive_temperature)
    });
    Losses { reconstruction, kl, state, contrastive }
}

fn indices(rows: &[i64], device: Device) -> Tensor {
    Tensor::from_slice(rows).to_device(device)
}

/// Draws from Gaussians with means and log-variances `[N, 8]` by standard normal `noise` `[N, 8]`, so that gradients reach
/// both (Kingma and Welling 2014).
pub fn reparameterised(mean: &Tensor, log_variance: &Tensor, noise: &Tensor) -> Tensor {
    mean + (log_variance * 0.5).exp() * noise
}

/// Squared error of what a decoder made, `[N, 3, H, W]`, times ten; pixels of `targets` that differ by more than 12 of 255
/// from `means`, the poses' mean pictures, weigh `foreground_weight`. With `residual` the difference from the mean picture is
/// what was to be made, else the picture.
pub fn reconstruction_error(made: &Tensor, targets: &Tensor, means: &Tensor, settings: &VaeTraining) -> Tensor {
    let residual = targets - means;
    let changed = residual.abs().amax([1_i64].as_slice(), true).gt(12.0 / 255.0).to_kind(Kind::Float);
    let weight = changed * (settings.foreground_weight - 1.0) + 1.0;
    let wanted = if settings.residual { &residual } else { targets };
    ((made - wanted).square() * weight).mean(Kind::Float) * 10.0
}

/// Mean over the batch of the cross entropy of `logits` `[N, S]` with the `wanted` distributions `[N, S]`.
pub fn cross_entropy(logits: &Tensor, wanted: &Tensor) -> Tensor {
    let log = logits.log_softmax(-1, Kind::Float);
    -(wanted * log).sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float).mean(Kind::Float)
}

/// Mean over the batch of KL(N(mean, exp(log variance)) || N(0, 1)), summed over dimensions. Inputs `[N, 8]`.
pub fn kl_divergence(mean: &Tensor, log_variance: &Tensor) -> Tensor {
    ((mean.square() + log_variance.exp() - log_variance - 1.0) * 0.5)
        .sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float)
        .mean(Kind::Float)
}

/// Supervised contrastive loss (Khosla et al. 2020) of normalised means `[N, 8]` with state numbers `[N]`.
pub fn contrastive(mean: &Tensor, states: &Tensor, temperature: f64) -> Tensor {
    let n = mean.size()[0];
    let unit = mean / (mean.square().sum_dim_intlist([-1_i64].as_slice(), true, Kind::Float) + 1e-8).sqrt();
    let eye = Tensor::eye(n, (Kind::Float, mean.device()));
    let others = eye.ones_like() - eye;
    let positive = states.unsqueeze(0).eq_tensor(&states.unsqueeze(1)).to_kind(Kind::Float) * &others;
    let logits: Tensor = unit.matmul(&unit.transpose(0, 1)) / temperature - (others.ones_like() - &others) * 1e9;
    let log = logits.log_softmax(-1, Kind::Float);
    let count = positive.sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float);
    let sum = (log * positive).sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float);
    -(sum / count.clamp_min(1.0)).mean(Kind::Float)
}

/// State accuracy by observability, for trained, calibration and unseen poses; with `picture_quality` also the PSNR of
/// reconstructions on the trained poses, its gain over the pose's mean picture, and the PSNR where pixels change.
pub fn evaluate(
    config: &TrainingConfig,
    pictures: &Pictures,
    vae: &Vae,
    posteriors: &[Gaussian],
    picture_quality: bool,
) -> Result<serde_json::Value, TrainingError> {
    let centroids = Centroids::fit(pictures, posteriors)
        .ok_or_else(|| TrainingError::Unfit("some state has no picture from a pose that is trained on".into()))?;
    let accuracy = |roles: &[PoseRole]| {
        let table = state_accuracy(pictures, posteriors, &centroids, &pictures.with_roles(roles));
        let share = |s: crate::accuracy::Share| json!({"accuracy": s.accuracy(), "raw": s.raw(), "raw_ceiling": s.ceiling(), "trials": s.trials});
        json!({"full": share(table.full), "partial": share(table.partial), "none": share(table.none)})
    };
    let mut report = json!({
        "trained": accuracy(&[PoseRole::Rest]),
        "calibration": accuracy(&[PoseRole::Calibration]),
        "unseen": accuracy(&[PoseRole::Unseen]),
    });
    if picture_quality {
        let pairs: Vec<_> = pictures.trained().into_iter().map(|i| (i, posteriors[i].mean)).collect();
        let quality = decoded_quality(pictures, &vae.decoder, config.vae.residual, &pairs);
        report["psnr_db"] = json!(quality.psnr_db);
        report["mean_picture_psnr_db"] = json!(quality.mean_picture_psnr_db);
        report["changed_pixels_psnr_db"] = json!(quality.changed_pixels_psnr_db);
    }
    Ok(report)
}

/// How good decoded pictures are, over all pixels of all of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DecodedQuality {
    /// PSNR, dB.
    pub psnr_db: f64,
    /// PSNR of each pose's mean picture over the states, which takes no encoder, dB.
    pub mean_picture_psnr_db: f64,
    /// PSNR over the pixels that differ by more than 12 of 255 from it, dB.
    pub changed_pixels_psnr_db: f64,
    /// Pictures.
    pub pictures: usize,
}

/// Quality of what the decoder makes of latents, each against one of the data set's pictures. `residual` says what it
/// was trained for.
pub fn decoded_quality(
    pictures: &Pictures,
    decoder: &Decoder,
    residual: bool,
    pairs: &[(usize, [f32; LATENT_DIM])],
) -> DecodedQuality {
    let [mut error, mut mean_error, mut changed_error, mut changed_count, mut count] = [0.0_f64; 5];
    for chunk in pairs.chunks(60) {
        let chosen: Vec<usize> = chunk.iter().map(|pair| pair.0).collect();
        let (out, means) = decoded(pictures, decoder, residual, chunk);
        let targets = pictures.targets(&chosen);
        let difference = &targets - &means;
        let changed = difference.abs().amax([1_i64].as_slice(), true).gt(12.0 / 255.0).to_kind(Kind::Float);
        let squares = (&out - &targets).square();
        error += squares.sum(Kind::Double).double_value(&[]);
        mean_error += difference.square().sum(Kind::Double).double_value(&[]);
        changed_error += (squares * &changed).sum(Kind::Double).double_value(&[]);
        changed_count += changed.sum(Kind::Double).double_value(&[]) * 3.0;
        count += targets.numel() as f64;
    }
    let psnr = |sum: f64, n: f64| carff_metrics::psnr_of_mse(sum / n.max(1.0));
    DecodedQuality {
        psnr_db: psnr(error, count),
        mean_picture_psnr_db: psnr(mean_error, count),
        changed_pixels_psnr_db: psnr(changed_error, changed_count),
        pictures: pairs.len(),
    }
}

/// Decoded pictures `[N, 3, 128, 128]` in 0..=1 of latents, each from the pose of one of the data set's pictures; and the
/// mean pictures of these poses. Both on the processor, wherever the decoder computes.
pub fn decoded(
    pictures: &Pictures,
    decoder: &Decoder,
    residual: bool,
    pairs: &[(usize, [f32; LATENT_DIM])],
) -> (Tensor, Tensor) {
    tch::no_grad(|| {
        let latents: Vec<f32> = pairs.iter().flat_map(|pair| pair.1).collect();
        let views: Vec<i64> = pairs.iter().map(|pair| pictures.labels[pair.0].view as i64).collect();
        let views = Tensor::from_slice(&views);
        let means = pictures.pose_means.index_select(0, &views);
        let latents = Tensor::from_slice(&latents).view([-1, LATENT_DIM as i64]).to_device(decoder.device());
        let out = decoder.forward(&latents, &views.to_device(decoder.device())).to_device(Device::Cpu);
        let out = if residual { out + &means } else { out };
        (out.clamp(0.0, 1.0), means)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The divergence is the closed form: zero for the standard normal, and 8 * (0.5 m^2) for a mean of m.
    #[test]
    fn kl_is_the_closed_form() {
        let zero = Tensor::zeros([2, 8], (Kind::Float, Device::Cpu));
        assert!(kl_divergence(&zero, &zero).double_value(&[]).abs() < 1e-6);
        assert!((kl_divergence(&(&zero + 0.5), &zero).double_value(&[]) - 1.0).abs() < 1e-5);
    }

    /// A pass takes each picture of the data set's own poses as often as it is told, once in batches of them alone, and
    /// each of a free pose once; what is of one pose stays together.
    #[test]
    fn a_pass_takes_own_pictures_as_often_as_told() {
        let poses =
            |of: std::ops::Range<usize>| of.map(|pose| (3 * pose..3 * pose + 3).collect()).collect::<Vec<Vec<_>>>();
        let mut rng = carff_random::stream(Key { seed: 1, frame: 0, step: 0, sample: 0 });
        for own_passes in [1, 4] {
            let batches = whole_poses(poses(0..10), poses(10..60), own_passes, 30, &mut rng);
            let mut taken = [0; 180];
            batches.iter().flatten().for_each(|&picture| taken[picture] += 1);
            assert!(taken[..30].iter().all(|&times| times == own_passes), "{taken:?}");
            assert!(taken[30..].iter().all(|&times| times == 1), "{taken:?}");
            let own = batches.iter().filter(|batch| batch.iter().all(|&picture| picture < 30)).count();
            assert_eq!((own, batches.len()), (1, (own_passes * 30 + 150) / 30));
            let together =
                |batch: &[usize], picture: usize| batch.iter().filter(|&&p| p / 3 == picture / 3).count() % 3;
            assert!(batches.iter().all(|batch| batch.iter().all(|&picture| together(batch, picture) == 0)));
        }
    }

    /// Features lie in the order in which they are computed: every copy of all pictures, then every further copy of those
    /// that have more.
    #[test]
    fn features_are_found_where_they_were_put() {
        let own = [Some(0), None, Some(1), None, Some(2)];
        let all = (0..2).flat_map(|copy| (0..5).map(move |picture| (picture, copy)));
        let further = (2..5).flat_map(|copy| [0, 2, 4].map(|picture| (picture, copy)));
        for (row, (picture, copy)) in all.chain(further).enumerate() {
            assert_eq!(feature_row(&own, 3, 2, picture, copy), row, "picture {picture}, copy {copy}");
        }
    }

    /// Views of one state closer together, states further apart: a smaller loss.
    #[test]
    fn contrastive_prefers_clusters() {
        let states = Tensor::from_slice(&[0_i64, 0, 1, 1]);
        let of = |rows: [[f32; 2]; 4]| {
            let flat: Vec<f32> = rows.iter().flat_map(|r| [r[0], r[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).collect();
            contrastive(&Tensor::from_slice(&flat).view([4, 8]), &states, 0.2).double_value(&[])
        };
        let clustered = of([[1.0, 0.0], [1.0, 0.1], [-1.0, 0.0], [-1.0, 0.1]]);
        let mixed = of([[1.0, 0.0], [-1.0, 0.1], [-1.0, 0.0], [1.0, 0.1]]);
        assert!(clustered < 0.1 && mixed > 1.0, "{clustered} {mixed}");
    }
}
