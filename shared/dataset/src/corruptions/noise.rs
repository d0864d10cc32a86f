//! Noise of single pixels.

use super::raster::Raster;
use rand::Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

/// Standard deviations of the normal noise.
const GAUSSIAN_SIGMA: [f32; 5] = [0.08, 0.12, 0.18, 0.26, 0.38];
/// Photons of a white pixel.
const PHOTONS: [f32; 5] = [60.0, 25.0, 12.0, 5.0, 3.0];
/// Shares of the values that become black or white.
const IMPULSE_SHARE: [f32; 5] = [0.03, 0.06, 0.09, 0.17, 0.27];

pub(super) fn gaussian(mut raster: Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    for value in raster.pixels.iter_mut().flatten() {
        *value += GAUSSIAN_SIGMA[level] * rng.sample::<f32, _>(StandardNormal);
    }
    raster
}

pub(super) fn shot(mut raster: Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let photons = PHOTONS[level];
    for value in raster.pixels.iter_mut().flatten() {
        // A black value has no distribution, and no photons.
        *value = Poisson::new(*value * photons).map_or(0.0, |counts| counts.sample(rng) / photons);
    }
    raster
}

pub(super) fn impulse(mut raster: Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    for value in raster.pixels.iter_mut().flatten() {
        let (hit, white) = (rng.random::<f32>(), rng.random::<bool>());
        if hit < IMPULSE_SHARE[level] {
            *value = f32::from(u8::from(white));
        }
    }
    raster
}
