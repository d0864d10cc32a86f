//! From raw outputs of the networks to densities, transmittances and colours.

use super::block::{Blocks, BlocksMut, LANES};
use super::math::{exp, sigmoid};

/// The raw density may rise to here, so that its exponential stays finite.
const MAX_RAW: f32 = 15.0;

/// From raw densities (row 0 of each block) to densities sigma = exp(raw + offset), 1/metre, and to
/// 1 - alpha = exp(-sigma delta) over each sample's length `delta_m`.
#[inline(always)]
pub(crate) fn sigma_and_alpha<const FMA: bool>(
    raw: Blocks<'_>,
    offset: f32,
    delta_m: &[f32],
    sigma: &mut [f32],
    one_minus_alpha: &mut [f32],
) {
    let rows = sigma.as_chunks_mut::<LANES>().0.iter_mut().zip(one_minus_alpha.as_chunks_mut::<LANES>().0);
    for ((block, delta), (sigma, one_minus_alpha)) in raw.iter().zip(delta_m.as_chunks::<LANES>().0).zip(rows) {
        let raw: &[f32; LANES] = block.first_chunk().expect("a block holds all its rows");
        for l in 0..LANES {
            sigma[l] = exp((raw[l] + offset).min(MAX_RAW));
            one_minus_alpha[l] = exp(-sigma[l] * delta[l]);
        }
    }
}

/// The densities only; the last block may be needed in part.
#[inline(always)]
pub(crate) fn sigma<const FMA: bool>(raw: Blocks<'_>, offset: f32, sigma: &mut [f32]) {
    for (block, out) in raw.iter().zip(sigma.chunks_mut(LANES)) {
        let raw: &[f32; LANES] = block.first_chunk().expect("a block holds all its rows");
        let mut lanes = [0.0; LANES];
        for l in 0..LANES {
            lanes[l] = exp((raw[l] + offset).min(MAX_RAW));
        }
        out.copy_from_slice(&lanes[..out.len()]);
    }
}

/// The logistic function of every number.
#[inline(always)]
pub(crate) fn logistic<const FMA: bool>(mut values: BlocksMut<'_>) {
    for row in values.as_mut_slice().as_chunks_mut::<LANES>().0 {
        for l in 0..LANES {
            row[l] = sigmoid(row[l]);
        }
    }
}
