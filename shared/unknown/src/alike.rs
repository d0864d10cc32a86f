//! Whether two images from one pose show the same, through the noise, the exposure and the small pose errors of a camera.

use crate::align::{View, align, reduced};
use crate::fit::{fit, fit_from_offset};
use crate::residuals::{Pixels, ResidualKind, median_residual, with_neighbours};
use ndarray::ArrayView3;

/// Longest side of the compared images, pixels: fine texture is below the errors of the pose.
const SIDE_PX: usize = 64;
/// Largest gain of one image over another one from its pose.
const MOST_GAIN: f32 = 1.5;
/// Residual that noise does not exceed, in deviations.
const WITHIN: f32 = 2.0;

/// Returns true if two images (height, width, channel) from one pose show the same, as far as a camera's noise shows:
/// up to gain and offset of each channel, and a small affine motion of the view. `counts` is true for the pixels that
/// count, by index row by row. Images of different sizes do not show the same.
///
/// A residual is the distance of a pixel from the range of the other image's pixels around it. It counts if it is found
/// in both images, and with each alignment of the two.
///
/// ```
/// use ndarray::Array3;
/// let road = Array3::from_shape_fn((96, 96, 3), |(y, x, _)| 90 + (x / 12 % 2 * 40 + y / 24 % 2 * 20) as u8);
/// let darker = road.mapv(|v| v - 10);
/// let mut with_car = darker.clone();
/// with_car.slice_mut(ndarray::s![40..56, 30..60, ..]).fill(230);
/// assert!(carff_unknown::shows_same(road.view(), darker.view(), |_| true));
/// assert!(!carff_unknown::shows_same(road.view(), with_car.view(), |_| true));
/// ```
pub fn shows_same(a: ArrayView3<'_, u8>, b: ArrayView3<'_, u8>, counts: impl Fn(usize) -> bool) -> bool {
    let (rows, columns, _) = a.dim();
    if a.dim() != b.dim() || rows == 0 || columns == 0 {
        return false;
    }
    let scaled = |side: usize| (side * SIDE_PX / rows.max(columns)).clamp(1, side);
    let (width, height) = (scaled(columns), scaled(rows));
    let centre = |i: usize, n: usize, all: usize| (2 * i + 1) * all / (2 * n);
    let valid: Vec<bool> = (0..width * height)
        .map(|i| counts(centre(i / width, height, rows) * columns + centre(i % width, width, columns)))
        .collect();
    let counting: Vec<usize> = (0..valid.len()).filter(|&i| valid[i]).collect();
    let (a, b) = (smooth(&reduced(a, width, height), width), smooth(&reduced(b, width, height), width));
    let alike = |a: &[f32], b: &[f32]| {
        let judged: Vec<bool> =
            (0..valid.len()).map(|i| valid[i] && !a[i * 3].is_nan() && !b[i * 3].is_nan()).collect();
        explains(a, b, &judged, width) || explains(b, a, &judged, width)
    };
    let moved = |from: &[f32], to: &[f32]| align(View { rgb: from, width, height }, to, &counting);
    alike(&a, &b) || moved(&b, &a).is_some_and(|b| alike(&a, &b)) || moved(&a, &b).is_some_and(|a| alike(&a, &b))
}

/// Reports whether one image leaves no residual of another one.
fn explains(one: &[f32], other: &[f32], judged: &[bool], width: usize) -> bool {
    let pixels: Vec<usize> = (0..judged.len()).filter(|&i| judged[i]).collect();
    let freely = fit(other, one, &pixels);
    // A bright vehicle that only `one` has pulls the gain towards nothing, and nothing explains everything.
    let is_plausible = freely.gain().iter().all(|gain| (1.0 / MOST_GAIN..=MOST_GAIN).contains(gain));
    let fit = if is_plausible { freely } else { fit_from_offset(other, one, &pixels) };
    let energy = Pixels::new(other, judged, &[one], width).energy(one, &[], &fit);
    let residual = median_residual(&energy, ResidualKind::Unexpected, judged, width, fit.noise);
    residual.iter().all(|residual| *residual <= WITHIN)
}

