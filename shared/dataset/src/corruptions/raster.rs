//! Images of floats with `C` channels, 0 is black and 1 is white, and operations that several corruptions share.

use crate::Image;

/// Side of the images for which ImageNet-C defines its lengths, pixels.
const REFERENCE_SIDE_PX: f32 = 224.0;
/// Smallest standard deviation of a blur that changes anything, pixels.
const LEAST_SIGMA_PX: f32 = 0.05;
/// Standard deviation from which three box blurs replace a Gaussian blur, pixels.
const BOX_SIGMA_PX: f32 = 8.0;

/// A raster, row-major from the top left.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Raster<const C: usize> {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<[f32; C]>,
}

impl Raster<3> {
    /// Returns the raster of an image; `None` if the image is empty or its bytes do not match its size.
    pub fn from_image(image: &Image) -> Option<Self> {
        image.view().filter(|view| !view.is_empty())?;
        let pixels = image.rgb.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0)).collect();
        Some(Self { width: image.width_px as usize, height: image.height_px as usize, pixels })
    }

    pub fn into_image(self) -> Image {
        // The cast saturates at 0 and 255.
        let rgb = self.pixels.into_iter().flatten().map(|v| (v * 255.0).round() as u8).collect();
        Image { width_px: self.width as u32, height_px: self.height as u32, rgb }
    }
}

/// Returns the luma of a colour.
pub(super) fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// Returns the index of a pixel inside 0..count for any position, by reflection at the edge pixels.
fn mirrored(position: isize, count: usize) -> usize {
    let period = 2 * (count as isize - 1);
    if period == 0 {
        return 0;
    }
    let at = position.rem_euclid(period);
    at.min(period - at) as usize
}

