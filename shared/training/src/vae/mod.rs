//! Training of the pose-conditional VAE (paper section 3.2).
//!
//! The plain loss (KL divergence and squared error only) ends in posterior collapse that the PSNR does not show. Three
//! terms prevent it. The decoder learns the residual over the pose's mean image. Pixels that change have a higher
//! weight. A linear read-out of the sampled latent must give the state, up to equivalent states of the view. The last
//! term gives a view that hides the actor an even posterior over the states.

mod inputs;
pub mod losses;
mod other_poses;
mod train;

use crate::{
    TrainingConfig, TrainingError,
    run::{Context, part, prefixed},
};
use carff_dataset::PoseRole;
use carff_evaluation::{Centroids, Decoding, VaeFigures, state_accuracy};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_networks::{
    ModelError,
    adam::Adam,
    decoder::{Decoder, SmallDecoder},
    encoder::Encoder,
    weights::{self, Tensors},
};
pub use inputs::Inputs;
use std::path::Path;
use tch::{Device, Tensor, nn, nn::VarStore};
pub use train::VaePhase;

/// Encoder, decoder, and what only training uses: the read-out and the small decoder of other poses.
pub struct Vae {
    /// The encoder.
    pub encoder: Encoder,
    /// The decoder.
    pub decoder: Decoder,
    pub(super) read_out: nn::Linear,
    /// Present when the decoder is asked for other poses than the input's.
    pub(super) small_decoder: Option<SmallDecoder>,
    backbone: VarStore,
    head: VarStore,
    decoder_store: VarStore,
    read_out_store: VarStore,
    small_store: VarStore,
    frozen: bool,
}

impl Vae {
    /// A VAE on `device` with random weights from libtorch's global generator, and backbone weights from `pretrained`.
    pub fn new(
        config: &TrainingConfig,
        poses: usize,
        states: usize,
        pretrained: Option<&Path>,
        device: Device,
    ) -> Result<Self, ModelError> {
        let [mut backbone, head, decoder_store, read_out_store, small_store] = [(); 5].map(|()| VarStore::new(device));
        let encoder =
            Encoder::new(&config.encoder, &(backbone.root() / "backbone"), &(head.root() / "encoder"), pretrained)?;
        let decoder = Decoder::new(&(decoder_store.root() / "decoder"), &config.decoder, poses as i64);
        let read_out = nn::linear(
            read_out_store.root() / "read_out",
            LATENT_DIM as i64,
            states as i64,
            nn::LinearConfig::default(),
        );
        let path = small_store.root() / "small_decoder";
        let small_decoder =
            (config.vae.other_poses > 0).then(|| SmallDecoder::new(&path, &config.decoder, poses as i64));
        let frozen = config.encoder.backbone.frozen;
        if frozen {
            backbone.freeze();
        }
        Ok(Self {
            encoder,
            decoder,
            read_out,
            small_decoder,
            backbone,
            head,
            decoder_store,
            read_out_store,
            small_store,
            frozen,
        })
    }

    /// Weights of a checkpoint: encoder head, decoder, backbone.
    pub fn weights(&self) -> (Tensors, Tensors, Tensors) {
        (weights::of_store(&self.head), weights::of_store(&self.decoder_store), weights::of_store(&self.backbone))
    }

    /// Device of the models.
    pub fn device(&self) -> Device {
        self.head.device()
    }

    pub(crate) fn stores(&self) -> Vec<&VarStore> {
        let mut stores = vec![&self.head, &self.decoder_store, &self.read_out_store, &self.small_store];
        if !self.frozen {
            stores.push(&self.backbone);
        }
        stores
    }

    pub(crate) fn state(&self, adam: &Adam) -> Tensors {
        let mut all: Tensors = prefixed("adam.", adam.state()).collect();
        for store in self.stores() {
            all.extend(prefixed("weights.", weights::of_store(store)));
        }
        all
    }

    pub(crate) fn restore(&self, adam: Option<&mut Adam>, state: &Tensors) -> bool {
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

    /// Restores the weights of a saved state; `false` when they do not fit.
    #[must_use]
    pub fn restore_weights(&self, state: &Tensors) -> bool {
        self.restore(None, state)
    }

    /// Figures of posterior means, and with `image_quality` those of decoded images on trained poses.
    pub fn figures(
        &self,
        context: Context,
        posteriors: &[Gaussian],
        image_quality: bool,
    ) -> Result<VaeFigures, TrainingError> {
        let Context { config, posed, .. } = context;
        let centroids = Centroids::fit(posed, posteriors).ok_or_else(|| {
            TrainingError::Unfit(
                "some state has no image from a trained pose; add images, or choose another `split_seed`".into(),
            )
        })?;
        let accuracy = |role| {
            let table = state_accuracy(posed, posteriors, &centroids, &posed.with_roles(&[role]));
            table.map(Into::into)
        };
        let figures = VaeFigures {
            trained: accuracy(PoseRole::Rest),
            calibration: accuracy(PoseRole::Calibration),
            unseen: accuracy(PoseRole::Unseen),
            ..VaeFigures::default()
        };
        if !image_quality {
            return Ok(figures);
        }
        let pairs: Vec<_> = posed.trained().into_iter().map(|i| (i, posteriors[i].mean)).collect();
        let decoding = Decoding { posed, decoder: &self.decoder, residual: config.vae.residual };
        Ok(figures.with_quality(decoding.quality(&pairs)))
    }
}

/// Row indices on a device.
fn indices(rows: impl IntoIterator<Item = usize>, device: Device) -> Tensor {
    Tensor::from_slice(&rows.into_iter().map(|row| row as i64).collect::<Vec<_>>()).to_device(device)
}
