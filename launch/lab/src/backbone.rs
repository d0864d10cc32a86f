//! `carff backbone`: converts published weights for training files.

use anyhow::{Context, bail};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind};
use carff_launch::lab::BackboneCommand;
use carff_networks::pretrained::Published;
use std::{fmt::Write, path::Path, process::ExitCode};

/// Runs the command.
pub fn run(command: &BackboneCommand) -> anyhow::Result<ExitCode> {
    let BackboneCommand::Import(args) = command;
    if args.out.exists() && !args.force {
        bail!("{} exists: name another file with --out, or replace it with --force", args.out.display());
    }
    let tensors = carff_networks::pretrained::read(&args.source)?;
    let source = || args.source.display().to_string();
    let mut published = carff_networks::pretrained::backbone(&tensors).with_context(source)?;
    if args.imagenet_normalised {
        published.take_imagenet_normalised().with_context(source)?;
    }
    if let Some(folder) = args.out.parent() {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    }
    carff_networks::pretrained::write(&args.out, &published).with_context(source)?;
    print!("{}", description(&published, &args.out)?);
    Ok(ExitCode::SUCCESS)
}

/// Returns a description of the written file, and the matching lines of a training file.
fn description(published: &Published, out: &Path) -> Result<String, toml::ser::Error> {
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
    // Writing to a string cannot fail.
    if *kind == BackboneKind::Vit {
        let _ = write!(
            text,
            "\n[encoder.backbone.vit]\npatch_px = {}\nwidth = {}\ndepth = {}\n\
             # The weights do not contain this number: one per 64 of the width, as published.\nheads = {}\n",
            vit.patch_px, vit.width, vit.depth, vit.heads
        );
    }
    if vit.registers > 0 {
        let _ = writeln!(text, "registers = {}", vit.registers);
    }
    if let Some(first) = published.outside.first() {
        let _ = writeln!(text, "\n# Not part of the network: {} tensors, such as {first}", published.outside.len());
    }
    Ok(text)
}
