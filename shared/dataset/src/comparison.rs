//! How two images of one pose are compared: exactly, or through the noise of a camera.

use crate::image::{Image, looks_same_where};
use std::iter::Sum;
use std::ops::Add;

/// Largest change of the difference of two images from pixel to pixel, of 255: less than a camera's noise.
const NEARLY: i16 = 1;

/// Selects how two images of one pose are compared. A dataset has one comparison for all its images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageComparison {
    /// By [`looks_same_where`]: images without noise.
    Exact,
    /// By [`carff_unknown::shows_same`]: images of a camera.
    ThroughNoise,
}

impl ImageComparison {
    /// Returns true if two images show the same in the pixels that count, by index row by row.
    pub fn same(self, a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> bool {
        match (self, a.view().zip(b.view())) {
            (Self::ThroughNoise, Some((a, b))) => carff_unknown::shows_same(a, b, counts),
            _ => looks_same_where(a, b, counts),
        }
    }
}

/// Counts of pairs of images, by which their comparison is chosen.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pairs {
    all: usize,
    mostly_equal: usize,
}

impl Pairs {
    /// Counts all pairs of the images from one view. `valid` returns the test for pixels that count in two of them.
    pub(crate) fn of_view<V: Fn(usize) -> bool>(images: &[&Image], valid: impl Fn([usize; 2]) -> V) -> Self {
        let pairs = (0..images.len()).flat_map(|a| (0..a).map(move |b| [a, b]));
        pairs.map(|[a, b]| Self::one(images[a], images[b], valid([a, b]))).sum()
    }

    /// Returns the count of one pair. It is mostly equal if from at least half of the pixels that count to the next, the
    /// difference of the images hardly changes: noise differs from pixel to pixel, and another colour or light does not.
    fn one(a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> Self {
        let difference = |value: usize| i16::from(a.rgb[value]) - i16::from(b.rgb[value]);
        let width = (a.width_px as usize).max(1);
        let (mut equal, mut all) = (0, 0);
        let pixels = 0..a.rgb.len().min(b.rgb.len()) / 3;
        for pixel in pixels.filter(|&pixel| pixel % width > 0 && counts(pixel) && counts(pixel - 1)) {
            let hardly = |value: usize| (difference(value) - difference(value - 3)).abs() <= NEARLY;
            equal += usize::from((pixel * 3..pixel * 3 + 3).all(hardly));
            all += 1;
        }
        Self { all: 1, mostly_equal: usize::from(2 * equal >= all) }
    }

    /// Returns the comparison that such images need: through noise if most pairs are not mostly equal. Rendered images of
    /// one pose are equal wherever nothing changes. No pair shows whether images from different poses have noise; a camera
    /// takes such images, so they are compared through it.
    pub(crate) fn comparison(self) -> ImageComparison {
        if self.all == 0 || 2 * self.mostly_equal < self.all {
            ImageComparison::ThroughNoise
        } else {
            ImageComparison::Exact
        }
    }
}

impl Add for Pairs {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { all: self.all + other.all, mostly_equal: self.mostly_equal + other.mostly_equal }
    }
}

impl Sum for Pairs {
    fn sum<I: Iterator<Item = Self>>(pairs: I) -> Self {
        pairs.fold(Self::default(), Self::add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Read noise of one of 255 is found; another light on everything, or a vehicle, does not count as noise.
    #[test]
    fn noise_differs_from_pixel_to_pixel() {
        let mut state = 1_u32;
        let mut photo = |noise: f64, light: u8, vehicle: bool| {
            let mut image = Image::filled(32, 24, [0; 3]);
            for (i, value) in image.rgb.iter_mut().enumerate() {
                let draws = (0..12).map(|_| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    f64::from(state >> 8) / f64::from(1_u32 << 24)
                });
                let normal = draws.sum::<f64>() - 6.0;
                let shown = if vehicle && i % 96 > 60 { 200 } else { 60 + (i / 3 % 7 * 9) as u8 + light };
                *value = (f64::from(shown) + noise * normal).round() as u8;
            }
            image
        };
        for (noise, light, vehicle, comparison) in [
            (0.0, 40, false, ImageComparison::Exact),
            (0.0, 0, true, ImageComparison::Exact),
            (1.0, 0, false, ImageComparison::ThroughNoise),
            (4.0, 40, true, ImageComparison::ThroughNoise),
        ] {
            let (one, other) = (photo(noise, 0, false), photo(noise, light, vehicle));
            assert_eq!(Pairs::one(&one, &other, |_| true).comparison(), comparison, "{noise} {light} {vehicle}");
        }
        assert_eq!(Pairs::default().comparison(), ImageComparison::ThroughNoise);
    }
}
