//! Changes of brightness, geometry and resolution. Lengths are pixels of a 224 x 224 image.

use super::CorruptionError;
use super::raster::Raster;
use crate::Image;
use image::{ExtendedColorType, codecs::jpeg::JpegEncoder};
use rand::Rng;

/// Addition to the value in HSV.
const BRIGHTNESS: [f32; 5] = [0.1, 0.2, 0.3, 0.4, 0.5];
/// Factors of the differences from the mean.
const CONTRAST: [f32; 5] = [0.4, 0.3, 0.2, 0.1, 0.05];
/// Size for which ImageNet-C defines the elastic transform, pixels.
const ELASTIC_SIDE: f32 = 244.0;
/// Strength and smoothness of the local shifts, and largest shift of the affine map's points, shares of the size.
const ELASTIC: [[f32; 3]; 5] =
    [[2.0, 0.7, 0.1], [2.0, 0.08, 0.2], [0.05, 0.01, 0.02], [0.07, 0.01, 0.02], [0.12, 0.01, 0.02]];
/// Ratio of the size in large pixels to the size.
const PIXELATE: [f32; 5] = [0.6, 0.5, 0.4, 0.3, 0.25];
/// Quality of the compression, of 100.
const JPEG_QUALITY: [u8; 5] = [25, 18, 15, 10, 7];

pub(super) fn brightness(mut raster: Raster<3>, level: usize) -> Raster<3> {
    for value in &mut raster.pixels {
        let old = value.iter().copied().fold(0.0, f32::max);
        let new = (old + BRIGHTNESS[level]).min(1.0);
        *value = if old > 0.0 { value.map(|v| v * new / old) } else { [new; 3] };
    }
    raster
}

pub(super) fn contrast(mut raster: Raster<3>, level: usize) -> Raster<3> {
    let count = raster.pixels.len() as f32;
    let mean = [0, 1, 2].map(|c| raster.pixels.iter().map(|v| v[c]).sum::<f32>() / count);
    for value in &mut raster.pixels {
        *value = [0, 1, 2].map(|c| mean[c] + CONTRAST[level] * (value[c] - mean[c]));
    }
    raster
}

pub(super) fn elastic(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let [strength, smooth, affine] = ELASTIC[level].map(|share| share * ELASTIC_SIDE * raster.scale());
    let map = affine_map(raster, affine, rng);
    let mut random = || raster.like(|_, _| [rng.random_range(-1.0..=1.0)]);
    // Smooth noise is weaker by its width in pixels, so the shift needs the scale once more.
    let shift = [random(), random()].map(|noise| noise.blurred(smooth));
    let strength = strength * raster.scale();
    raster.like(|x, y| {
        let at = |axis: usize, from: usize| from as f32 + strength * shift[axis].pixels[y * raster.width + x][0];
        let [u, v] = map(at(0, x), at(1, y));
        raster.sample(u, v)
    })
}

/// Returns the affine map that moves three points about the middle to random ones, each within `limit` pixels along
/// each axis: from the pixels of the result to those of the raster. It is the identity if the points are on a line.
fn affine_map<R: Rng>(raster: &Raster<3>, limit: f32, rng: &mut R) -> impl Fn(f32, f32) -> [f32; 2] + use<R> {
    let [cx, cy] = raster.middle();
    let side = (raster.width.min(raster.height) as f32 / 3.0).max(1.0);
    let old = [[cx + side, cy + side], [cx + side, cy - side], [cx - side, cy - side]];
    let new = old.map(|point| point.map(|v| v + if limit > 0.0 { rng.random_range(-limit..=limit) } else { 0.0 }));
    let edge = |points: [[f32; 2]; 3], i: usize| [points[i][0] - points[0][0], points[i][1] - points[0][1]];
    let (a, b, p, q) = (edge(new, 1), edge(new, 2), edge(old, 1), edge(old, 2));
    let area = a[0] * b[1] - a[1] * b[0];
    let valid = area.abs() > 0.05 * side * side;
    move |x, y| {
        if !valid {
            return [x, y];
        }
        let (dx, dy) = (x - new[0][0], y - new[0][1]);
        let (s, t) = ((dx * b[1] - dy * b[0]) / area, (dy * a[0] - dx * a[1]) / area);
        [0, 1].map(|i| old[0][i] + s * p[i] + t * q[i])
    }
}

pub(super) fn pixelate(raster: &Raster<3>, level: usize) -> Raster<3> {
    let large = |count: usize| ((count as f32 * PIXELATE[level]) as usize).max(1);
    let (width, height) = (large(raster.width), large(raster.height));
    let coarse = Raster::of(width, height, |x, y| {
        let (columns, rows) = (covered(x, width, raster.width), covered(y, height, raster.height));
        let total: f32 = columns.iter().map(|c| c.1).sum::<f32>() * rows.iter().map(|r| r.1).sum::<f32>();
        let mut sum = [0.0; 3];
        for ((row, a), (column, b)) in rows.iter().flat_map(|r| columns.iter().map(move |c| (r, c))) {
            let value = raster.pixels[row * raster.width + column];
            sum.iter_mut().zip(value).for_each(|(s, v)| *s += a * b * v);
        }
        sum.map(|v| v / total)
    });
    let nearest = |i: usize, few: usize, many: usize| ((2 * i + 1) * few / (2 * many)).min(few - 1);
    raster.like(|x, y| coarse.pixels[nearest(y, height, raster.height) * width + nearest(x, width, raster.width)])
}

/// Returns the pixels, of `many`, that large pixel `i` of `few` covers, with the covered share.
fn covered(i: usize, few: usize, many: usize) -> Vec<(usize, f32)> {
    let ratio = many as f32 / few as f32;
    let (low, high) = (i as f32 * ratio, (i as f32 + 1.0) * ratio);
    let share = |p: usize| (high.min(p as f32 + 1.0) - low.max(p as f32)).max(0.0);
    (low as usize..many.min(high.ceil() as usize)).map(|p| (p, share(p))).collect()
}

pub(super) fn jpeg(image: &Image, level: usize) -> Result<Image, CorruptionError> {
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY[level]);
    encoder.encode(&image.rgb, image.width_px, image.height_px, ExtendedColorType::Rgb8)?;
    Ok(Image::decode(&bytes, "jpeg_compression".as_ref())?)
}
