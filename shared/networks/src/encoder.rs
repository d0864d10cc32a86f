//! The pose-conditional VAE's encoder: from one image to a Gaussian over the scene latent (paper section 3.2).

use crate::{
    ModelError,
    backbone::{self, Backbone},
    borrow,
};
use carff_checkpoint::{Encodes, shapes::EncoderConfig};
use carff_messages::{Gaussian, LATENT_DIM};
use ndarray::ArrayView3;
use std::path::Path;
use tch::{Kind, Tensor, nn, nn::Module};

/// Encoder with backbone and head.
pub struct Encoder {
    stem: Option<(nn::Conv2D, nn::Conv2D)>,
    backbone: Box<dyn Backbone>,
    head: Head,
}

#[derive(Debug)]
struct Head {
    center: Tensor,
    scale: Tensor,
    reduce: nn::Conv2D,
    pool: nn::Conv2D,
    hidden: nn::Linear,
    mean: nn::Linear,
    log_variance: nn::Linear,
}

impl Encoder {
    /// Builds the encoder: backbone variables in `backbone_path`, all other trained variables in `head_path`.
    pub fn new(
        config: &EncoderConfig,
        backbone_path: &nn::Path,
        head_path: &nn::Path,
        pretrained: Option<&Path>,
    ) -> Result<Self, ModelError> {
        let backbone = backbone::build(&config.backbone, backbone_path, pretrained)?;
        let same = nn::ConvConfig { padding: 1, ..Default::default() };
        let stem = (config.stem_channels > 0).then(|| {
            let p = head_path / "stem";
            let last = nn::ConvConfig { ws_init: nn::Init::Const(0.0), ..same };
            (
                nn::conv2d(&p / "first", 3, config.stem_channels, 3, same),
                nn::conv2d(&p / "last", config.stem_channels, 3, 3, last),
            )
        });
        let strided = nn::ConvConfig { stride: 2, padding: 1, ..Default::default() };
        let p = head_path / "head";
        let side = (backbone.grid() + 1) / 2;
        let linear = nn::LinearConfig::default();
        let head = Head {
            center: p.zeros_no_train("center", &[1, backbone.channels(), 1, 1]),
            scale: p.ones_no_train("scale", &[1, backbone.channels(), 1, 1]),
            reduce: nn::conv2d(
                &p / "reduce",
                backbone.channels(),
                config.reduce_channels,
                1,
                nn::ConvConfig::default(),
            ),
            pool: nn::conv2d(&p / "pool", config.reduce_channels, config.pool_channels, 3, strided),
            hidden: nn::linear(&p / "hidden", config.pool_channels * side * side, config.hidden, linear),
            mean: nn::linear(&p / "mean", config.hidden, LATENT_DIM as i64, linear),
            // Posteriors start narrow: wide ones would hide the mean before it is trained.
            log_variance: nn::linear(
                &p / "log_variance",
                config.hidden,
                LATENT_DIM as i64,
                nn::LinearConfig { bs_init: Some(nn::Init::Const(-4.0)), ..linear },
            ),
        };
        Ok(Self { stem, backbone, head })
    }

    /// Maps images `[N, 3, H, W]` in 0..=1 to backbone features `[N, C, h, w]`, on the encoder's device.
    pub fn features(&self, images: &Tensor) -> Tensor {
        let images = &images.to_device(self.head.center.device());
        match &self.stem {
            None => self.backbone.features(images),
            Some((first, last)) => self.backbone.features(&(images + last.forward(&first.forward(images).relu()))),
        }
    }

    /// Returns the shape of one image's features: channels, height, width.
    pub fn feature_shape(&self) -> [i64; 3] {
        [self.backbone.channels(), self.backbone.grid(), self.backbone.grid()]
    }

    /// Maps backbone features to posterior mean and log-variance, each `[N, 8]`. Hidden units are dropped with
    /// probability `dropout` (training only).
    pub fn posterior(&self, features: &Tensor, dropout: f64) -> (Tensor, Tensor) {
        let x = (features - &self.head.center) * &self.head.scale;
        let x = self.head.reduce.forward(&x).relu();
        let x = self.head.pool.forward(&x).relu().flatten(1, -1);
        let x = if dropout > 0.0 { x.dropout(dropout, true) } else { x };
        let x = self.head.hidden.forward(&x).relu();
        let (low, high) = EncoderConfig::LOG_VARIANCES;
        let log_variance = self.head.log_variance.forward(&x).clamp(f64::from(low), f64::from(high));
        (self.head.mean.forward(&x), log_variance)
    }

    /// Makes the head standardise features to zero mean and unit deviation per channel, as measured on `features`.
    pub fn standardise(&mut self, features: &Tensor) {
        tch::no_grad(|| {
            let axes = [0_i64, 2, 3];
            let mean = features.mean_dim(axes.as_slice(), true, Kind::Float);
            let deviation = (features - &mean).square().mean_dim(axes.as_slice(), true, Kind::Float).sqrt();
            self.head.center.copy_(&mean);
            self.head.scale.copy_(&(deviation + 1e-3).reciprocal());
        });
    }

    /// Returns the posteriors of images `[N, 3, H, W]`.
    pub fn encode(&self, images: &Tensor) -> Vec<Gaussian> {
        tch::no_grad(|| {
            let (mean, log_variance) = self.posterior(&self.features(images), 0.0);
            gaussians(&mean, &log_variance)
        })
    }

    /// Returns the posterior of one image, `[H, W, 3]` bytes.
    pub fn encode_bytes(&self, image: &Tensor) -> Option<Gaussian> {
        self.encode(&images_from_bytes(&image.unsqueeze(0))).into_iter().next()
    }
}

impl Encodes for Encoder {
    fn posterior_of(&self, image: ArrayView3<'_, u8>) -> Option<Gaussian> {
        borrow::with_image(image, |tensor| self.encode_bytes(tensor)).flatten()
    }
}

/// Converts `[N, H, W, 3]` bytes to `[N, 3, H, W]` in 0..=1.
pub fn images_from_bytes(bytes: &Tensor) -> Tensor {
    bytes.permute([0, 3, 1, 2]).to_kind(Kind::Float) * (1.0 / 255.0)
}

/// Converts two `[N, 8]` tensors to Gaussians.
pub fn gaussians(mean: &Tensor, log_variance: &Tensor) -> Vec<Gaussian> {
    let rows = |t: &Tensor| {
        let mut flat = vec![0.0_f32; t.numel()];
        let t = t.to_device(tch::Device::Cpu).contiguous();
        t.copy_data(&mut flat, t.numel());
        flat
    };
    rows(mean)
        .chunks_exact(LATENT_DIM)
        .zip(rows(log_variance).chunks_exact(LATENT_DIM))
        .map(|(m, v)| Gaussian { mean: std::array::from_fn(|i| m[i]), log_variance: std::array::from_fn(|i| v[i]) })
        .collect()
}
