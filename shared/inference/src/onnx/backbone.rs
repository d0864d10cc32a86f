//! The backbones as operators. `carff_networks::backbone` has the same networks in tch.

use super::graph::{Builder, Name, float, int, text};
use super::{Convolution, Features};
use crate::InferenceError;
use crate::weights::{Arrays, StoredWeights};
use carff_checkpoint::backbones::{efficientnet, vit};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind, VitConfig};
use ndarray::{ArrayD, Axis, concatenate};

/// Channels of the small convolutional network's layers.
const CONV_NET: [i64; 5] = [3, 32, 64, 96, 112];

/// Adds a backbone that takes images in 0..=1. Its weights have published names, or the names of trained ones.
pub fn features(
    graph: &mut Builder,
    config: &BackboneConfig,
    weights: &mut StoredWeights,
    published: bool,
    image: &str,
) -> Result<Features, InferenceError> {
    let side = config.input_px;
    let unit = if config.kind == BackboneKind::Vit { config.vit.patch_px.max(1) } else { 32 };
    if !(unit..=1024).contains(&side) || side % unit != 0 {
        let allowed = "a multiple of 32 (vision transformer: of `patch_px`), at most 1024";
        return Err(InferenceError::Setting { key: "backbone.input_px", value: side, allowed });
    }
    let image = graph.resize(image, side);
    match config.kind {
        BackboneKind::EfficientNetLite0 => efficient_net(graph, weights, published, &image, side),
        BackboneKind::Vit => transformer(graph, &config.vit, weights, published, &image, side),
        BackboneKind::ConvNet => conv_net(graph, weights, &image, side),
    }
}

/// Returns true for published tensors that the features do not depend on.
pub fn is_beyond_the_features(kind: BackboneKind, name: &str) -> bool {
    match kind {
        BackboneKind::EfficientNetLite0 => efficientnet::is_beyond_the_features(name),
        BackboneKind::Vit => vit::is_beyond_the_features(name),
        BackboneKind::ConvNet => false,
    }
}

fn conv_net(
    graph: &mut Builder,
    weights: &mut StoredWeights,
    image: &str,
    side: i64,
) -> Result<Features, InferenceError> {
    let mut x = graph.scaled(image, 4.0, -2.0);
    for (i, width) in CONV_NET.windows(2).enumerate() {
        let convolution = graph.convolution(weights, &format!("{i}.conv"), [width[1], width[0], 3, 3], 2)?;
        x = graph.apply(convolution, &x);
        let [gain, shift] = ["weight", "bias"].map(|part| format!("{i}.norm.{part}"));
        let (gains, shifts) = (weights.take(&gain, &width[1..])?, weights.take(&shift, &width[1..])?);
        let (gain, shift) = (graph.weights(&gain, &gains), graph.weights(&shift, &shifts));
        let attributes = vec![int("num_groups", 8), float("epsilon", 1e-5)];
        x = graph.node("GroupNormalization", &[&x, &gain, &shift], attributes);
        x = graph.node("Relu", &[&x], Vec::new());
    }
    Ok(Features { name: x, channels: CONV_NET[4], grid: side / 16 })
}

