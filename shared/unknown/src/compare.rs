//! Render and compare: every known state is rendered from the camera's own pose and compared with the image.

use crate::blobs::{Blob, blobs};
use crate::lanes::{ErrorMap, Ground, Lanes};
use carff_base::geometry::PinholeCamera;
use carff_field::{Field, HypothesisBuffer, RenderBuffer, RenderOptions};
use carff_messages::LATENT_DIM;
use ndarray::{ArrayView3, s};

/// Longest side of the compared images, pixels.
const SIDE_PX: u32 = 64;
/// Pixels around the lanes that are compared too: residuals are smoothed, and objects next to a lane are followed.
const MARGIN_PX: usize = 3;
/// Fewer samples than for images to look at: errors of a few per cent are below the noise. Half the resolution was
/// tried: cars of the road's colour stay within the range of the coarser pixels.
const QUICK: RenderOptions =
    RenderOptions { threads: 1, max_samples_per_ray: 128, min_transmittance: 0.1, min_weight: 0.1, step_scale: 2.0 };
/// Every so many rows and columns, a pixel of the whole view is compared, to find out whether the view is of this place.
const PLACE_STEP_PX: usize = 4;
/// Largest difference that counts in that comparison, of 1: a vehicle that covers a part of the view is not a place.
const PLACE_CAP: f32 = 0.25;
/// Passes of the robust fit of gain and offset.
const PASSES: usize = 5;
/// Pixels beyond this many robust deviations do not count in the fit.
const TRIM: f32 = 2.5;
/// Smallest deviation of a pixel, of 1.
const LEAST_NOISE: f32 = 0.015;
/// Fewest pixels of a fit.
const FEWEST: f64 = 16.0;
/// A robust deviation is the median times this, for normally distributed values.
const OF_MEDIAN: f32 = 1.4826;

/// Gain and offset of a camera against the field, by channel, and what is left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Factor from rendered to seen values.
    pub gain: [f32; 3],
    /// Offset from rendered to seen values, of 1.
    pub offset: [f32; 3],
    /// Robust deviation of a pixel, of 1.
    pub noise: f32,
    /// Share of the view's variation that the still parts of the field explain, at most 1; 0 or below for a view of
    /// another place, or from another pose. 1 where the view shows no still part.
    pub explained: f32,
}

/// An image with its residuals under the known states, at the compared size.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// The camera at the compared size.
    pub camera: PinholeCamera,
    /// The image, 0..=1, RGB, row by row.
    pub image: Vec<f32>,
    /// Gain, offset and noise of the image.
    pub fit: Fit,
    /// For each pixel, the ground that it looks at.
    pub ground: Vec<Option<Ground>>,
    /// True for pixels that were compared.
    pub judged: Vec<bool>,
    /// For each state, the residual of each pixel, in deviations; 0 where it was not compared.
    pub residuals: Vec<Vec<f32>>,
}

impl Comparison {
    /// Returns the residuals on the lanes with the ground points where they were found, for one state.
    pub fn on_lanes(&self, state: usize) -> impl Iterator<Item = ([f64; 2], f32)> + '_ {
        let residual = self.residuals.get(state).into_iter().flatten();
        let pixels = residual.zip(&self.ground).zip(&self.judged);
        pixels.filter_map(|((r, ground), judged)| Some((ground.filter(|g| g.on_lanes && *judged)?.at_m, *r)))
    }

    /// Returns the blobs of a state that stand on the lanes, the strongest first.
    pub fn blobs(&self, state: usize, errors: &ErrorMap) -> Vec<Blob> {
        let residual = self.residuals.get(state);
        residual.map_or(Vec::new(), |r| blobs(&self.camera, r, &self.judged, &self.ground, errors))
    }
}

/// Renders the known states of one field and compares images with them. It reuses its memory, and the rendered states
/// while the camera stands still.
#[derive(Debug, Default)]
pub struct Comparer {
    buffer: HypothesisBuffer,
    /// The camera, the judged pixels and the states that the buffer shows.
    shown: Option<(PinholeCamera, Vec<bool>, Vec<[f32; LATENT_DIM]>)>,
}

