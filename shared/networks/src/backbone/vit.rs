//! Vision transformer (Dosovitskiy et al. 2021) of any size, with standard safetensors weights.

use super::{Backbone, resize};
use crate::{
    ModelError,
    weights::{Tensors, select},
};
use carff_checkpoint::{
    backbones::vit::{self, is_beyond_the_features},
    shapes::VitConfig,
};
use tch::{Kind, Tensor, nn, nn::Module};

/// The network without its classifier.
#[derive(Debug)]
pub struct VisionTransformer {
    patch: nn::Conv2D,
    class_token: Tensor,
    positions: Tensor,
    /// Tokens without a position, `[1, registers, width]` (Darcet et al. 2024).
    registers: Option<Tensor>,
    blocks: Vec<Block>,
    norm: nn::LayerNorm,
    width: i64,
    input_px: i64,
    grid: i64,
}

#[derive(Debug)]
struct Block {
    norm1: nn::LayerNorm,
    qkv: nn::Linear,
    projection: nn::Linear,
    norm2: nn::LayerNorm,
    fc1: nn::Linear,
    fc2: nn::Linear,
    heads: i64,
}

impl VisionTransformer {
    /// Builds the network in `path`, with weights in timm names (`blocks.0.attn.qkv.weight`) or Hugging Face names
    /// (`vit.encoder.layer.0.attention.attention.query.weight`). `LayerScale` factors are folded into the layers before
    /// them. A classifier, a decoder and a mask token in the file are ignored.
    ///
    /// # Errors
    ///
    /// [`ModelError::Mismatch`] lists missing and unknown tensors, and tensors of another shape.
    pub fn new(
        path: &nn::Path,
        config: &VitConfig,
        tensors: Option<&Tensors>,
        input_px: i64,
    ) -> Result<Self, ModelError> {
        let wrong = |key, value: i64, allowed| Err(ModelError::Setting { key, value: value.to_string(), allowed });
        if config.heads < 1 || config.width % config.heads.max(1) != 0 {
            return wrong("backbone.vit.heads", config.heads, "a divisor of `width`, at least 1");
        }
        if config.patch_px < 1 || input_px % config.patch_px.max(1) != 0 {
            return wrong("backbone.vit.patch_px", config.patch_px, "a divisor of `input_px`, at least 1");
        }
        if !(0..=64).contains(&config.registers) {
            return wrong("backbone.vit.registers", config.registers, "0 to 64");
        }
        if !(1..=64).contains(&config.depth) {
            return wrong("backbone.vit.depth", config.depth, "1 to 64");
        }
        let width = config.width;
        let grid = input_px / config.patch_px;
        let conv = nn::ConvConfig { stride: config.patch_px, ..Default::default() };
        let norm_config = nn::LayerNormConfig { eps: 1e-6, ..Default::default() };
        let small = nn::Init::Randn { mean: 0.0, stdev: 0.02 };
        let blocks = (0..config.depth)
            .map(|i| {
                let p = path / "blocks" / i;
                Block {
                    norm1: nn::layer_norm(&p / "norm1", vec![width], norm_config),
                    qkv: nn::linear(&p / "attn" / "qkv", width, 3 * width, nn::LinearConfig::default()),
                    projection: nn::linear(&p / "attn" / "proj", width, width, nn::LinearConfig::default()),
                    norm2: nn::layer_norm(&p / "norm2", vec![width], norm_config),
                    fc1: nn::linear(&p / "mlp" / "fc1", width, 4 * width, nn::LinearConfig::default()),
                    fc2: nn::linear(&p / "mlp" / "fc2", 4 * width, width, nn::LinearConfig::default()),
                    heads: config.heads,
                }
            })
            .collect();
        let net = Self {
            patch: nn::conv2d(path / "patch_embed" / "proj", 3, width, config.patch_px, conv),
            class_token: path.var("cls_token", &[1, 1, width], small),
            positions: path.var("pos_embed", &[1, grid * grid + 1, width], small),
            registers: (config.registers > 0).then(|| path.var("reg_token", &[1, config.registers, width], small)),
            blocks,
            norm: nn::layer_norm(path / "norm", vec![width], norm_config),
            width,
            input_px,
            grid,
        };
        if let Some(tensors) = tensors {
            net.fill(&timm_form(tensors))?;
        }
        Ok(net)
    }