fn efficient_net(
    graph: &mut Builder,
    weights: &mut StoredWeights,
    published: bool,
    image: &str,
    side_px: i64,
) -> Result<Features, InferenceError> {
    if published {
        weights.change(published_names);
    }
    let mut side = side_px;
    // The published model's input is (byte - 127) / 128.
    let x = graph.scaled(image, 255.0 / 128.0, -127.0 / 128.0);
    let mut layer = |graph: &mut Builder, layer: &efficientnet::Layer, x: &str| {
        let (weight, bias) = if published { folded(weights, layer)? } else { trained(weights, layer)? };
        let convolution = Convolution {
            weight: graph.weights(&format!("{}.weight", layer.convolution), &weight),
            bias: graph.weights(&format!("{}.bias", layer.convolution), &bias),
            stride: layer.stride,
            pads: layer.pads(side),
            groups: layer.groups,
        };
        side = (side + layer.stride - 1) / layer.stride;
        Ok::<Name, InferenceError>(graph.apply(convolution, x))
    };
    let x = layer(graph, &efficientnet::stem_layer(), &x)?;
    let mut x = graph.clip(&x, 0.0, 6.0);
    for block in 0..efficientnet::BLOCKS.len() {
        let (expand, depthwise, project) = efficientnet::block_layers(block);
        let inner = match &expand {
            Some(expand) => {
                let inner = layer(graph, expand, &x)?;
                graph.clip(&inner, 0.0, 6.0)
            }
            None => x.clone(),
        };
        let inner = layer(graph, &depthwise, &inner)?;
        let inner = graph.clip(&inner, 0.0, 6.0);
        let out = layer(graph, &project, &inner)?;
        x = if efficientnet::has_skip(block) { graph.node("Add", &[&out, &x], Vec::new()) } else { out };
    }
    Ok(Features { name: x, channels: 112, grid: side_px / 16 })
}

/// Converts timm's names to published names.
fn published_names(tensors: Arrays) -> Arrays {
    let in_timm = tensors.contains_key("conv_stem.weight");
    let renamed = |name: &str| if in_timm { efficientnet::published_name(name) } else { None };
    tensors.into_iter().map(|(name, t)| (renamed(&name).unwrap_or(name), t)).collect()
}

/// Weight and bias of a convolution, with its batch normalisation folded in.
fn folded(
    weights: &mut StoredWeights,
    layer: &efficientnet::Layer,
) -> Result<(ArrayD<f32>, ArrayD<f32>), InferenceError> {
    let channels = layer.shape[0];
    let weight = weights.take(&format!("{}.weight", layer.convolution), &layer.shape)?;
    let mut norm = |part: &str| weights.take(&format!("{}.{part}", layer.norm), &[channels]);
    let (gain, shift, mean, variance) = (norm("weight")?, norm("bias")?, norm("running_mean")?, norm("running_var")?);
    if variance.iter().any(|v| *v < 0.0) {
        return Err(weights.wrong(format!("`{}.running_var` has negative variances", layer.norm)));
    }
    let scale = gain / (variance + efficientnet::BATCH_NORM_EPSILON as f32).mapv(f32::sqrt);
    let bias = shift - mean * &scale;
    let mut weight = weight;
    weight.axis_iter_mut(Axis(0)).zip(&scale).for_each(|(mut filter, scale)| filter *= *scale);
    Ok((weight, bias))
}

/// Weight and bias of a convolution that was trained with its normalisation folded in.
fn trained(
    weights: &mut StoredWeights,
    layer: &efficientnet::Layer,
) -> Result<(ArrayD<f32>, ArrayD<f32>), InferenceError> {
    let weight = weights.take(&format!("{}.weight", layer.convolution), &layer.shape)?;
    Ok((weight, weights.take(&format!("{}.bias", layer.convolution), &layer.shape[..1])?))
}

