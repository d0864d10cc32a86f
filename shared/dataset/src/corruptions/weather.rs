//! Snow, frost, fog and rain. Lengths are pixels of a 224 x 224 image.

use super::raster::{Raster, luma};
use super::texture::{PLASMA_SIDE, ValueNoise, plasma};
use rand::Rng;
use rand_distr::StandardNormal;

/// Parameters of one severity of snow.
struct Snow {
    mean: f32,
    sigma: f32,
    flake: f32,
    threshold: f32,
    radius: usize,
    length: f32,
    keep: f32,
}

const fn snow_of(mean: f32, flake: f32, threshold: f32, radius: usize, length: f32, keep: f32) -> Snow {
    Snow { mean, sigma: 0.3, flake, threshold, radius, length, keep }
}

/// Severities of snow.
const SNOW: [Snow; 5] = [
    snow_of(0.1, 3.0, 0.5, 10, 4.0, 0.8),
    snow_of(0.2, 2.0, 0.5, 12, 4.0, 0.7),
    snow_of(0.55, 4.0, 0.9, 12, 8.0, 0.7),
    snow_of(0.55, 4.5, 0.85, 12, 8.0, 0.65),
    snow_of(0.55, 2.5, 0.85, 12, 12.0, 0.55),
];
/// Weights of the image and of the frost.
const FROST: [(f32, f32); 5] = [(1.0, 0.4), (0.8, 0.6), (0.7, 0.7), (0.65, 0.7), (0.6, 0.75)];
/// Distance of crystals.
const CRYSTAL: f32 = 38.0;
/// Colour of thick frost.
const FROST_COLOUR: [f32; 3] = [0.82, 0.9, 0.98];
/// Density of the fog, and decay of its detail.
const FOG: [(f32, f32); 5] = [(1.5, 2.0), (2.0, 2.0), (2.5, 1.7), (2.5, 1.5), (3.0, 1.4)];

/// Parameters of one severity of rain.
struct Rain {
    streaks: usize,
    length: f32,
    opacity: f32,
    haze: f32,
}

/// Severities of rain.
const RAIN: [Rain; 5] = [
    Rain { streaks: 50, length: 14.0, opacity: 0.4, haze: 0.04 },
    Rain { streaks: 90, length: 18.0, opacity: 0.48, haze: 0.08 },
    Rain { streaks: 150, length: 22.0, opacity: 0.56, haze: 0.12 },
    Rain { streaks: 230, length: 27.0, opacity: 0.64, haze: 0.17 },
    Rain { streaks: 340, length: 33.0, opacity: 0.7, haze: 0.22 },
];
/// Colour of streaks and haze.
const RAIN_COLOUR: [f32; 3] = [0.78, 0.81, 0.85];
/// Half width of a streak, and its least half width in pixels of the image.
const STREAK_HALF_WIDTH: f32 = 0.55;
const STREAK_LEAST_PX: f32 = 0.4;
/// Largest angle of the rain to the vertical, and of a streak to the others, radians.
const RAIN_SLANT: f32 = 0.35;
const STREAK_SLANT: f32 = 0.03;

/// Returns a mix of two colours.
fn mix(from: [f32; 3], to: [f32; 3], share: f32) -> [f32; 3] {
    [0, 1, 2].map(|c| from[c] + share * (to[c] - from[c]))
}

pub(super) fn snow(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let (snow, scale) = (&SNOW[level], raster.scale());
    let angle = rng.random_range(-135.0..=-45.0);
    let flake_px = snow.flake * scale;
    let cells = |count: usize| (count as f32 / flake_px).ceil() as usize + 2;
    let coarse = Raster::of(cells(raster.width), cells(raster.height), |_, _| {
        [snow.mean + snow.sigma * rng.sample::<f32, _>(StandardNormal)]
    });
    let flakes = raster.like(|x, y| {
        let [v] = coarse.sample(x as f32 / flake_px, y as f32 / flake_px);
        [if v < snow.threshold { 0.0 } else { v.min(1.0) }]
    });
    let falling = flakes.moved(snow.radius, snow.length, angle, scale);
    let last = falling.pixels.len() - 1;
    raster.like(|x, y| {
        let i = y * raster.width + x;
        let value = raster.pixels[i];
        let white = luma(value) * 1.5 + 0.5;
        let flake = falling.pixels[i][0] + falling.pixels[last - i][0];
        value.map(|v| snow.keep * v + (1.0 - snow.keep) * v.max(white) + flake)
    })
}

pub(super) fn frost(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let ((own, ice), scale) = (FROST[level], raster.scale());
    let noises: [ValueNoise; 8] = std::array::from_fn(|_| ValueNoise::new(rng));
    raster.like(|x, y| {
        let share = frosted(&noises, x as f32 / scale, y as f32 / scale);
        let value = raster.pixels[y * raster.width + x];
        [0, 1, 2].map(|c| own * value[c] + ice * share * FROST_COLOUR[c])
    })
}