/// Means over 3 x 3 pixels.
pub(crate) fn smooth(image: &[f32], width: usize) -> Vec<f32> {
    let everywhere = vec![true; image.len() / 3];
    let sums = with_neighbours(image, &everywhere, width, 0.0, |a, b| a + b);
    let counts = with_neighbours(&vec![1.0; image.len()], &everywhere, width, 0.0, |a, b| a + b);
    sums.iter().zip(counts).map(|(sum, count)| sum / count).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    const SIDE: usize = 128;

    /// A place with patches and edges, as a camera sees it that has moved by `shift` pixels and is turned by `turn`
    /// radians, with read noise of 4 of 255 and a gain; with a vehicle of this length, pixels.
    fn photo(seed: u32, shift: [f64; 2], turn: f64, gain: f64, vehicle_px: f64) -> Array3<u8> {
        let noise = |i: usize| {
            let draw = |salt: u32| {
                let mut v = (i as u32 ^ salt).wrapping_mul(0x9E37_79B9) ^ seed.wrapping_mul(0x85EB_CA6B);
                v ^= v >> 15;
                v = v.wrapping_mul(0x2C1B_3C6D);
                v ^= v >> 13;
                f64::from(v >> 8) / f64::from(1_u32 << 24) - 0.5
            };
            // Four uniform draws have nearly a normal distribution, of deviation 0.58.
            4.0 / 0.58 * (0..4).map(|k| draw(k * 7_919 + 1)).sum::<f64>()
        };
        Array3::from_shape_fn((SIDE, SIDE, 3), |(y, x, c)| {
            let (right, down) = (x as f64 - 64.0, y as f64 - 64.0);
            let (u, v) = (right - turn * down + shift[0] + 64.0, down + turn * right + shift[1] + 64.0);
            let wall = if u < 40.0 && v < 70.0 { 60.0 } else { 0.0 };
            let place = 90.0 + 30.0 * (0.21 * u).sin() * (0.17 * v).cos() + wall + 10.0 * c as f64;
            let in_vehicle = (70.0..70.0 + vehicle_px).contains(&u) && (80.0..80.0 + vehicle_px / 2.0).contains(&v);
            let value = if in_vehicle { [200.0, 180.0, 40.0][c] } else { place };
            (gain * value + noise((y * SIDE + x) * 3 + c)).clamp(0.0, 255.0) as u8
        })
    }

    /// A bright vehicle on a road of little contrast is a difference, although a gain of nothing would explain it.
    #[test]
    fn contrast_does_not_vanish_in_the_gain() {
        let road = |vehicle_px: usize| {
            Array3::from_shape_fn((64, 64, 3), |(y, x, _)| {
                let in_vehicle = (20..20 + vehicle_px).contains(&x) && (30..44).contains(&y);
                if in_vehicle { 230 } else { 80 + (x / 9 % 2 * 20 + y / 16 % 2 * 20 + x * 7 % 5) as u8 }
            })
        };
        for vehicle_px in [12, 20, 30] {
            assert!(!shows_same(road(0).view(), road(vehicle_px).view(), |_| true), "{vehicle_px}");
        }
        assert!(shows_same(road(0).view(), road(0).view(), |_| true));
    }

    /// Two photos of a place from nearly one pose show the same, at any exposure; a vehicle in one of them is a
    /// difference, unless it is where no pixel counts.
    #[test]
    fn photos_of_one_place_show_the_same() {
        let clear = photo(1, [0.0, 0.0], 0.0, 1.0, 0.0);
        for (seed, shift, turn, gain) in
            [(2, [0.0, 0.0], 0.0, 1.0), (3, [1.5, -2.0], 0.01, 0.9), (4, [-2.5, 0.5], -0.02, 1.1)]
        {
            let again = photo(seed, shift, turn, gain, 0.0);
            assert!(shows_same(clear.view(), again.view(), |_| true), "{shift:?} {turn} {gain}");
            let with_vehicle = photo(seed, shift, turn, gain, 20.0);
            assert!(!shows_same(clear.view(), with_vehicle.view(), |_| true), "{shift:?} {turn} {gain}");
            assert!(!shows_same(with_vehicle.view(), clear.view(), |_| true), "{shift:?} {turn} {gain}");
            assert!(shows_same(clear.view(), with_vehicle.view(), |i| i / SIDE < 70));
        }
        assert!(!shows_same(clear.view(), clear.slice(ndarray::s![..64, .., ..]), |_| true), "another size");
        let nothing = Array3::zeros((0, 0, 3));
        assert!(!shows_same(nothing.view(), nothing.view(), |_| true));
    }
}
