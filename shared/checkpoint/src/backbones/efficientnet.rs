//! EfficientNet-Lite0 (Tan and Le 2019, Lite variant) up to stride 16: its layers, and the names of its tensors.

/// Kernel, stride, expansion, input and output channels of each block up to the 112-channel stage.
pub const BLOCKS: [(i64, i64, i64, i64, i64); 11] = [
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

/// Epsilon of batch normalisation.
pub const BATCH_NORM_EPSILON: f64 = 1e-3;

/// A convolution with its batch normalisation, by their published names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Name of the convolution.
    pub convolution: String,
    /// Name of the batch normalisation.
    pub norm: String,
    /// Output channels, input channels of a group, kernel height and width.
    pub shape: [i64; 4],
    /// Stride.
    pub stride: i64,
    /// Groups of channels.
    pub groups: i64,
}

/// Tensors of batch normalisation, each with one value per output channel.
pub const NORM_PARTS: [&str; 4] = ["weight", "bias", "running_mean", "running_var"];

impl Layer {
    /// Returns TensorFlow's "same" padding of a square image: pixels at the top, left, bottom and right. The odd pixel
    /// is at the right and the bottom.
    pub fn pads(&self, side: i64) -> [i64; 4] {
        let pad = ((side + self.stride - 1) / self.stride - 1) * self.stride + self.shape[2] - side;
        let (before, after) = (pad.max(0) / 2, pad.max(0) - pad.max(0) / 2);
        [before, before, after, after]
    }
}

/// Returns the first layer.
pub fn stem_layer() -> Layer {
    Layer { convolution: "_conv_stem".into(), norm: "_bn0".into(), shape: [32, 3, 3, 3], stride: 2, groups: 1 }
}

/// Returns a block's layers: the expansion (except in the first block), the depthwise layer and the projection.
pub fn block_layers(block: usize) -> (Option<Layer>, Layer, Layer) {
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

/// Returns true if a block's input is added to its output.
pub fn has_skip(block: usize) -> bool {
    let (_, stride, _, input, output) = BLOCKS[block];
    stride == 1 && input == output
}

/// Returns true for tensors that the feature map does not depend on: later blocks, the classifier, and counters.
pub fn is_beyond_the_features(name: &str) -> bool {
    let parts: Vec<&str> = name.split('.').collect();
    match parts[..] {
        ["_conv_head" | "_bn1" | "_fc", ..] | [.., "num_batches_tracked"] => true,
        ["_blocks", block, ..] => block.parse::<usize>().is_ok_and(|block| block >= BLOCKS.len()),
        _ => false,
    }
}

/// Blocks of each of timm's stages.
const TIMM_STAGES: [usize; 7] = [1, 2, 2, 3, 3, 4, 1];

/// Converts a name of timm's `tf_efficientnet_lite0` to the published name; `None` for other names.
pub fn published_name(timm: &str) -> Option<String> {
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
