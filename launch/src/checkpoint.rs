//! `carff checkpoint onnx`: the encoder for other programs.

use crate::lab::OnnxArgs;
use carff_base::files::check_writable;
use carff_checkpoint::Manifest;

/// Writes the encoder of a checkpoint as an ONNX file.
pub fn onnx(args: &OnnxArgs) -> anyhow::Result<()> {
    let out = args.out.clone().unwrap_or_else(|| args.checkpoint.join(carff_inference::FILE));
    check_writable(&out)?;
    let manifest = Manifest::load(&args.checkpoint)?;
    carff_inference::save_encoder_onnx(&args.checkpoint, &manifest, &out)?;
    println!("encoder: {}", out.display());
    Ok(())
}
