//! Shapes of the networks, as in the manifest and in training files.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Shape of the encoder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderConfig {
    /// The image backbone.
    pub backbone: BackboneConfig,
    /// Channels of the optional convolutional stem before the backbone; 0 omits it. With a stem, training runs the
    /// backbone in every step, because its features cannot be cached.
    pub stem_channels: i64,
    /// Channels after the head's 1x1 convolution.
    pub reduce_channels: i64,
    /// Channels after the head's strided 3x3 convolution.
    pub pool_channels: i64,
    /// Width of the head's hidden layer.
    pub hidden: i64,
}

impl EncoderConfig {
    /// Range of the posterior's log-variances, so that no posterior collapses to a point or covers the whole space.
    pub const LOG_VARIANCES: (f32, f32) = (-8.0, 4.0);
}

impl Default for EncoderConfig {
    fn default() -> Self {
        Self {
            backbone: BackboneConfig::default(),
            stem_channels: 0,
            reduce_channels: 128,
            pool_channels: 64,
            hidden: 256,
        }
    }
}

/// Kind and options of the backbone.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BackboneConfig {
    /// Kind of network.
    pub kind: BackboneKind,
    /// True if the weights are frozen. A small convolutional network from scratch must be trained.
    #[serde(default = "yes")]
    pub frozen: bool,
    /// Side in pixels to which images are resized before they enter: a multiple of 32, or of a vision transformer's
    /// patches.
    #[serde(default = "default_input_px")]
    pub input_px: i64,
    /// Size of a vision transformer; ignored for other kinds.
    #[serde(default)]
    pub vit: VitConfig,
}

fn yes() -> bool {
    true
}

fn default_input_px() -> i64 {
    224
}

impl Default for BackboneConfig {
    fn default() -> Self {
        Self { kind: BackboneKind::EfficientNetLite0, frozen: true, input_px: 224, vit: VitConfig::default() }
    }
}

/// Kind of backbone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum BackboneKind {
    /// EfficientNet-Lite0 up to its 112-channel stage (stride 16), pretrained on ImageNet-1k.
    #[serde(rename = "efficientnet-lite0")]
    EfficientNetLite0,
    /// A vision transformer of any size; standard safetensors weights, or random ones.
    Vit,
    /// A small convolutional network, from scratch.
    ConvNet,
}

/// Size of a vision transformer. The default is ViT-L/16, the paper's.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VitConfig {
    /// Side of a patch, pixels.
    pub patch_px: i64,
    /// Width of a token.
    pub width: i64,
    /// Number of blocks.
    pub depth: i64,
    /// Attention heads; must divide the width.
    pub heads: i64,
    /// Register tokens.
    #[serde(skip_serializing_if = "is_zero")]
    pub registers: i64,
}

pub(crate) fn is_zero<N: Default + PartialEq>(number: &N) -> bool {
    *number == N::default()
}

impl Default for VitConfig {
    fn default() -> Self {
        Self { patch_px: 16, width: 1024, depth: 24, heads: 16, registers: 0 }
    }
}

/// Shape of the decoder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DecoderConfig {
    /// Width of the hidden layer that joins latent and pose.
    pub hidden: i64,
    /// Channels at 8x8; halved at most once on the way up.
    pub channels: i64,
    /// True if the decoder gets the pose. Otherwise a latent has a single image, and the encoder must encode the pose.
    /// A residual over the pose's mean image would also reveal the pose (`vae.residual = false`).
    pub pose_condition: bool,
    /// True if the one-hot pose is concatenated with the latent, as in the paper; false if it is multiplied with the
    /// latent, so that each pose has its own map of the latent.
    pub concatenated: bool,
}

impl Default for DecoderConfig {
    fn default() -> Self {
        Self { hidden: 256, channels: 64, pose_condition: true, concatenated: false }
    }
}

/// Shape of the mixture density network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MixtureConfig {
    /// Number of mixture components K, 1 to 4 (paper: 2).
    #[schemars(range(min = 1, max = 4))]
    pub components: i64,
    /// Width of the two hidden layers (paper: 512).
    pub hidden: i64,
    /// Width of the weight head's hidden layers.
    pub weight_hidden: i64,
    /// Width of the hidden layer in the heads of means and log-variances, 0 to 4096. 0: these heads have one layer
    /// (paper: two).
    #[schemars(range(min = 0, max = 4096))]
    pub head_hidden: i64,
}

impl MixtureConfig {
    /// Range of the components' log-variances.
    pub const LOG_VARIANCES: (f32, f32) = (-7.0, 4.0);

    /// Checks the ranges; returns the first key out of its range, with its value and the allowed ones.
    pub fn check(&self) -> Result<(), (&'static str, i64, &'static str)> {
        let Self { components, hidden, weight_hidden, head_hidden } = *self;
        for (key, value, range, allowed) in [
            ("mixture.components", components, 1..=4, "1 to 4"),
            ("mixture.hidden", hidden, 1..=i64::MAX, "at least 1"),
            ("mixture.weight_hidden", weight_hidden, 1..=i64::MAX, "at least 1"),
            ("mixture.head_hidden", head_hidden, 0..=4096, "0 to 4096"),
        ] {
            if !range.contains(&value) {
                return Err((key, value, allowed));
            }
        }
        Ok(())
    }
}

impl Default for MixtureConfig {
    fn default() -> Self {
        Self { components: 2, hidden: 512, weight_hidden: 128, head_hidden: 0 }
    }
}