impl Comparer {
    /// Compares an image (height, width, channel) with each state. `None` if the camera sees no lane.
    pub fn compare(
        &mut self,
        field: &Field,
        states: &[[f32; LATENT_DIM]],
        lanes: &Lanes,
        camera: &PinholeCamera,
        image: ArrayView3<'_, u8>,
        threads: usize,
    ) -> Option<Comparison> {
        let small = reduced_camera(camera);
        let (width, height) = (small.width_px as usize, small.height_px as usize);
        let ground = lanes.ground_points(&small);
        let seen: Vec<bool> = ground.iter().map(|g| g.is_some_and(|g| g.on_lanes)).collect();
        if !seen.contains(&true) || states.is_empty() {
            return None;
        }
        let judged = grown(&seen, width, MARGIN_PX);
        let is_sample = |i: usize| i % width % PLACE_STEP_PX == 1 && i / width % PLACE_STEP_PX == 1;
        let is_shown = |(camera, pixels, of): &(PinholeCamera, Vec<bool>, Vec<_>)| {
            *camera == small && *pixels == judged && of == states
        };
        if !self.shown.as_ref().is_some_and(is_shown) {
            let options = RenderOptions { threads: threads.max(1), ..QUICK };
            field.render_hypotheses_where(&small, states, |i| judged[i] || is_sample(i), &options, &mut self.buffer);
            self.shown = Some((small, judged.clone(), states.to_vec()));
        }
        let images = &self.buffer.images;
        let image = reduced(image, width, height);
        let is_still = |i: usize| !images[0].changing[i];
        let fit = Fit {
            explained: explained(&image, &images[0].rgb, |i| is_sample(i) && is_still(i)),
            ..fit(&image, &images[0].rgb, |i| judged[i] && is_still(i))
        };
        let energy = |rendered: &RenderBuffer| energy(&image, &rendered.rgb, &fit, &judged, width);
        let energies: Vec<Vec<f32>> = images.iter().map(energy).collect();
        let pixels: Vec<usize> = (0..judged.len()).filter(|&i| judged[i]).collect();
        let of_state = |(state, energy): (usize, &Vec<f32>)| {
            let mut energy = energy.clone();
            // The place of the vehicle itself varies, and nothing else can be there.
            for i in lanes.own_pixels(&small, state, &pixels) {
                energy[i] = 0.0;
            }
            smoothed(&energy, &judged, width, fit.noise)
        };
        let residuals: Vec<Vec<f32>> = energies.iter().enumerate().map(of_state).collect();
        Some(Comparison { camera: small, image, fit, ground, judged, residuals })
    }

    /// The rendered states of the last comparison, RGB, 0..=1, row by row; pixels that were not compared are black.
    pub fn rendered(&self) -> impl Iterator<Item = &[f32]> {
        self.buffer.images.iter().map(|image| image.rgb.as_slice())
    }
}

/// The same camera at the compared size.
fn reduced_camera(camera: &PinholeCamera) -> PinholeCamera {
    let longest = u64::from(camera.width_px.max(camera.height_px).max(1));
    let scaled = |side: u32| ((u64::from(side) * u64::from(SIDE_PX) / longest) as u32).max(1);
    camera.resized(scaled(camera.width_px), scaled(camera.height_px))
}

/// Means over the cells of a grid of `width` x `height`, 0..=1.
fn reduced(image: ArrayView3<'_, u8>, width: usize, height: usize) -> Vec<f32> {
    let (rows, columns, _) = image.dim();
    let cell = |i: usize, n: usize, all: usize| {
        let start = (i * all / n).min(all.saturating_sub(1));
        start..((i + 1) * all / n).clamp(start + 1, all.max(start + 1))
    };
    let mut out = Vec::with_capacity(width * height * 3);
    for y in 0..height {
        for x in 0..width {
            let part = image.slice(s![cell(y, height, rows), cell(x, width, columns), ..]);
            let n = (part.len() / 3).max(1) as f32 * 255.0;
            for channel in part.axis_iter(ndarray::Axis(2)).take(3) {
                out.push(channel.iter().map(|&v| f32::from(v)).sum::<f32>() / n);
            }
        }
    }
    out
}

/// Pixels at most `margin` rows and columns away from a marked one.
fn grown(marked: &[bool], width: usize, margin: usize) -> Vec<bool> {
    let height = marked.len() / width.max(1);
    let mut out = vec![false; marked.len()];
    for (i, _) in marked.iter().enumerate().filter(|(_, marked)| **marked) {
        let (x, y) = (i % width, i / width);
        for y in y.saturating_sub(margin)..(y + margin + 1).min(height) {
            out[y * width + x.saturating_sub(margin)..y * width + (x + margin + 1).min(width)].fill(true);
        }
    }
    out
}

fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// Fits gain and offset of each channel by least squares over the pixels that count, without outliers.
fn fit(image: &[f32], rendered: &[f32], counts: impl Fn(usize) -> bool) -> Fit {
    let (mut gain, mut offset, mut noise) = ([1.0; 3], [0.0; 3], [LEAST_NOISE; 3]);
    for c in 0..3 {
        let of_channel = (0..image.len() / 3).filter(|&i| counts(i)).map(|i| (rendered[i * 3 + c], image[i * 3 + c]));
        let pairs: Vec<(f32, f32)> = of_channel.collect();
        let mut limit = f32::INFINITY;
        for _ in 0..PASSES {
            let error = |(x, y): (f32, f32)| (y - gain[c] * x - offset[c]).abs();
            let Some(line) = line(pairs.iter().copied().filter(|pair| error(*pair) <= limit)) else { break };
            (gain[c], offset[c]) = line;
            let mut errors: Vec<f32> = pairs.iter().map(|(x, y)| (y - line.0 * x - line.1).abs()).collect();
            noise[c] = OF_MEDIAN * median(&mut errors);
            limit = (TRIM * noise[c]).max(LEAST_NOISE);
        }
    }
    let noise = (noise.iter().map(|v| v * v).sum::<f32>() / 3.0).sqrt().max(LEAST_NOISE);
    Fit { gain, offset, noise, explained: 1.0 }
}

/// Share of an image's variation, over the pixels that count, that a gain and an offset of the rendered one explain.
/// The gain is at least 0: an inverted image shows another place.
fn explained(image: &[f32], rendered: &[f32], counts: impl Fn(usize) -> bool) -> f32 {
    let fit = fit(image, rendered, &counts);
    let capped = |difference: f32| difference.abs().min(PLACE_CAP).powi(2);
    let (mut left, mut all, mut least) = (0.0, 0.0, 0.0);
    for c in 0..3 {
        let seen = || (0..image.len() / 3).filter(|&i| counts(i)).map(|i| (rendered[i * 3 + c], image[i * 3 + c]));
        let middle = median(&mut seen().map(|(_, y)| y).collect::<Vec<_>>());
        let gain = fit.gain[c].max(0.0);
        left += seen().map(|(x, y)| capped(y - gain * x - fit.offset[c])).sum::<f32>();
        all += seen().map(|(_, y)| capped(y - middle)).sum::<f32>();
        least += capped(LEAST_NOISE) * seen().count() as f32;
    }
    match least {
        0.0 => 1.0,
        // A view without variation shows no place.
        least if all < least => 0.0,
        _ => 1.0 - left / all,
    }
}

/// Slope and offset of the line of least squares; `None` for too few points or equal ones.
fn line(pairs: impl Iterator<Item = (f32, f32)>) -> Option<(f32, f32)> {
    let [mut n, mut sx, mut sy, mut sxx, mut sxy] = [0.0_f64; 5];
    for (x, y) in pairs {
        let (x, y) = (f64::from(x), f64::from(y));
        n += 1.0;
        sx += x;
        sy += y;
        sxx += x * x;
        sxy += x * y;
    }
    let spread = n * sxx - sx * sx;
    if n < FEWEST || spread <= 1e-6 {
        return None;
    }
    let slope = (n * sxy - sx * sy) / spread;
    Some((slope as f32, ((sy - slope * sx) / n) as f32))
}

/// Pixels of a 3 x 3 neighbourhood that were compared.
fn neighbours(i: usize, judged: &[bool], width: usize) -> impl Iterator<Item = usize> {
    let height = judged.len() / width.max(1);
    let around = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
    let (columns, rows) = (around(i % width, width), around(i / width, height));
    let all = rows.flat_map(move |y| columns.clone().map(move |x| y * width + x));
    all.filter(|&n| judged[n])
}

/// Squared distance of each pixel from the range of its neighbours' rendered values, summed over the channels. The
/// range forgives what a blurred edge, or a pose that is off by half a pixel, changes.
fn energy(image: &[f32], rendered: &[f32], fit: &Fit, judged: &[bool], width: usize) -> Vec<f32> {
    let of_channel = |i: usize, c: usize| {
        let expected = neighbours(i, judged, width).map(|n| fit.gain[c] * rendered[n * 3 + c] + fit.offset[c]);
        let (low, high) = expected.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let seen = image[i * 3 + c];
        (seen - high).max(low - seen).max(0.0).powi(2)
    };
    (0..judged.len()).map(|i| if judged[i] { (0..3).map(|c| of_channel(i, c)).sum() } else { 0.0 }).collect()
}