impl<const C: usize> Raster<C> {
    /// Returns a raster with the value of each (column, row).
    pub fn of(width: usize, height: usize, mut value: impl FnMut(usize, usize) -> [f32; C]) -> Self {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| value(x, y)).collect();
        Self { width, height, pixels }
    }

    /// Returns a raster of the same size with the value of each (column, row).
    pub fn like<const D: usize>(&self, value: impl FnMut(usize, usize) -> [f32; D]) -> Raster<D> {
        Raster::of(self.width, self.height, value)
    }

    /// Returns pixels per pixel of a 224 x 224 image of the same area.
    pub fn scale(&self) -> f32 {
        (self.pixels.len() as f32).sqrt() / REFERENCE_SIDE_PX
    }

    /// Returns the middle, pixels.
    pub fn middle(&self) -> [f32; 2] {
        [(self.width as f32 - 1.0) / 2.0, (self.height as f32 - 1.0) / 2.0]
    }

    /// Returns the value at any position, reflected at the edges.
    pub fn at(&self, x: isize, y: isize) -> [f32; C] {
        self.pixels[mirrored(y, self.height) * self.width + mirrored(x, self.width)]
    }

    /// Returns the bilinear value at any position, pixel centres at whole numbers.
    pub fn sample(&self, x: f32, y: f32) -> [f32; C] {
        let (left, top) = (x.floor(), y.floor());
        let (a, b) = (x - left, y - top);
        let (x, y) = (left as isize, top as isize);
        let corners = [self.at(x, y), self.at(x + 1, y), self.at(x, y + 1), self.at(x + 1, y + 1)];
        let weights = [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b];
        std::array::from_fn(|c| (0..4).map(|i| corners[i][c] * weights[i]).sum())
    }

    /// Returns the raster after a Gaussian blur.
    pub fn blurred(&self, sigma_px: f32) -> Self {
        if sigma_px < LEAST_SIGMA_PX {
            return self.clone();
        }
        if sigma_px >= BOX_SIGMA_PX {
            let radius = sigma_px.round() as isize;
            let boxed = |raster: Self| raster.averaged_rows(radius).transposed().averaged_rows(radius).transposed();
            return (0..3).fold(self.clone(), |raster, _| boxed(raster));
        }
        let radius = (3.0 * sigma_px).ceil() as isize;
        let weights: Vec<f32> = (-radius..=radius).map(|i| (-0.5 * (i as f32 / sigma_px).powi(2)).exp()).collect();
        self.filtered(&weights)
    }

    /// Returns the means of `2 radius + 1` pixels of each row: a running sum.
    fn averaged_rows(&self, radius: isize) -> Self {
        let count = (2 * radius + 1) as f32;
        let mut pixels = Vec::with_capacity(self.pixels.len());
        for y in 0..self.height as isize {
            let mut sum = [0.0; C];
            (-radius..=radius).for_each(|x| (0..C).for_each(|c| sum[c] += self.at(x, y)[c]));
            for x in 0..self.width as isize {
                pixels.push(sum.map(|v| v / count));
                let (enters, leaves) = (self.at(x + radius + 1, y), self.at(x - radius, y));
                (0..C).for_each(|c| sum[c] += enters[c] - leaves[c]);
            }
        }
        Self { pixels, ..*self }
    }

    /// Returns the raster with rows and columns exchanged.
    fn transposed(&self) -> Self {
        Self::of(self.height, self.width, |x, y| self.pixels[x * self.width + y])
    }

    /// Filters rows, then columns, with an odd number of weights.
    fn filtered(&self, weights: &[f32]) -> Self {
        let radius = (weights.len() / 2) as isize;
        let total: f32 = weights.iter().sum();
        let along = |raster: &Self, step: [isize; 2]| {
            raster.like(|x, y| {
                let mut sum = [0.0; C];
                for (weight, i) in weights.iter().zip(-radius..) {
                    let value = raster.at(x as isize + i * step[0], y as isize + i * step[1]);
                    sum.iter_mut().zip(value).for_each(|(s, v)| *s += weight * v);
                }
                sum.map(|v| v / total)
            })
        };
        along(&along(self, [1, 0]), [0, 1])
    }

    /// Returns the raster blurred to one side along a direction, like a camera that moves: `2 radius + 1` samples with
    /// half-Gaussian weights, `step_px` from each other.
    pub fn moved(&self, radius: usize, sigma: f32, angle_deg: f32, step_px: f32) -> Self {
        let (dy, dx) = angle_deg.to_radians().sin_cos();
        let weights: Vec<f32> = (0..=2 * radius).map(|i| (-0.5 * (i as f32 / sigma).powi(2)).exp()).collect();
        let total: f32 = weights.iter().sum();
        self.like(|x, y| {
            let mut sum = [0.0; C];
            for (i, weight) in weights.iter().enumerate() {
                let by = i as f32 * step_px;
                let value = self.sample(x as f32 + by * dx, y as f32 + by * dy);
                sum.iter_mut().zip(value).for_each(|(s, v)| *s += weight * v);
            }
            sum.map(|v| v / total)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Positions beyond an edge are reflected, however far.
    #[test]
    fn edges_reflect() {
        assert_eq!([-2, -1, 0, 2, 3, 4, 7].map(|i| mirrored(i, 3)), [2, 1, 0, 2, 1, 0, 1]);
        assert_eq!(mirrored(-5, 1), 0);
    }

    /// Blurs keep a uniform raster, and Gaussian and box blurs spread a point to the same width.
    #[test]
    fn blurs_keep_the_sum() {
        let even = Raster::of(9, 5, |_, _| [0.3]);
        for blurred in [even.blurred(1.0), even.blurred(30.0), even.moved(4, 2.0, 30.0, 1.0)] {
            assert!(blurred.pixels.iter().all(|v| (v[0] - 0.3).abs() < 1e-5));
        }
        let point = Raster::of(121, 1, |x, _| [if x == 60 { 1.0 } else { 0.0 }]);
        for sigma in [7.0_f32, 9.0] {
            let spread = point.blurred(sigma);
            let variance: f32 = spread.pixels.iter().enumerate().map(|(x, v)| v[0] * (x as f32 - 60.0).powi(2)).sum();
            assert!((variance.sqrt() - sigma).abs() < 0.08 * sigma, "{sigma}: {}", variance.sqrt());
        }
    }
}
