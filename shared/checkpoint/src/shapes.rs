//! Shapes of the networks in a checkpoint: what its manifest and a training file say of them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Shape of the encoder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderConfig {
    /// The image backbone.
    pub backbone: BackboneConfig,
    /// Channels of the optional convolutional stem before the backbone; 0 leaves it out. A stem makes training run
    /// the backbone in every step, since its features cannot be kept.
    pub stem_channels: i64,
    /// Channels after the head's 1x1 convolution.
    pub reduce_channels: i64,
    /// Channels after the head's strided 3x3 convolution.
    pub pool_channels: i64,
    /// Width of the head's hidden layer.
    pub hidden: i64,
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

/// Which backbone, and whether it learns.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BackboneConfig {
    /// Which network.
    pub kind: BackboneKind,
    /// Whether the weights stay as they were loaded. A small convolutional network from scratch must learn.
    #[serde(default = "yes")]
    pub frozen: bool,
    /// Side in pixels that images are resized to before they enter.
    #[serde(default = "default_input_px")]
    pub input_px: i64,
    /// Size of a vision transformer; ignored by the others.
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

/// The backbones there are.
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
    /// Patch side, pixels.
    pub patch_px: i64,
    /// Token width.
    pub width: i64,
    /// Number of blocks.
    pub depth: i64,
    /// Attention heads; must divide the width.
    pub heads: i64,
}

impl Default for VitConfig {
    fn default() -> Self {
        Self { patch_px: 16, width: 1024, depth: 24, heads: 16 }
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
    /// Whether it is told the pose. Without, one latent has one image, and the encoder must put the pose into it; the
    /// residual over the pose's mean image would tell the pose too (`vae.residual = false`).
    pub pose_condition: bool,
}

impl Default for DecoderConfig {
    fn default() -> Self {
        Self { hidden: 256, channels: 64, pose_condition: true }
    }
}

/// Shape of the mixture density network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MixtureConfig {
    /// Number of mixture components K, 1 to 4 (paper: 2).
    pub components: i64,
    /// Width of the two hidden layers (paper: 512).
    pub hidden: i64,
    /// Width of the weight head's hidden layers.
    pub weight_hidden: i64,
}

impl Default for MixtureConfig {
    fn default() -> Self {
        Self { components: 2, hidden: 512, weight_hidden: 128 }
    }
}
