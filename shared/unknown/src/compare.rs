//! Render and compare: every known state is rendered from the camera's own pose and compared with the image.

use carff_base::geometry::PinholeCamera;
use carff_field::{Field, HypothesisBuffer, RenderOptions};
use carff_messages::LATENT_DIM;
use ndarray::ArrayView3;

/// Longest side of the compared images, pixels.
const SIDE_PX: u32 = 64;
/// Passes of the robust fit of gain and offset.
const PASSES: usize = 5;
/// Pixels beyond this many robust deviations do not count in the fit.
const TRIM: f32 = 2.5;
/// Smallest deviation of a pixel, of 1: the field's own error.
const LEAST_SIGMA: f32 = 0.015;

/// Gain and offset of a camera against the field, by channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    pub gain: [f32; 3],
    pub offset: [f32; 3],
    /// Robust deviation of a pixel.
    pub sigma: f32,
}

/// What an image shows beside each known state.
#[derive(Clone, Debug)]
pub struct Comparison {
    pub camera: PinholeCamera,
    pub fit: Fit,
    /// The image at the compared size, 0..=1.
    pub image: Vec<f32>,
    /// For each state, the residual of each pixel in deviations.
    pub residuals: Vec<Vec<f32>>,
    /// For each state, the depth of each pixel.
    pub depth_m: Vec<Vec<f32>>,
    pub rendered: Vec<Vec<f32>>,
}

/// Renders states and compares.
#[derive(Debug, Default)]
pub struct Comparer {
    buffer: HypothesisBuffer,
}

impl Comparer {
    /// Compares an image (height, width, channel) with each state.
    pub fn compare(
        &mut self,
        field: &Field,
        states: &[[f32; LATENT_DIM]],
        camera: &PinholeCamera,
        image: ArrayView3<'_, u8>,
        threads: usize,
    ) -> Comparison {
        let longest = camera.width_px.max(camera.height_px);
        let scaled = |side: u32| ((u64::from(side) * u64::from(SIDE_PX) / u64::from(longest)) as u32).max(1);
        let small = camera.resized(scaled(camera.width_px), scaled(camera.height_px));
        let (w, h) = (small.width_px as usize, small.height_px as usize);
        let pixels = reduced(image, w, h);
        let options = RenderOptions { threads, ..RenderOptions::default() };
        field.render_hypotheses(&small, states, &options, &mut self.buffer);
        let pictures = &self.buffer.pictures;
        let first = &pictures[0];
        let still: Vec<bool> = first.changing.iter().map(|c| !c).collect();
        let fit = fit(&pixels, &first.rgb, &still);
        let residuals = pictures.iter().map(|p| residual(&pixels, &p.rgb, &fit, w, h)).collect();
        Comparison {
            camera: small,
            fit,
            residuals,
            depth_m: pictures.iter().map(|p| p.depth_m.clone()).collect(),
            rendered: pictures.iter().map(|p| p.rgb.clone()).collect(),
            image: pixels,
        }
    }
}

/// Means over the cells of a w x h grid.
fn reduced(image: ArrayView3<'_, u8>, w: usize, h: usize) -> Vec<f32> {
    let (height, width, _) = image.dim();
    let mut out = vec![0.0; w * h * 3];
    for y in 0..h {
        let (top, bottom) = (y * height / h, ((y + 1) * height / h).max(y * height / h + 1));
        for x in 0..w {
            let (left, right) = (x * width / w, ((x + 1) * width / w).max(x * width / w + 1));
            let cell = image.slice(ndarray::s![top..bottom.min(height), left..right.min(width), ..]);
            let n = (cell.len() / 3).max(1) as f32 * 255.0;
            for c in 0..3 {
                out[(y * w + x) * 3 + c] = cell.slice(ndarray::s![.., .., c]).iter().map(|&v| f32::from(v)).sum::<f32>() / n;
            }
        }
    }
    out
}

fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let mid = values.len() / 2;
    *values.select_nth_unstable_by(mid, f32::total_cmp).1
}

fn fit(image: &[f32], rendered: &[f32], counts: &[bool]) -> Fit {
    let (mut gain, mut offset, mut sigmas) = ([1.0; 3], [0.0; 3], [0.0; 3]);
    for c in 0..3 {
        let pairs: Vec<(f32, f32)> = counts
            .iter()
            .enumerate()
            .filter(|(_, k)| **k)
            .map(|(i, _)| (rendered[i * 3 + c], image[i * 3 + c]))
            .collect();
        let mut limit = f32::INFINITY;
        for _ in 0..PASSES {
            let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
            for &(x, y) in pairs.iter().filter(|(x, y)| (y - gain[c] * x - offset[c]).abs() <= limit) {
                let (x, y) = (f64::from(x), f64::from(y));
                n += 1.0;
                sx += x;
                sy += y;
                sxx += x * x;
                sxy += x * y;
            }
            let spread = n * sxx - sx * sx;
            if n < 16.0 || spread <= 1e-9 {
                break;
            }
            gain[c] = ((n * sxy - sx * sy) / spread) as f32;
            offset[c] = ((sy - f64::from(gain[c]) * sx) / n) as f32;
            let mut errors: Vec<f32> = pairs.iter().map(|(x, y)| (y - gain[c] * x - offset[c]).abs()).collect();
            sigmas[c] = 1.4826 * median(&mut errors);
            limit = (TRIM * sigmas[c]).max(LEAST_SIGMA);
        }
    }
    let sigma = (sigmas.iter().map(|s| s * s).sum::<f32>() / 3.0).sqrt().max(LEAST_SIGMA);
    Fit { gain, offset, sigma }
}

/// Distance of each pixel from the range of its neighbours' rendered values, smoothed, in deviations.
fn residual(image: &[f32], rendered: &[f32], fit: &Fit, w: usize, h: usize) -> Vec<f32> {
    let expected: Vec<f32> = rendered.iter().enumerate().map(|(i, v)| fit.gain[i % 3] * v + fit.offset[i % 3]).collect();
    let around = |v: usize, n: usize| v.saturating_sub(1)..=(v + 1).min(n - 1);
    let mut energy = vec![0.0; w * h];
    for y in 0..h {
        for x in 0..w {
            for c in 0..3 {
                let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
                for ny in around(y, h) {
                    for nx in around(x, w) {
                        let v = expected[(ny * w + nx) * 3 + c];
                        (low, high) = (low.min(v), high.max(v));
                    }
                }
                let v = image[(y * w + x) * 3 + c];
                let d = (v - high).max(low - v).max(0.0);
                energy[y * w + x] += d * d;
            }
        }
    }
    let mut out = vec![0.0; w * h];
    for y in 0..h {
        for x in 0..w {
            let (mut sum, mut n) = (0.0, 0.0);
            for ny in around(y, h) {
                for nx in around(x, w) {
                    sum += energy[ny * w + nx];
                    n += 3.0;
                }
            }
            out[y * w + x] = (sum / n).sqrt() / fit.sigma;
        }
    }
    out
}
