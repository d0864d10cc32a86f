//! The encoder stage's arithmetic: from an image in shared memory to a posterior over the scene latent.

use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_messages::Gaussian;
use carff_networks::{borrow, encoder::Encoder};
use ndarray::{Array3, ArrayView3};
use std::path::Path;

/// Side of the image for the warm-up, pixels.
const WARM_UP_PX: usize = 128;
/// Number of runs of the warm-up.
const WARM_UPS: usize = 3;

/// Loads the encoder and runs it on a grey image, so that the first frame is as fast as later ones.
pub fn load(checkpoint: &Path, threads: usize) -> anyhow::Result<Encoder> {
    carff_networks::allocator::keep_large_blocks();
    carff_networks::device::set_threads(threads);
    let manifest = Manifest::load(checkpoint)?;
    let encoder = carff_networks::stored::load_encoder(checkpoint, &manifest)?;
    let grey = Array3::from_elem((WARM_UP_PX, WARM_UP_PX, 3), 128);
    for _ in 0..WARM_UPS {
        encode(&encoder, grey.view())?;
    }
    Ok(encoder)
}

/// Returns the posterior of an image (height, width, channel), which is read in place.
pub fn encode(encoder: &Encoder, image: ArrayView3<'_, u8>) -> anyhow::Result<Gaussian> {
    borrow::with_image(image, |image| encoder.encode_bytes(image))
        .flatten()
        .with_context(|| format!("the encoder cannot read an image of shape {:?}", image.shape()))
}