/// Root mean square over 3 x 3 pixels and channels, in deviations.
fn smoothed(energy: &[f32], judged: &[bool], width: usize, noise: f32) -> Vec<f32> {
    let of_pixel = |i: usize| {
        let (sum, n) = neighbours(i, judged, width).fold((0.0, 0), |(sum, n), at| (sum + energy[at], n + 3));
        (sum / n.max(1) as f32).sqrt() / noise
    };
    (0..judged.len()).map(|i| if judged[i] { of_pixel(i) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    /// Gain and offset are found with a ninth of the pixels covered by something else.
    #[test]
    fn the_fit_is_robust() {
        let rendered: Vec<f32> = (0..900).map(|i| 0.1 + 0.8 * ((i * 37 % 100) as f32) / 100.0).collect();
        let image: Vec<f32> =
            rendered.iter().enumerate().map(|(i, v)| if i / 3 % 9 < 1 { 0.95 } else { 0.6 * v + 0.2 }).collect();
        let fit = fit(&image, &rendered, |_| true);
        for c in 0..3 {
            assert!((fit.gain[c] - 0.6).abs() < 0.05 && (fit.offset[c] - 0.2).abs() < 0.05, "{fit:?}");
        }
    }

    /// A view of this place is explained in any exposure and with a ninth of it covered; another image, a negative and a
    /// uniform one are not.
    #[test]
    fn places_explain_their_views() {
        let rendered: Vec<f32> = (0..900).map(|i| 0.1 + 0.8 * ((i / 3 * 37 % 100) as f32) / 100.0).collect();
        let explained = |of: &dyn Fn(usize, f32) -> f32| {
            let image: Vec<f32> = rendered.iter().enumerate().map(|(i, v)| of(i, *v)).collect();
            explained(&image, &rendered, |_| true)
        };
        assert!(explained(&|_, v| 0.6 * v + 0.2) > 0.99);
        assert!(explained(&|i, v| if i / 3 % 9 < 1 { 0.95 } else { v }) > 0.7);
        for share in [
            explained(&|i, _| (i / 3 * 61 % 83) as f32 / 83.0),
            explained(&|_, v| 1.0 - v),
            explained(&|i, _| 0.5 + 0.001 * (i / 3 % 2) as f32),
        ] {
            assert!(share < 0.2, "{share}");
        }
    }

    /// A patch that the rendered image does not have is the only residual; a shift by one pixel leaves none.
    #[test]
    fn residuals_are_where_something_is() {
        let width = 32;
        let rendered: Vec<f32> = (0..width * width * 3).map(|i| if i / 3 % width < 16 { 0.2 } else { 0.7 }).collect();
        let seen: Vec<f32> = (0..width * width * 3)
            .map(|i| {
                let (x, y) = (i / 3 % width, i / 3 / width);
                if (4..9).contains(&x) && (20..25).contains(&y) {
                    0.9
                } else if x < 17 {
                    0.2
                } else {
                    0.7
                }
            })
            .collect();
        let fit = Fit { gain: [1.0; 3], offset: [0.0; 3], noise: LEAST_NOISE, explained: 1.0 };
        let judged = vec![true; width * width];
        let out = smoothed(&energy(&seen, &rendered, &fit, &judged, width), &judged, width, fit.noise);
        assert!(out[22 * width + 6] > 20.0);
        let elsewhere =
            (0..width * width).filter(|i| !(2..11).contains(&(i % width)) || !(18..27).contains(&(i / width)));
        assert!(elsewhere.map(|i| out[i]).fold(0.0, f32::max) < 1e-3);
    }

    /// Cells are means; images smaller than the grid repeat their pixels.
    #[test]
    fn reduction_averages() {
        let image = Array3::from_shape_fn((4, 6, 3), |(y, x, c)| if c == 1 { (y * 6 + x) as u8 } else { 51 });
        let out = reduced(image.view(), 3, 2);
        assert_eq!((out[0], out[1]), (0.2, (0.0 + 1.0 + 6.0 + 7.0) / 4.0 / 255.0));
        assert_eq!(reduced(image.view(), 12, 8).len(), 12 * 8 * 3);
        assert_eq!(grown(&[false, true, false, false], 2, 1), [true; 4]);
    }
}
