//! Layers and published tensor names of the image backbones, without a tensor library.

pub mod efficientnet;
pub mod vit;
