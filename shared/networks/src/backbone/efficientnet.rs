//! EfficientNet-Lite0 (Tan and Le 2019, Lite variant: no squeeze-and-excite, `ReLU6`), up to stride 16.
//!
//! Batch normalisation is folded into the convolutions when the weights are read, even if they are trained further:
//! batches are small, and the statistics of pretraining should stay.

use super::{Backbone, resize};
use crate::{
    ModelError,
    weights::{Tensors, select},
};
use carff_checkpoint::backbones::efficientnet::{
    BATCH_NORM_EPSILON, BLOCKS, Layer, NORM_PARTS, block_layers, has_skip, is_beyond_the_features, published_name,
    stem_layer,
};
use tch::{Kind, Tensor, nn};

/// The network, with batch normalisation folded.
#[derive(Debug)]
pub struct EfficientNetLite0 {
    stem: Convolution,
    blocks: Vec<Block>,
    input_px: i64,
}

#[derive(Debug)]
struct Block {
    expand: Option<Convolution>,
    depthwise: Convolution,
    project: Convolution,
    skip: bool,
}

#[derive(Debug)]
struct Convolution {
    weight: Tensor,
    bias: Tensor,
    stride: i64,
    groups: i64,
}

impl EfficientNetLite0 {
    /// Returns names and shapes of the tensors that are read, as in the published state dict (`_conv_stem.weight`,
    /// `_blocks.0._bn1.weight`, ..).
    pub fn published() -> Vec<(String, Vec<i64>)> {
        let blocks = (0..BLOCKS.len()).flat_map(|i| {
            let (expand, depthwise, project) = block_layers(i);
            expand.into_iter().chain([depthwise, project])
        });
        std::iter::once(stem_layer())
            .chain(blocks)
            .flat_map(|layer| {
                let norms = NORM_PARTS.map(|part| (format!("{}.{part}", layer.norm), vec![layer.shape[0]]));
                std::iter::once((format!("{}.weight", layer.convolution), layer.shape.to_vec())).chain(norms)
            })
            .collect()
    }

    /// Returns the tensors of [`Self::published`], from published names or timm's.
    pub(crate) fn select(tensors: &Tensors) -> Result<Tensors, ModelError> {
        let own = published_names(tensors);
        let negative = |name: &&String| name.ends_with(".running_var") && own[*name].min().double_value(&[]) < 0.0;
        if let Some(name) = own.keys().find(negative) {
            return Err(ModelError::Mismatch(format!("`{name}` has negative variances")));
        }
        select(&own, &Self::published(), is_beyond_the_features)
    }

    /// Reads the weights by the names of [`Self::published`], or by timm's names for `tf_efficientnet_lite0`. Later
    /// blocks and the classifier are ignored. Without tensors, the weights are random (for tests, and for filling from
    /// a checkpoint). The folded weights are registered in `path`; to freeze them, freeze its store.
    ///
    /// # Errors
    ///
    /// [`ModelError::Mismatch`] lists missing and unknown tensors, and tensors of another shape.
    pub fn new(path: &nn::Path, tensors: Option<&Tensors>, input_px: i64) -> Result<Self, ModelError> {
        let tensors = tensors.map(Self::select).transpose()?;
        let read = |layer: &Layer| {
            let target = layer.convolution.split('.').fold(path.clone(), |p, part| p / part);
            folded(&target, tensors.as_ref(), layer)
        };
        let blocks = (0..BLOCKS.len()).map(|i| {
            let (expand, depthwise, project) = block_layers(i);
            Block {
                expand: expand.as_ref().map(read),
                depthwise: read(&depthwise),
                project: read(&project),
                skip: has_skip(i),
            }
        });
        Ok(Self { stem: read(&stem_layer()), blocks: blocks.collect(), input_px })
    }
}

/// Converts timm's names to published names; other names are unchanged.
fn published_names(tensors: &Tensors) -> Tensors {
    let in_timm = tensors.contains_key("conv_stem.weight");
    let renamed = |name: &str| if in_timm { published_name(name) } else { None };
    tensors.iter().map(|(name, t)| (renamed(name).unwrap_or_else(|| name.clone()), t.shallow_clone())).collect()
}

/// Returns a layer's convolution with its normalisation folded in. `tensors` has all of
/// [`EfficientNetLite0::published`].
fn folded(path: &nn::Path, tensors: Option<&Tensors>, layer: &Layer) -> Convolution {
    let shape = layer.shape;
    let (weight, bias) = match tensors {
        None => {
            let fan_in = (shape[1] * shape[2] * shape[3]) as f64;
            (
                Tensor::randn(shape, (Kind::Float, path.device())) * (2.0 / fan_in).sqrt(),
                Tensor::zeros([shape[0]], (Kind::Float, path.device())),
            )
        }
        Some(tensors) => {
            let [gain, shift, mean, variance] = NORM_PARTS.map(|part| &tensors[&format!("{}.{part}", layer.norm)]);
            let scale = gain / (variance + BATCH_NORM_EPSILON).sqrt();
            let weight = &tensors[&format!("{}.weight", layer.convolution)];
            (weight * scale.view([-1, 1, 1, 1]), shift - mean * scale)
        }
    };
    let [weight, bias] = [weight, bias].map(|t| t.to_device(path.device()));
    Convolution {
        weight: path.add("weight", weight, true),
        bias: path.add("bias", bias, true),
        stride: layer.stride,
        groups: layer.groups,
    }
}

impl Convolution {
    /// Convolves with TensorFlow's "same" padding: the odd pixel is at the right and the bottom.
    fn forward(&self, x: &Tensor) -> Tensor {
        let kernel = self.weight.size()[2];
        let side = x.size()[2];
        let pad = (((side + self.stride - 1) / self.stride - 1) * self.stride + kernel - side).max(0);
        let (before, after) = (pad / 2, pad - pad / 2);
        let s = [self.stride, self.stride];
        if before == after {
            x.conv2d(&self.weight, Some(&self.bias), s, [before, before], [1, 1], self.groups)
        } else {
            x.zero_pad2d(before, after, before, after).conv2d(
                &self.weight,
                Some(&self.bias),
                s,
                [0, 0],
                [1, 1],
                self.groups,
            )
        }
    }
}

/// Works in place: at these sizes a copy costs as much as the convolution.
fn relu6(mut x: Tensor) -> Tensor {
    x.clamp_(0.0, 6.0)
}

impl Backbone for EfficientNetLite0 {
    fn features(&self, images: &Tensor) -> Tensor {
        // The published model's input is (byte - 127) / 128.
        let x = resize(images, self.input_px) * (255.0 / 128.0) - 127.0 / 128.0;
        let mut x = relu6(self.stem.forward(&x));
        for block in &self.blocks {
            let inner = block.expand.as_ref().map_or_else(|| x.shallow_clone(), |e| relu6(e.forward(&x)));
            let out = block.project.forward(&relu6(block.depthwise.forward(&inner)));
            x = if block.skip { out + x } else { out };
        }
        x
    }

    fn channels(&self) -> i64 {
        112
    }

    fn grid(&self) -> i64 {
        self.input_px / 16
    }
}