fn transformer(
    graph: &mut Builder,
    config: &VitConfig,
    weights: &mut StoredWeights,
    published: bool,
    image: &str,
    side_px: i64,
) -> Result<Features, InferenceError> {
    let &VitConfig { patch_px, width, depth, heads, registers } = config;
    let wrong = |key, value, allowed| Err(InferenceError::Setting { key, value, allowed });
    if heads < 1 || width % heads.max(1) != 0 {
        return wrong("backbone.vit.heads", heads, "a divisor of `width`, at least 1");
    }
    if patch_px < 1 || side_px % patch_px.max(1) != 0 {
        return wrong("backbone.vit.patch_px", patch_px, "a divisor of `input_px`, at least 1");
    }
    if !(1..=64).contains(&depth) {
        return wrong("backbone.vit.depth", depth, "1 to 64");
    }
    if !(0..=64).contains(&registers) {
        return wrong("backbone.vit.registers", registers, "0 to 64");
    }
    if published {
        weights.change(timm_form);
    }
    let grid = side_px / patch_px;
    let tokens = grid * grid;
    // timm's vision transformers take (x - 0.5) / 0.5.
    let x = graph.scaled(image, 2.0, -1.0);
    let patch = Convolution {
        pads: [0; 4],
        ..graph.convolution(weights, "patch_embed.proj", [width, 3, patch_px, patch_px], patch_px)?
    };
    let x = graph.apply(patch, &x);
    let x = graph.reshape(&x, &[1, width, tokens]);
    let x = graph.transpose(&x, &[0, 2, 1]);
    let class = weights.take("cls_token", &[1, 1, width])?;
    let class = graph.weights("cls_token", &class);
    let x = graph.node("Concat", &[&class, &x], vec![int("axis", 1)]);
    let positions = weights.take("pos_embed", &[1, tokens + 1, width])?;
    let positions = graph.weights("pos_embed", &positions);
    let mut x = graph.node("Add", &[&x, &positions], Vec::new());
    if registers > 0 {
        let extra = weights.take("reg_token", &[1, registers, width])?;
        let extra = graph.weights("reg_token", &extra);
        x = graph.node("Concat", &[&x, &extra], vec![int("axis", 1)]);
    }
    let mut layers = Layers { graph, weights, width, heads, tokens: tokens + 1 + registers };
    for block in 0..depth {
        x = layers.block(&x, block)?;
    }
    let x = layers.norm(&x, "norm")?;
    let [first, last, axis] = [[1], [tokens + 1], [1]].map(|list| graph.integers(&list));
    let x = graph.node("Slice", &[&x, &first, &last, &axis], Vec::new());
    let x = graph.transpose(&x, &[0, 2, 1]);
    Ok(Features { name: graph.reshape(&x, &[1, width, grid, grid]), channels: width, grid })
}

/// The layers of a transformer's blocks.
struct Layers<'a> {
    graph: &'a mut Builder,
    weights: &'a mut StoredWeights,
    width: i64,
    heads: i64,
    tokens: i64,
}

impl Layers<'_> {
    fn block(&mut self, x: &str, block: i64) -> Result<Name, InferenceError> {
        let name = |layer: &str| format!("blocks.{block}.{layer}");
        let normed = self.norm(x, &name("norm1"))?;
        let attended = self.attention(&normed, &name("attn"))?;
        let x = self.graph.node("Add", &[x, &attended], Vec::new());
        let hidden = self.norm(&x, &name("norm2"))?;
        let hidden = self.linear(&hidden, &name("mlp.fc1"), self.width, 4 * self.width)?;
        let hidden = self.graph.node("Gelu", &[&hidden], vec![text("approximate", "none")]);
        let out = self.linear(&hidden, &name("mlp.fc2"), 4 * self.width, self.width)?;
        Ok(self.graph.node("Add", &[&x, &out], Vec::new()))
    }

    fn attention(&mut self, x: &str, layer: &str) -> Result<Name, InferenceError> {
        let &mut Self { width, heads, tokens, .. } = self;
        let qkv = self.linear(x, &format!("{layer}.qkv"), width, 3 * width)?;
        let graph = &mut *self.graph;
        let qkv = graph.reshape(&qkv, &[tokens, 3, heads, width / heads]);
        let qkv = graph.transpose(&qkv, &[1, 2, 0, 3]);
        let parts = graph.outputs("Split", &[&qkv], vec![int("axis", 0), int("num_outputs", 3)], 3);
        // Each part is 1, heads, tokens, width of a head.
        let keys = graph.transpose(&parts[1], &[0, 1, 3, 2]);
        let scale = graph.number(1.0 / ((width / heads) as f32).sqrt());
        let queries = graph.node("Mul", &[&parts[0], &scale], Vec::new());
        let scores = graph.node("MatMul", &[&queries, &keys], Vec::new());
        let shares = graph.node("Softmax", &[&scores], vec![int("axis", -1)]);
        let attended = graph.node("MatMul", &[&shares, &parts[2]], Vec::new());
        let attended = graph.transpose(&attended, &[0, 2, 1, 3]);
        let attended = graph.reshape(&attended, &[1, tokens, width]);
        self.linear(&attended, &format!("{layer}.proj"), width, width)
    }

    fn norm(&mut self, x: &str, layer: &str) -> Result<Name, InferenceError> {
        let [gain, shift] = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
        let (gains, shifts) = (self.weights.take(&gain, &[self.width])?, self.weights.take(&shift, &[self.width])?);
        let (gain, shift) = (self.graph.weights(&gain, &gains), self.graph.weights(&shift, &shifts));
        let attributes = vec![int("axis", -1), float("epsilon", 1e-6)];
        Ok(self.graph.node("LayerNormalization", &[x, &gain, &shift], attributes))
    }

    fn linear(&mut self, x: &str, layer: &str, from: i64, to: i64) -> Result<Name, InferenceError> {
        let [weight, bias] = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
        let weights = self.weights.take(&weight, &[to, from])?.reversed_axes();
        let biases = self.weights.take(&bias, &[to])?;
        let (weight, bias) = (self.graph.weights(&weight, &weights), self.graph.weights(&bias, &biases));
        let x = self.graph.node("MatMul", &[x, &weight], Vec::new());
        Ok(self.graph.node("Add", &[&x, &bias], Vec::new()))
    }
}

