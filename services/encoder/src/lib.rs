//! The encoder stage's arithmetic: from a picture in shared memory to a posterior over the scene latent.

use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_messages::Gaussian;
use carff_models::{borrow, encoder::Encoder};
use std::path::Path;

/// Loads the encoder and runs it once on a grey picture, so that the first frame is as fast as the others.
pub fn load(checkpoint: &Path, threads: usize) -> anyhow::Result<Encoder> {
    carff_models::allocator::keep_large_blocks();
    tch::set_num_threads(threads as i32);
    let manifest = Manifest::load(checkpoint)?;
    let encoder = carff_models::stored::load_encoder(checkpoint, &manifest)?;
    for _ in 0..3 {
        encode(&encoder, &vec![128; 128 * 128 * 3], 128, 128)?;
    }
    Ok(encoder)
}

/// The posterior of one picture: `rgb` holds height x width x 3 bytes, and is read where it lies.
pub fn encode(encoder: &Encoder, rgb: &[u8], height_px: usize, width_px: usize) -> anyhow::Result<Gaussian> {
    borrow::with_picture(rgb, height_px, width_px, |picture| encoder.encode_bytes(picture))
        .flatten()
        .with_context(|| format!("{} bytes are not an image of {width_px} x {height_px} pixels", rgb.len()))
}