/// Returns the density of frost at a position, 0..=1: patches of crystals with needles from their middles.
fn frosted(noises: &[ValueNoise; 8], x: f32, y: f32) -> f32 {
    let [patch, patches, bend, needle, branch, grain, veil, place] = *noises;
    let cover = 0.65 * patch.at(x / 75.0, y / 75.0) + 0.35 * patches.at(x / 30.0, y / 30.0);
    let cover = ((cover - 0.34) * 3.2).clamp(0.0, 1.0);
    let bent = 5.0 * bend.at(x / 12.0, y / 12.0);
    let (dx, dy, cell) = crystal(place, x + bent, y - bent);
    let (away, angle) = (dx.hypot(dy), dy.atan2(dx));
    let needles = needle.ridge(angle * 4.5 + cell, away / 45.0 + cell).powi(3);
    let branches = branch.ridge(away / 3.5 - 2.0 * needles, angle * 3.0 + cell).powi(3);
    let grains = grain.at(x / 2.2, y / 2.2) - 0.5;
    let thick = 0.34 + 0.75 * needles + 0.3 * branches * needles + 0.25 * grains;
    (0.07 * veil.at(x / 110.0, y / 110.0) + cover * thick).clamp(0.0, 1.0)
}

/// Returns the position relative to the middle of the nearest crystal, and a number of the crystal.
fn crystal(place: ValueNoise, x: f32, y: f32) -> (f32, f32, f32) {
    let (column, row) = ((x / CRYSTAL).floor(), (y / CRYSTAL).floor());
    let mut nearest = (f32::INFINITY, f32::INFINITY, 0.0);
    for (i, j) in [-1.0, 0.0, 1.0].into_iter().flat_map(|j| [-1.0, 0.0, 1.0].map(|i| (column + i, row + j))) {
        let middle = [(i + place.at(i, j)) * CRYSTAL, (j + place.at(i + 0.5e3, j)) * CRYSTAL];
        let (dx, dy) = (x - middle[0], y - middle[1]);
        if dx.hypot(dy) < nearest.0.hypot(nearest.1) {
            nearest = (dx, dy, (50.0 * place.at(i, j + 0.5e3)).floor());
        }
    }
    nearest
}

pub(super) fn fog(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let ((density, decay), scale) = (FOG[level], raster.scale());
    let brightest = raster.pixels.iter().flatten().copied().fold(0.0, f32::max);
    let map = plasma(decay, rng);
    let side = PLASMA_SIDE as f32;
    raster.like(|x, y| {
        let (u, v) = ((x as f32 / scale) % side, (y as f32 / scale) % side);
        let [veil] = map.sample(u, v);
        raster.pixels[y * raster.width + x].map(|v| (v + density * veil) * brightest / (brightest + density))
    })
}

pub(super) fn rain(mut raster: Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let (rain, scale) = (&RAIN[level], raster.scale());
    let slant = rng.random_range(-RAIN_SLANT..=RAIN_SLANT);
    for value in &mut raster.pixels {
        *value = mix(*value, RAIN_COLOUR, rain.haze);
    }
    for _ in 0..rain.streaks {
        let at = [rng.random::<f32>() * raster.width as f32, rng.random::<f32>() * raster.height as f32];
        let (s, c) = (slant + rng.random_range(-STREAK_SLANT..=STREAK_SLANT)).sin_cos();
        let half_length = 0.5 * rain.length * scale * rng.random_range(0.6..=1.4);
        let opacity = rain.opacity * rng.random_range(0.5..=1.0);
        streak(&mut raster, at, [s, c], half_length, opacity);
    }
    raster
}

/// Draws a streak with soft edges around its middle.
fn streak(raster: &mut Raster<3>, at: [f32; 2], along: [f32; 2], half_length: f32, opacity: f32) {
    let half_width = STREAK_HALF_WIDTH * raster.scale();
    // A streak thinner than a pixel covers only a part of it.
    let (half_width, opacity) = match half_width.max(STREAK_LEAST_PX) {
        shown if shown > half_width => (shown, opacity * half_width / shown),
        shown => (shown, opacity),
    };
    let range = |axis: usize, count: usize| {
        let reach = along[axis].abs() * half_length + 3.0 * half_width;
        let low = (at[axis] - reach).max(0.0) as usize;
        low..((at[axis] + reach).max(0.0) as usize + 1).min(count)
    };
    for (x, y) in range(1, raster.height).flat_map(|y| range(0, raster.width).map(move |x| (x, y))) {
        let (dx, dy) = (x as f32 - at[0], y as f32 - at[1]);
        let (u, v) = ((dx * along[0] + dy * along[1]).abs(), dx * along[1] - dy * along[0]);
        let end = (1.0 - (u - half_length).max(0.0) / half_width).clamp(0.0, 1.0);
        let share = opacity * end * (-0.5 * (v / half_width).powi(2)).exp();
        let value = &mut raster.pixels[y * raster.width + x];
        *value = mix(*value, RAIN_COLOUR, share);
    }
}
