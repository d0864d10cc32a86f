//! Image backbones with a common trait: from an image to a map of spatial features.

mod convnet;
mod efficientnet;
mod vit;

pub use convnet::ConvNet;
pub use efficientnet::EfficientNetLite0;
pub use vit::VisionTransformer;

use crate::{ModelError, weights};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind};
use std::path::Path;
use tch::{Tensor, nn};

/// A network from images to spatial features.
pub trait Backbone: Send {
    /// Maps images `[N, 3, H, W]` in 0..=1, of any size, to `[N, channels, grid, grid]`.
    fn features(&self, images: &Tensor) -> Tensor;
    /// Returns the number of feature channels.
    fn channels(&self) -> i64;
    /// Returns the side of the feature map, in cells.
    fn grid(&self) -> i64;
}

/// Builds a backbone in `path`; `pretrained` is the file of its weights.
pub fn build(
    config: &BackboneConfig,
    path: &nn::Path,
    pretrained: Option<&Path>,
) -> Result<Box<dyn Backbone>, ModelError> {
    // A vision transformer checks its own unit, the side of a patch.
    let unit = if config.kind == BackboneKind::Vit { 1 } else { 32 };
    if !(unit..=1024).contains(&config.input_px) || config.input_px % unit != 0 {
        return Err(ModelError::Setting {
            key: "backbone.input_px",
            value: config.input_px.to_string(),
            allowed: "a multiple of 32 (vision transformer: of `patch_px`), at most 1024",
        });
    }
    let tensors = pretrained.map(weights::read).transpose()?;
    let in_file = |e: ModelError| match (e, pretrained) {
        (ModelError::Mismatch(what), Some(file)) => ModelError::Format {
            path: file.into(),
            what: format!("{what}; use weights of this backbone, or set `[backbone]` to theirs"),
        },
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
                    allowed: "no pretrained weights exist for the convolutional net: omit `pretrained`",
                });
            }
            Box::new(net)
        }
    })
}

/// Resizes images to a square of `side` pixels, bilinearly; images of that size are unchanged.
pub(crate) fn resize(images: &Tensor, side: i64) -> Tensor {
    let size = images.size();
    if size[2] == side && size[3] == side {
        images.shallow_clone()
    } else if size[2] > side || size[3] > side {
        // Averaging removes detail finer than the new pixels, to avoid aliasing.
        images.internal_upsample_bilinear2d_aa([side, side], false, None, None)
    } else {
        images.upsample_bilinear2d([side, side], false, None, None)
    }
}