/// Converts published tensors to timm's names and form: queries, keys and values are concatenated, `LayerScale` is
/// folded, and the class token has a position.
fn timm_form(tensors: Arrays) -> Arrays {
    let root = vit::root(tensors.keys().map(String::as_str)).to_owned();
    let mut own: Arrays = tensors.into_iter().map(|(name, t)| (vit::timm_name(&name, &root), t)).collect();
    let mut block = 0;
    while own.contains_key(&format!("blocks.{block}.norm1.weight")) {
        for part in ["weight", "bias"] {
            join_queries(&mut own, block, part);
        }
        for (factor, layer) in [("ls1.gamma", "attn.proj"), ("ls2.gamma", "mlp.fc2")] {
            fold_scale(&mut own, &format!("blocks.{block}.{factor}"), &format!("blocks.{block}.{layer}"));
        }
        block += 1;
    }
    add_class_position(&mut own);
    own
}

/// Concatenates a block's queries, keys and values.
fn join_queries(tensors: &mut Arrays, block: usize, part: &str) {
    let names = ["query", "key", "value"].map(|q| format!("blocks.{block}.attention.attention.{q}.{part}"));
    let parts: Vec<_> = names.iter().filter_map(|name| Some(tensors.get(name)?.view())).collect();
    if parts.len() == 3
        && let Ok(joined) = concatenate(Axis(0), &parts)
    {
        tensors.retain(|name, _| !names.contains(name));
        tensors.insert(format!("blocks.{block}.attn.qkv.{part}"), joined);
    }
}

/// Multiplies a layer's outputs by a `LayerScale` factor, and removes the factor.
fn fold_scale(tensors: &mut Arrays, factor: &str, layer: &str) {
    let Some(factors) = tensors.get(factor).cloned() else { return };
    let parts = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
    let fits = |name: &String| tensors.get(name).is_some_and(|t| t.shape().first() == Some(&factors.len()));
    if factors.ndim() != 1 || !parts.iter().all(fits) {
        return;
    }
    for tensor in parts.iter().filter_map(|name| tensors.remove(name).map(|t| (name.clone(), t))).collect::<Vec<_>>() {
        let (name, mut tensor) = tensor;
        tensor.axis_iter_mut(Axis(0)).zip(&factors).for_each(|(mut row, factor)| row *= *factor);
        tensors.insert(name, tensor);
    }
    tensors.remove(factor);
}

/// Adds a position of zero for the class token if only patches have positions (a square number of them).
fn add_class_position(tensors: &mut Arrays) {
    let Some(positions) = tensors.get("pos_embed") else { return };
    if let [1, patches, width] = *positions.shape()
        && patches > 0
        && (patches as f64).sqrt().fract() == 0.0
        && let Ok(joined) = concatenate(Axis(1), &[ArrayD::zeros(vec![1, 1, width]).view(), positions.view()])
    {
        tensors.insert("pos_embed".into(), joined);
    }
}
