//! Alignment of a camera's images with the field that learns from them: recorded poses have small errors, and exposure and
//! white balance vary.

use carff_dataset::Image;
use carff_field::{Correction, Field, HypothesisBuffer, RenderOptions, TrainingView};
use carff_messages::LATENT_DIM;
use carff_unknown::{displacement, reduced};

/// Shares of a field's training after which its images are aligned.
const AFTER: [f64; 3] = [0.25, 0.4, 0.6];

/// Longest side of the compared images, pixels.
const SIDE_PX: u32 = 64;

/// Returns true if images are aligned after `done` of `total` steps.
pub fn is_due(done: usize, total: usize) -> bool {
    AFTER.iter().any(|share| (share * total as f64) as usize == done && done > 0)
}

/// Darkest rendered value that shows a gain, and the brightest seen one: above it a sensor saturates.
const DARKEST: f32 = 0.08;
const BRIGHTEST: f32 = 0.95;

/// Least count of pixels that show a gain.
const LEAST_PX: usize = 100;

/// Returns the correction of the image of a view against the field under a latent. What does not fit stays as it was.
pub fn against(
    field: &Field,
    view: &TrainingView,
    image: &Image,
    latent: [f32; LATENT_DIM],
    options: &RenderOptions,
    buffer: &mut HypothesisBuffer,
) -> Correction {
    let (width, height) = (view.camera.width_px, view.camera.height_px);
    let longer = width.max(height).max(1);
    let scaled = |side: u32| (side * SIDE_PX.min(longer) / longer).max(1);
    let (columns, rows) = (scaled(width), scaled(height));
    field.render_hypotheses(&view.camera.resized(columns, rows), &[latent], options, buffer);
    let (Some(rendered), Some(seen)) = (buffer.images.first(), image.view()) else { return view.correction };
    let mut is_valid = vec![view.valid.is_empty(); view.rgb.len() / 3];
    view.valid.iter().for_each(|&pixel| is_valid[pixel as usize] = true);
    let middle = |i: u32, n: u32, all: u32| (2 * i + 1) * all / (2 * n);
    let counts = |i: usize| {
        let (x, y) = (middle(i as u32 % columns, columns, width), middle(i as u32 / columns, rows, height));
        is_valid[(y * width + x) as usize]
    };
    let (columns, rows) = (columns as usize, rows as usize);
    let gain = gains(&reduced(seen, columns, rows), &rendered.rgb, counts);
    let displacement = displacement(seen, &rendered.rgb, columns, rows, counts);
    Correction {
        displacement: displacement.unwrap_or(view.correction.displacement),
        gain: gain.unwrap_or(view.correction.gain),
    }
}

/// Gain of each channel: the median ratio of seen to rendered values (RGB, 0..=1, row by row), which neither a pose's
/// error nor a few objects at other places change. `None` if too few pixels show it.
fn gains(seen: &[f32], rendered: &[f32], counts: impl Fn(usize) -> bool) -> Option<[f32; 3]> {
    let mut gain = [1.0; 3];
    for (channel, gain) in gain.iter_mut().enumerate() {
        let pixels = (0..rendered.len() / 3).filter(|&i| counts(i)).map(|i| 3 * i + channel);
        let shows = |&i: &usize| rendered[i] >= DARKEST && seen[i] <= BRIGHTEST;
        let mut ratios: Vec<f32> = pixels.filter(shows).map(|i| seen[i] / rendered[i]).collect();
        if ratios.len() < LEAST_PX {
            return None;
        }
        let middle = ratios.len() / 2;
        *gain = *ratios.select_nth_unstable_by(middle, f32::total_cmp).1;
    }
    gain.iter().all(|gain| (0.25..=4.0).contains(gain)).then_some(gain)
}

/// Divides the gains by their means, so that the field's brightness is that of the images.
pub fn balance(corrections: &mut [Correction]) {
    for channel in 0..3 {
        let mean = corrections.iter().map(|c| c.gain[channel]).sum::<f32>() / corrections.len().max(1) as f32;
        for correction in corrections.iter_mut() {
            correction.gain[channel] /= mean;
        }
    }
}
