//! The encoder stage with libtorch: camera frames in, posteriors out.

use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_messages::{Gaussian, Stage};
use carff_networks::{allocator, borrow, device, encoder::Encoder, stored};
use carff_runtime::StageContext;
use ndarray::ArrayView3;

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Encoder, |stage| carff_encoder::run(stage, load, encode))
}

fn load(stage: &StageContext) -> anyhow::Result<Encoder> {
    allocator::keep_large_blocks();
    device::set_threads(stage.threads);
    let manifest = Manifest::load(&stage.checkpoint)?;
    Ok(stored::load_encoder(&stage.checkpoint, &manifest)?)
}

fn encode(encoder: &mut Encoder, image: ArrayView3<'_, u8>) -> anyhow::Result<Gaussian> {
    borrow::with_image(image, |image| encoder.encode_bytes(image))
        .flatten()
        .with_context(|| format!("the encoder cannot read an image of shape {:?}", image.shape()))
}
