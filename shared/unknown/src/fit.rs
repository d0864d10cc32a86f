//! Robust fits: gain and offset of an image against a rendered one, and least squares.

use carff_base::linear::solve;

/// Passes of the robust fit of gain and offset.
const PASSES: usize = 5;
/// Rounds of choosing the pixels that agree.
const ROUNDS: usize = 3;
/// Pixels beyond this many robust deviations do not count in the fit.
const TRIM: f32 = 2.5;
/// Seen value from which on a sensor may be saturated, of 1.
const SATURATED: f32 = 0.98;
/// Smallest deviation of a pixel, of 1.
pub(crate) const LEAST_NOISE: f32 = 0.015;
/// Fewest points of a fit.
const FEWEST: f64 = 16.0;
/// A robust deviation is the median times this, for normally distributed values.
const OF_MEDIAN: f32 = 1.4826;

/// Colours of a camera against the field, and what is left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// For each seen channel, the factors of the rendered ones. Those of other channels are 0, unless the camera mixes
    /// colours, as a monochrome one does.
    pub mix: [[f32; 3]; 3],
    /// Offset from rendered to seen values, of 1.
    pub offset: [f32; 3],
    /// Robust deviation of a pixel, of 1.
    pub noise: f32,
    /// Share of the view's variation that the still parts of the field explain, at most 1; 0 or below for a view of
    /// another place, or from another pose. 1 where the view shows lanes, but no still part.
    pub explained: f32,
}

impl Fit {
    /// A camera that shows what is rendered.
    pub(crate) const EXACT: Self = Self {
        mix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        offset: [0.0; 3],
        noise: LEAST_NOISE,
        explained: 1.0,
    };

    /// Returns the colour, 0..=1, that the camera shows for a rendered one. A sensor saturates: nothing is brighter than 1.
    pub fn seen(&self, rgb: &[f32]) -> [f32; 3] {
        [0, 1, 2].map(|c| (self.difference(c, rgb) + self.offset[c]).clamp(0.0, 1.0))
    }

    /// Returns the difference in a channel that the camera shows for a rendered difference.
    pub fn difference(&self, channel: usize, rgb: &[f32]) -> f32 {
        self.mix[channel].iter().zip(rgb).map(|(factor, v)| factor * v).sum()
    }

    /// Returns the gain of each channel, for grey.
    pub fn gain(&self) -> [f32; 3] {
        self.mix.map(|factors| factors.iter().sum())
    }
}

pub(crate) fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// Robust deviation of pixels from the rendered image as the camera would show it, of 1: the root mean square over the
/// channels, at least [`LEAST_NOISE`].
pub(crate) fn noise(image: &[f32], rendered: &[f32], fit: &Fit, pixels: &[usize]) -> f32 {
    let of_channel = |c: usize| {
        let error = |&i: &usize| (image[i * 3 + c] - fit.seen(&rendered[i * 3..i * 3 + 3])[c]).abs();
        OF_MEDIAN * median(&mut pixels.iter().map(error).collect::<Vec<_>>())
    };
    ((0..3).map(|c| of_channel(c).powi(2)).sum::<f32>() / 3.0).sqrt().max(LEAST_NOISE)
}

/// Fits gain and offset of each channel by least squares over some pixels, without outliers.
pub(crate) fn fit(image: &[f32], rendered: &[f32], pixels: &[usize]) -> Fit {
    fit_terms(
        image,
        rendered,
        pixels,
        |c, rgb| [rgb[c], 1.0],
        |c, [gain, offset]| {
            let mut mix = [0.0; 3];
            mix[c] = gain;
            (mix, offset)
        },
    )
}

/// Fits each seen channel by least squares as a mixture of the rendered ones, as [`fit`] does for one.
pub(crate) fn fit_mixed(image: &[f32], rendered: &[f32], pixels: &[usize]) -> Fit {
    fit_terms(
        image,
        rendered,
        pixels,
        |_, rgb| [rgb[0], rgb[1], rgb[2], 1.0],
        |_, [r, g, b, offset]| ([r, g, b], offset),
    )
}

/// Fits factors of terms of the rendered colour to each seen channel. Saturated values do not count.
fn fit_terms<const N: usize>(
    image: &[f32],
    rendered: &[f32],
    pixels: &[usize],
    terms: impl Fn(usize, &[f32]) -> [f32; N],
    factors: impl Fn(usize, [f32; N]) -> ([f32; 3], f32),
) -> Fit {
    let mut fit = Fit::EXACT;
    for c in 0..3 {
        let row = |&i: &usize| (terms(c, &rendered[i * 3..i * 3 + 3]), image[i * 3 + c]);
        let rows: Vec<([f32; N], f32)> = pixels.iter().map(row).filter(|(_, seen)| *seen < SATURATED).collect();
        let mut limit = f32::INFINITY;
        let mut found: Option<[f32; N]> = None;
        for _ in 0..PASSES {
            let error = |(terms, seen): &([f32; N], f32), by: &[f32; N]| {
                (seen - terms.iter().zip(by).map(|(term, factor)| term * factor).sum::<f32>()).abs()
            };
            let within = rows.iter().filter(|row| found.is_none_or(|by| error(row, &by) <= limit));
            let Some(by) = least_squares(within.copied()) else { break };
            let mut errors: Vec<f32> = rows.iter().map(|row| error(row, &by)).collect();
            limit = (TRIM * OF_MEDIAN * median(&mut errors)).max(LEAST_NOISE);
            found = Some(by);
        }
        if let Some(by) = found {
            (fit.mix[c], fit.offset[c]) = factors(c, by);
        }
    }
    Fit { noise: noise(image, rendered, &fit, pixels), ..fit }
}

