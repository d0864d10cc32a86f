//! EfficientNet-Lite0 (Tan and Le 2019, Lite variant: no squeeze-and-excite, `ReLU6`), up to stride 16.
//!
//! Batch normalisation is folded into the convolutions when the weights are read, even if they are trained further:
//! batches are small, and the statistics of pretraining should stay.

use super::{Backbone, resize};
use crate::{
    ModelError,
    weights::{Tensors, select},
};
use tch::{Kind, Tensor, nn};

/// Kernel, stride, expansion, input and output channels of each block up to the 112-channel stage.
const BLOCKS: [(i64, i64, i64, i64, i64); 11] = [
    (3, 1, 1, 32, 16),
    (3, 2, 6, 16, 24),
    (3, 1, 6, 24, 24),
    (5, 2, 6, 24, 40),
    (5, 1, 6, 40, 40),
    (3, 2, 6, 40, 80),
    (3, 1, 6, 80, 80),
    (3, 1, 6, 80, 80),
    (5, 1, 6, 80, 112),
    (5, 1, 6, 112, 112),
    (5, 1, 6, 112, 112),
];

const BATCH_NORM_EPSILON: f64 = 1e-3;

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

/// A convolution with its batch normalisation, by their published names.
struct Layer {
    convolution: String,
    norm: String,
    /// Output channels, input channels of a group, kernel height and width.
    shape: [i64; 4],
    stride: i64,
    groups: i64,
}

/// Tensors of batch normalisation, each with one value per output channel.
const NORM_PARTS: [&str; 4] = ["weight", "bias", "running_mean", "running_var"];

fn stem_layer() -> Layer {
    Layer { convolution: "_conv_stem".into(), norm: "_bn0".into(), shape: [32, 3, 3, 3], stride: 2, groups: 1 }
}

/// Returns a block's layers: the expansion (except in the first block), the depthwise layer and the projection.
fn block_layers(block: usize) -> (Option<Layer>, Layer, Layer) {
    let (kernel, stride, expansion, input, output) = BLOCKS[block];
    let inner = input * expansion;
    let layer = |convolution: &str, norm: &str, shape, stride, groups| Layer {
        convolution: format!("_blocks.{block}.{convolution}"),
        norm: format!("_blocks.{block}.{norm}"),
        shape,
        stride,
        groups,
    };
    (
        (expansion > 1).then(|| layer("_expand_conv", "_bn0", [inner, input, 1, 1], 1, 1)),
        layer("_depthwise_conv", "_bn1", [inner, 1, kernel, kernel], stride, inner),
        layer("_project_conv", "_bn2", [output, inner, 1, 1], 1, 1),
    )
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
        let blocks = BLOCKS.iter().enumerate().map(|(i, &(_, stride, _, input, output))| {
            let (expand, depthwise, project) = block_layers(i);
            Block {
                expand: expand.as_ref().map(read),
                depthwise: read(&depthwise),
                project: read(&project),
                skip: stride == 1 && input == output,
            }
        });
        Ok(Self { stem: read(&stem_layer()), blocks: blocks.collect(), input_px })
    }
}

/// Returns true for tensors that the feature map does not depend on: later blocks, the classifier, and counters.
fn is_beyond_the_features(name: &str) -> bool {
    let parts: Vec<&str> = name.split('.').collect();
    match parts[..] {
        ["_conv_head" | "_bn1" | "_fc", ..] | [.., "num_batches_tracked"] => true,
        ["_blocks", block, ..] => block.parse::<usize>().is_ok_and(|block| block >= BLOCKS.len()),
        _ => false,
    }
}

/// Blocks of each of timm's stages.
const TIMM_STAGES: [usize; 7] = [1, 2, 2, 3, 3, 4, 1];

/// Converts timm's names to published names; other names are unchanged.
fn published_names(tensors: &Tensors) -> Tensors {
    let in_timm = tensors.contains_key("conv_stem.weight");
    let renamed = |name: &str| if in_timm { published_name(name) } else { None };
    tensors.iter().map(|(name, t)| (renamed(name).unwrap_or_else(|| name.clone()), t.shallow_clone())).collect()
}

fn published_name(timm: &str) -> Option<String> {
    let (layer, part) = timm.rsplit_once('.')?;
    let layer = match layer.split('.').collect::<Vec<_>>()[..] {
        ["conv_stem"] => "_conv_stem".into(),
        ["bn1"] => "_bn0".into(),
        ["conv_head"] => "_conv_head".into(),
        ["bn2"] => "_bn1".into(),
        ["classifier"] => "_fc".into(),
        ["blocks", stage, block, layer] => {
            let (stage, block) = (stage.parse::<usize>().ok()?, block.parse::<usize>().ok()?);
            if block >= *TIMM_STAGES.get(stage)? {
                return None;
            }
            // The first stage has no expansion, so that its layers are counted from the depthwise one.
            let layer = match (stage, layer) {
                (0, "conv_pw") | (1.., "conv_pwl") => "_project_conv",
                (1.., "conv_pw") => "_expand_conv",
                (_, "conv_dw") => "_depthwise_conv",
                (1.., "bn1") => "_bn0",
                (0, "bn1") | (1.., "bn2") => "_bn1",
                (0, "bn2") | (1.., "bn3") => "_bn2",
                _ => return None,
            };
            format!("_blocks.{}.{layer}", TIMM_STAGES[..stage].iter().sum::<usize>() + block)
        }
        _ => return None,
    };
    Some(format!("{layer}.{part}"))
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
    fn features(&self, pictures: &Tensor) -> Tensor {
        // The published model's input is (byte - 127) / 128.
        let x = resize(pictures, self.input_px) * (255.0 / 128.0) - 127.0 / 128.0;
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