    /// Returns the size of a published network and the side of its images in pixels, from its tensors in timm or
    /// Hugging Face names. The tensors do not contain the number of heads: it is one per 64 of the width, as in all
    /// published sizes.
    pub fn shape_of(tensors: &Tensors) -> Result<(VitConfig, i64), ModelError> {
        let tensors = timm_form(tensors);
        let size = |name: &str| {
            tensors.get(name).map(Tensor::size).ok_or_else(|| ModelError::Mismatch(format!("`{name}` is missing")))
        };
        let unfit = |name: &str, size: &[i64], wanted: &str| {
            Err(ModelError::Mismatch(format!("`{name}` is {size:?}, {wanted} is needed")))
        };
        let patch = size("patch_embed.proj.weight")?;
        let (width, patch_px) = match patch[..] {
            [width, 3, high, wide] if width >= 1 && high >= 1 && high == wide => (width, wide),
            _ => return unfit("patch_embed.proj.weight", &patch, "[width, 3, patch_px, patch_px]"),
        };
        let registers = match tensors.get("reg_token").map(Tensor::size).as_deref() {
            None => 0,
            Some(&[1, registers, w]) if w == width => registers,
            Some(size) => return unfit("reg_token", size, &format!("[1, registers, {width}]")),
        };
        let positions = size("pos_embed")?;
        let tokens = match positions[..] {
            [1, tokens, w] if w == width => tokens - 1,
            _ => return unfit("pos_embed", &positions, &format!("[1, patches + 1, {width}]")),
        };
        // A network is only built if the large tensors exist with the size that a small tensor claims.
        let qkv = size("blocks.0.attn.qkv.weight")?;
        if qkv != [3 * width, width] {
            return unfit("blocks.0.attn.qkv.weight", &qkv, &format!("[{}, {width}]", 3 * width));
        }
        let grid = (tokens.max(0) as f64).sqrt().round() as i64;
        if grid < 1 || grid * grid != tokens {
            return Err(ModelError::Mismatch(format!(
                "`pos_embed` is for {tokens} patches and a class token: a square of patches is needed"
            )));
        }
        let depth = depth(&tensors, "blocks", "norm1.weight");
        Ok((VitConfig { patch_px, width, depth, heads: (width / 64).max(1), registers }, grid * patch_px))
    }

    fn fill(&self, tensors: &Tensors) -> Result<(), ModelError> {
        let mut own: Vec<(String, &Tensor)> = vec![
            ("cls_token".into(), &self.class_token),
            ("pos_embed".into(), &self.positions),
            ("patch_embed.proj.weight".into(), &self.patch.ws),
        ];
        own.extend(self.registers.iter().map(|registers| ("reg_token".into(), registers)));
        own.extend(self.patch.bs.iter().map(|bias| ("patch_embed.proj.bias".into(), bias)));
        own.extend(named("norm", self.norm.ws.as_ref(), self.norm.bs.as_ref()));
        for (i, block) in self.blocks.iter().enumerate() {
            for (name, layer) in [("norm1", &block.norm1), ("norm2", &block.norm2)] {
                own.extend(named(&format!("blocks.{i}.{name}"), layer.ws.as_ref(), layer.bs.as_ref()));
            }
            for (name, layer) in [
                ("attn.qkv", &block.qkv),
                ("attn.proj", &block.projection),
                ("mlp.fc1", &block.fc1),
                ("mlp.fc2", &block.fc2),
            ] {
                own.extend(named(&format!("blocks.{i}.{name}"), Some(&layer.ws), layer.bs.as_ref()));
            }
        }
        let wanted: Vec<(String, Vec<i64>)> = own.iter().map(|(name, v)| (name.clone(), v.size())).collect();
        let tensors = select(tensors, &wanted, is_beyond_the_features)?;
        tch::no_grad(|| {
            for (name, variable) in own {
                variable.shallow_clone().copy_(&tensors[&name]);
            }
        });
        Ok(())
    }
}

