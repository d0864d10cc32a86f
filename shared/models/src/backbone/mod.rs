//! Image backbones behind one trait: from a picture to a map of spatial features.

mod convnet;
mod efficientnet;
mod vit;

pub use convnet::ConvNet;
pub use efficientnet::EfficientNetLite0;
pub use vit::{VisionTransformer, VitConfig};

use crate::{ModelError, weights};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;
use tch::{Tensor, nn};

/// From pictures to spatial features.
pub trait Backbone: Send {
    /// `[N, 3, H, W]` in 0..=1, of any size, to `[N, channels, grid, grid]`.
    fn features(&self, pictures: &Tensor) -> Tensor;
    /// Feature channels.
    fn channels(&self) -> i64;
    /// Side of the feature map, in cells.
    fn grid(&self) -> i64;
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
    /// Side in pixels that pictures are resized to before they enter.
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

/// Builds a backbone in `path`. With `pretrained`, its weights are read from that file.
pub fn build(
    config: &BackboneConfig,
    path: &nn::Path,
    pretrained: Option<&Path>,
) -> Result<Box<dyn Backbone>, ModelError> {
    if !(32..=1024).contains(&config.input_px) || config.input_px % 32 != 0 {
        return Err(ModelError::Setting {
            key: "backbone.input_px",
            value: config.input_px.to_string(),
            allowed: "a multiple of 32 from 32 to 1024",
        });
    }
    let tensors = pretrained.map(weights::read).transpose()?;
    let in_file = |e: ModelError| match (e, pretrained) {
        (ModelError::Mismatch(what), Some(file)) => ModelError::Format { path: file.into(), what },
        (e, _) => e,
    };
    Ok(match config.kind {
        BackboneKind::EfficientNetLite0 => {
            Box::new(EfficientNetLite0::new(path, tensors.as_ref(), config.input_px).map_err(in_file)?)
        }
        BackboneKind::Vit => {
            Box::new(VisionTransformer::new(path, &config.vit, tensors.as_ref(), config.input_px).map_err(in_file)?)
        }
        BackboneKind::ConvNet => {
            let net = ConvNet::new(path, config.input_px);
            if tensors.is_some() {
                return Err(ModelError::Setting {
                    key: "backbone.kind",
                    value: "conv-net".into(),
                    allowed: "no pretrained weights exist for the convolutional net: leave `pretrained` out",
                });
            }
            Box::new(net)
        }
    })
}

/// Resizes pictures to a square of `side` pixels, bilinearly; leaves them as they are when they fit already.
pub(crate) fn resize(pictures: &Tensor, side: i64) -> Tensor {
    let size = pictures.size();
    if size[2] == side && size[3] == side {
        pictures.shallow_clone()
    } else if size[2] > side || size[3] > side {
        // Averaged, so that what is finer than the new pixels leaves no pattern.
        pictures.internal_upsample_bilinear2d_aa([side, side], false, None, None)
    } else {
        pictures.upsample_bilinear2d([side, side], false, None, None)
    }
}
