//! Faults of lens and sensor. Lengths are pixels of a 224 x 224 image.

use super::raster::{Raster, luma};
use super::texture::ValueNoise;
use rand::Rng;

/// Number of blots, factor of their radii, and opacity.
const DIRT: [(usize, f32, f32); 5] =
    [(7, 0.8, 0.6), (12, 0.95, 0.7), (18, 1.1, 0.8), (25, 1.25, 0.88), (34, 1.4, 0.94)];
/// Smallest and largest radius of a blot.
const BLOT_RADIUS: [f32; 2] = [4.0, 15.0];
/// Colour of dirt.
const DIRT_COLOUR: [f32; 3] = [0.2, 0.155, 0.105];
/// Share of a blot's radius over which its edge fades: dirt on a lens is out of focus.
const BLOT_EDGE: f32 = 0.55;
/// Ratio of the true focal length to the reported one.
const NARROW: [f32; 5] = [1.1, 1.2, 1.35, 1.55, 1.8];
/// Barrel distortion: relative loss of magnification from the middle to the corner.
const BARREL: [f32; 5] = [0.1, 0.2, 0.35, 0.55, 0.8];
/// Shift of a turned camera's view, share of the longer side.
const TURNED: [f32; 5] = [0.01, 0.02, 0.035, 0.05, 0.07];
/// All orders of the channels but the usual one.
const ORDERS: [[usize; 3]; 5] = [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

pub(super) fn dirt(mut raster: Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let ((count, factor, opacity), scale) = (DIRT[level], raster.scale());
    let shape = ValueNoise::new(rng);
    for _ in 0..count {
        let at = [rng.random::<f32>() * raster.width as f32, rng.random::<f32>() * raster.height as f32];
        let radius = factor * scale * rng.random_range(BLOT_RADIUS[0]..=BLOT_RADIUS[1]);
        let opacity = opacity * rng.random_range(0.7..=1.0);
        for (i, value) in raster.pixels.iter_mut().enumerate() {
            let (x, y) = ((i % raster.width) as f32, (i / raster.width) as f32);
            let rough = 0.7 + 0.6 * shape.at(x / (9.0 * scale), y / (9.0 * scale));
            let away = (x - at[0]).hypot(y - at[1]) / (radius * rough);
            let share = opacity * ((1.0 - away) / BLOT_EDGE).clamp(0.0, 1.0);
            *value = [0, 1, 2].map(|c| value[c] + share * (DIRT_COLOUR[c] - value[c]));
        }
    }
    raster
}

pub(super) fn monochrome(mut raster: Raster<3>) -> Raster<3> {
    for value in &mut raster.pixels {
        *value = [luma(*value); 3];
    }
    raster
}

pub(super) fn channel_swap(mut raster: Raster<3>, rng: &mut impl Rng) -> Raster<3> {
    let order = ORDERS[rng.random_range(0..ORDERS.len())];
    for value in &mut raster.pixels {
        *value = order.map(|c| value[c]);
    }
    raster
}

pub(super) fn narrow(raster: &Raster<3>, level: usize) -> Raster<3> {
    magnified(raster, |_| 1.0 / NARROW[level])
}

pub(super) fn barrel(raster: &Raster<3>, level: usize) -> Raster<3> {
    magnified(raster, |away| (1.0 + BARREL[level] * away * away) / (1.0 + BARREL[level]))
}

pub(super) fn turned(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let shift = TURNED[level] * raster.width.max(raster.height) as f32;
    let (sin, cos) = rng.random_range(-std::f32::consts::PI..=std::f32::consts::PI).sin_cos();
    raster.like(|x, y| raster.sample(x as f32 + shift * cos, y as f32 + shift * sin))
}

/// Samples the raster at pixels whose distance from the middle is multiplied by a factor of the distance itself, 0 in
/// the middle and 1 in the corners.
fn magnified(raster: &Raster<3>, factor: impl Fn(f32) -> f32) -> Raster<3> {
    let [cx, cy] = raster.middle();
    let corner = cx.hypot(cy).max(f32::MIN_POSITIVE);
    raster.like(|x, y| {
        let (dx, dy) = (x as f32 - cx, y as f32 - cy);
        let by = factor(dx.hypot(dy) / corner);
        raster.sample(cx + dx * by, cy + dy * by)
    })
}