/// Returns the number of blocks, by a tensor that each block has.
fn depth(tensors: &Tensors, blocks: &str, each: &str) -> i64 {
    (0..tensors.len()).take_while(|i| tensors.contains_key(&format!("{blocks}.{i}.{each}"))).count() as i64
}

/// Returns a layer's tensors by their names.
fn named<'a>(
    layer: &str,
    weight: Option<&'a Tensor>,
    bias: Option<&'a Tensor>,
) -> impl Iterator<Item = (String, &'a Tensor)> + use<'a> {
    [("weight", weight), ("bias", bias)]
        .map(|(part, tensor)| Some((format!("{layer}.{part}"), tensor?)))
        .into_iter()
        .flatten()
}

/// Converts the tensors to timm's names and form: queries, keys and values are concatenated, `LayerScale` is folded,
/// and the class token has a position. Tensors that cannot be converted keep their names, and are reported as unknown.
fn timm_form(tensors: &Tensors) -> Tensors {
    let root = vit::root(tensors.keys().map(String::as_str));
    let mut own: Tensors = tensors.iter().map(|(name, t)| (vit::timm_name(name, root), t.shallow_clone())).collect();
    for i in 0..depth(&own, "blocks", "norm1.weight") {
        for part in ["weight", "bias"] {
            join_queries(&mut own, i, part);
        }
        fold_scale(&mut own, &format!("blocks.{i}.ls1.gamma"), &format!("blocks.{i}.attn.proj"));
        fold_scale(&mut own, &format!("blocks.{i}.ls2.gamma"), &format!("blocks.{i}.mlp.fc2"));
    }
    add_class_position(&mut own);
    own
}

/// Concatenates a block's queries, keys and values.
fn join_queries(tensors: &mut Tensors, block: i64, part: &str) {
    let names = ["query", "key", "value"].map(|q| format!("blocks.{block}.attention.attention.{q}.{part}"));
    let parts: Vec<&Tensor> = names.iter().filter_map(|name| tensors.get(name)).collect();
    if let (3, Ok(joined)) = (parts.len(), Tensor::f_cat(&parts, 0)) {
        tensors.retain(|name, _| !names.contains(name));
        tensors.insert(format!("blocks.{block}.attn.qkv.{part}"), joined);
    }
}

/// Multiplies a layer's outputs by a `LayerScale` factor (Touvron et al. 2021), and removes the factor.
fn fold_scale(tensors: &mut Tensors, factor: &str, layer: &str) {
    let [weight, bias] = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
    let (Some(f), Some(w), Some(b)) = (tensors.get(factor), tensors.get(&weight), tensors.get(&bias)) else { return };
    if w.dim() != 2 || f.size() != w.size()[..1] || f.size() != b.size() {
        return;
    }
    let (w, b) = (w * f.unsqueeze(1), b * f);
    tensors.extend([(weight, w), (bias, b)]);
    tensors.remove(factor);
}

/// Adds a position of zero for the class token if only patches have positions (a square number of them).
fn add_class_position(tensors: &mut Tensors) {
    let Some(positions) = tensors.get("pos_embed") else { return };
    if let [1, patches, _] = positions.size()[..]
        && patches > 0
        && (patches as f64).sqrt().fract() == 0.0
    {
        let zero = positions.narrow(1, 0, 1).zeros_like();
        tensors.insert("pos_embed".into(), Tensor::cat(&[zero, positions.shallow_clone()], 1));
    }
}

impl Block {
    fn forward(&self, x: &Tensor) -> Tensor {
        let size = x.size();
        let (n, tokens, width) = (size[0], size[1], size[2]);
        let qkv = self
            .qkv
            .forward(&self.norm1.forward(x))
            .view([n, tokens, 3, self.heads, width / self.heads])
            .permute([2, 0, 3, 1, 4]);
        let attended = Tensor::scaled_dot_product_attention::<Tensor>(
            &qkv.get(0),
            &qkv.get(1),
            &qkv.get(2),
            None,
            0.0,
            false,
            None,
            false,
        );
        let x = x + self.projection.forward(&attended.transpose(1, 2).reshape([n, tokens, width]));
        let hidden = self.fc1.forward(&self.norm2.forward(&x)).gelu("none");
        &x + self.fc2.forward(&hidden)
    }
}

impl Backbone for VisionTransformer {
    fn features(&self, images: &Tensor) -> Tensor {
        // timm's vision transformers take (x - 0.5) / 0.5.
        let x = resize(images, self.input_px) * 2.0 - 1.0;
        let n = x.size()[0];
        let tokens = self.patch.forward(&x).flatten(2, 3).transpose(1, 2);
        let class = self.class_token.expand([n, 1, self.width], false);
        let x = Tensor::cat(&[class, tokens], 1) + &self.positions;
        // Attention does not depend on the order of tokens: registers follow the patches.
        let x = match &self.registers {
            Some(registers) => Tensor::cat(&[x, registers.expand([n, -1, -1], false)], 1),
            None => x,
        };
        let x = self.blocks.iter().fold(x, |x, block| block.forward(&x));
        let x = self.norm.forward(&x).to_kind(Kind::Float);
        x.narrow(1, 1, self.grid * self.grid).transpose(1, 2).reshape([n, self.width, self.grid, self.grid])
    }

    fn channels(&self) -> i64 {
        self.width
    }

    fn grid(&self) -> i64 {
        self.grid
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, nn::VarStore};

    fn tiny() -> VitConfig {
        VitConfig { patch_px: 16, width: 12, depth: 2, heads: 3, registers: 0 }
    }

    /// Equal weights in Hugging Face names and in timm names give equal features and the same size.
    #[test]
    fn both_name_forms_are_read() {
        let store = VarStore::new(Device::Cpu);
        let net = VisionTransformer::new(&store.root(), &tiny(), None, 64).unwrap();
        let timm: Tensors = store.variables().into_iter().collect();
        let mut hugging = Tensors::new();
        for (name, t) in &timm {
            let renamed = name
                .replace("blocks.", "vit.encoder.layer.")
                .replace(".norm1.", ".layernorm_before.")
                .replace(".norm2.", ".layernorm_after.")
                .replace(".attn.proj.", ".attention.output.dense.")
                .replace(".mlp.fc1.", ".intermediate.dense.")
                .replace(".mlp.fc2.", ".output.dense.");
            if let Some(base) = renamed.find(".attn.qkv.").map(|at| renamed[..at].to_owned()) {
                let part = name.rsplit('.').next().unwrap();
                for (q, chunk) in ["query", "key", "value"].iter().zip(t.chunk(3, 0)) {
                    hugging.insert(format!("{base}.attention.attention.{q}.{part}"), chunk);
                }
                continue;
            }
            let renamed = match name.as_str() {
                "cls_token" => "vit.embeddings.cls_token".into(),
                "pos_embed" => "vit.embeddings.position_embeddings".into(),
                "norm.weight" | "norm.bias" => format!("vit.{}", name.replace("norm", "layernorm")),
                n if n.starts_with("patch_embed") => {
                    n.replace("patch_embed.proj", "vit.embeddings.patch_embeddings.projection")
                }
                _ => renamed,
            };
            hugging.insert(renamed, t.shallow_clone());
        }
        let image = Tensor::rand([1, 3, 64, 64], (Kind::Float, Device::Cpu));
        let expected = net.features(&image);
        assert_eq!(expected.size(), [1, 12, 4, 4]);
        for names in [&timm, &hugging] {
            let other = VarStore::new(Device::Cpu);
            let read = VisionTransformer::new(&other.root(), &tiny(), Some(names), 64).unwrap();
            assert!(read.features(&image).allclose(&expected, 1e-5, 1e-6, false));
            let heads_of_64 = VitConfig { heads: 1, ..tiny() };
            assert_eq!(VisionTransformer::shape_of(names).unwrap(), (heads_of_64, 64));
        }
    }

    /// A file whose first tensors claim another size than its blocks have is refused before a network is built.
    /// Mismatched queries and keys are reported, in Hugging Face names too.
    #[test]
    fn a_size_that_the_blocks_do_not_have_is_refused() {
        let store = VarStore::new(Device::Cpu);
        let _net = VisionTransformer::new(&store.root(), &tiny(), None, 64).unwrap();
        let zeros = |size: &[i64]| Tensor::zeros(size, (Kind::Float, Device::Cpu));
        let refused = |changed: &[(&str, &[i64])]| {
            let mut tensors: Tensors = store.variables().into_iter().collect();
            for (name, size) in changed {
                tensors.insert((*name).into(), zeros(size));
            }
            VisionTransformer::shape_of(&tensors).unwrap_err().to_string()
        };
        let wide: (&str, &[i64]) = ("patch_embed.proj.weight", &[1_000_000, 3, 1, 1]);
        let error = refused(&[wide, ("pos_embed", &[1, 2, 1_000_000])]);
        assert!(error.contains("`blocks.0.attn.qkv.weight` is [36, 12], [3000000, 1000000] is needed"), "{error}");
        assert!(refused(&[wide]).contains("`pos_embed` is [1, 17, 12]"));
        assert!(refused(&[("pos_embed", &[1, 1_000_000_000_001, 0])]).contains("[1, patches + 1, 12] is needed"));
        assert!(refused(&[("patch_embed.proj.weight", &[12, 0, 9_000_000, 9_000_000])]).contains("patch_px"));
        assert!(refused(&[("patch_embed.proj.weight", &[12])]).contains("patch_px"));

        let mut hugging = Tensors::new();
        hugging.insert("embeddings.cls_token".into(), zeros(&[1, 1, 12]));
        hugging.insert("embeddings.patch_embeddings.projection.weight".into(), zeros(&[12, 3, 16, 16]));
        hugging.insert("embeddings.position_embeddings".into(), zeros(&[1, 17, 12]));
        hugging.insert("encoder.layer.0.layernorm_before.weight".into(), zeros(&[12]));
        for (q, width) in [("query", 12), ("key", 12), ("value", 5)] {
            hugging.insert(format!("encoder.layer.0.attention.attention.{q}.weight"), zeros(&[12, width]));
        }
        let error = VisionTransformer::shape_of(&hugging).unwrap_err().to_string();
        assert!(error.contains("`blocks.0.attn.qkv.weight` is missing"), "{error}");
    }

    /// All missing tensors and tensors of another shape are named.
    #[test]
    fn what_does_not_fit_is_named() {
        let store = VarStore::new(Device::Cpu);
        let _net = VisionTransformer::new(&store.root(), &tiny(), None, 64).unwrap();
        let mut tensors: Tensors = store.variables().into_iter().collect();
        tensors.remove("blocks.1.mlp.fc2.weight");
        tensors.insert("norm.bias".into(), Tensor::zeros([3], (Kind::Float, Device::Cpu)));
        let other = VarStore::new(Device::Cpu);
        let error = VisionTransformer::new(&other.root(), &tiny(), Some(&tensors), 64).unwrap_err();
        assert!(error.to_string().contains("`blocks.1.mlp.fc2.weight` is missing"), "{error}");
        assert!(error.to_string().contains("`norm.bias` is [3], the model wants [12]"), "{error}");
    }
}