/// Fits gain and offset as [`fit`] does, where `rendered` may have outliers, too: a bright vehicle that only it has would
/// pull the gain of [`fit`] towards nothing. This fit starts with the pixels that agree up to an offset.
pub(crate) fn fit_from_offset(image: &[f32], rendered: &[f32], pixels: &[usize]) -> Fit {
    let offset =
        |c: usize| median(&mut pixels.iter().map(|&i| image[i * 3 + c] - rendered[i * 3 + c]).collect::<Vec<_>>());
    let mut found = Fit { offset: [0, 1, 2].map(offset), ..Fit::EXACT };
    for _ in 0..ROUNDS {
        let error = |i: usize, c: usize| (image[i * 3 + c] - found.seen(&rendered[i * 3..i * 3 + 3])[c]).abs();
        let limits = [0, 1, 2].map(|c| {
            (TRIM * OF_MEDIAN * median(&mut pixels.iter().map(|&i| error(i, c)).collect::<Vec<_>>())).max(LEAST_NOISE)
        });
        let agree = |i: &usize| (0..3).all(|c| error(*i, c) <= limits[c]);
        found = fit(image, rendered, &pixels.iter().copied().filter(agree).collect::<Vec<_>>());
    }
    Fit { noise: noise(image, rendered, &found, pixels), ..found }
}

/// Solves for the factors of N terms, by least squares over rows of terms and their value; `None` for too few rows or
/// dependent terms.
pub(crate) fn least_squares<const N: usize>(rows: impl Iterator<Item = ([f32; N], f32)>) -> Option<[f32; N]> {
    let (mut count, mut matrix, mut right) = (0.0, [[0.0_f64; N]; N], [0.0_f64; N]);
    for (row, value) in rows {
        count += 1.0;
        let row = row.map(f64::from);
        for i in 0..N {
            right[i] += row[i] * f64::from(value);
            for j in 0..N {
                matrix[i][j] += row[i] * row[j];
            }
        }
    }
    if count < FEWEST {
        return None;
    }
    solve(matrix, right, 1e-9 * count).map(|found| found.map(|v| v as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gain and offset are found with a ninth of the pixels covered by something else.
    #[test]
    fn the_fit_is_robust() {
        let rendered: Vec<f32> = (0..900).map(|i| 0.1 + 0.8 * ((i * 37 % 100) as f32) / 100.0).collect();
        let image: Vec<f32> =
            rendered.iter().enumerate().map(|(i, v)| if i / 3 % 9 < 1 { 0.95 } else { 0.6 * v + 0.2 }).collect();
        let fit = fit(&image, &rendered, &(0..300).collect::<Vec<_>>());
        for c in 0..3 {
            assert!((fit.gain()[c] - 0.6).abs() < 0.05 && (fit.offset[c] - 0.2).abs() < 0.05, "{fit:?}");
        }
    }

    /// A seventh of the rendered pixels are outliers at one end: they do not turn the line.
    #[test]
    fn outliers_of_both_images_do_not_count() {
        let rendered: Vec<f32> =
            (0..900).map(|i| if i / 3 % 7 < 1 { 0.95 } else { 0.3 + 0.2 * ((i * 37 % 100) as f32) / 100.0 }).collect();
        let image: Vec<f32> =
            rendered.iter().enumerate().map(|(i, v)| if i / 3 % 7 < 1 { 0.4 } else { 0.9 * v + 0.05 }).collect();
        let pixels: Vec<usize> = (0..300).collect();
        let fit = fit_from_offset(&image, &rendered, &pixels);
        for c in 0..3 {
            assert!((fit.gain()[c] - 0.9).abs() < 0.01 && (fit.offset[c] - 0.05).abs() < 0.01, "{fit:?}");
        }
        let nothing = fit_from_offset(&image, &rendered, &[]);
        assert_eq!((nothing.gain(), nothing.offset), ([1.0; 3], [0.0; 3]));
    }

    /// Factors are found exactly where the values have no noise; too few rows and dependent terms have none.
    #[test]
    fn least_squares_are_solved() {
        let row = |i: usize| {
            let x = i as f32 / 10.0;
            ([1.0, x, x * x], 2.0 - 3.0 * x + 0.5 * x * x)
        };
        let found = least_squares((0..40).map(row)).unwrap();
        assert!(found.iter().zip([2.0, -3.0, 0.5]).all(|(a, b)| (a - b).abs() < 1e-3), "{found:?}");
        assert_eq!(least_squares((0..15).map(row)), None);
        assert_eq!(least_squares((0..40).map(|i| ([i as f32, 2.0 * i as f32], 1.0))), None);
    }
}
