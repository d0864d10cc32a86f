//! Vision transformers: the names of their tensors.

/// Parts of Hugging Face names and of the `DINOv2` authors' names, with timm's; earlier entries have precedence.
const TIMM_PARTS: [(&str, &str); 15] = [
    ("embeddings.cls_token", "cls_token"),
    ("embeddings.mask_token", "mask_token"),
    ("embeddings.position_embeddings", "pos_embed"),
    ("embeddings.patch_embeddings.projection.", "patch_embed.proj."),
    ("embeddings.register_tokens", "reg_token"),
    ("register_tokens", "reg_token"),
    ("encoder.layer.", "blocks."),
    (".layernorm_before.", ".norm1."),
    (".layernorm_after.", ".norm2."),
    (".attention.output.dense.", ".attn.proj."),
    (".intermediate.dense.", ".mlp.fc1."),
    (".output.dense.", ".mlp.fc2."),
    (".layer_scale1.lambda1", ".ls1.gamma"),
    (".layer_scale2.lambda1", ".ls2.gamma"),
    ("layernorm.", "norm."),
];

/// Returns the prefix of all names of a Hugging Face network; empty for other names.
pub fn root<'a>(names: impl IntoIterator<Item = &'a str>) -> &'a str {
    names.into_iter().find_map(|name| name.strip_suffix("embeddings.cls_token")).unwrap_or_default()
}

/// Converts a name without its root to timm's name; other names are unchanged.
pub fn timm_name(name: &str, root: &str) -> String {
    let name = name.strip_prefix(root).unwrap_or(name);
    TIMM_PARTS.iter().fold(name.to_owned(), |name, (from, to)| name.replace(from, to))
}

/// Returns true for tensors that the feature map does not depend on: classifiers, decoders and the mask token.
pub fn is_beyond_the_features(name: &str) -> bool {
    let first = name.split('.').next().unwrap_or_default();
    ["head", "head_dist", "fc_norm", "pre_logits", "classifier", "pooler", "lm_head", "mask_token"].contains(&first)
        || first.starts_with("decoder")
}
