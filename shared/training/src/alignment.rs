//! Alignment of a camera's images with the field that learns from them: the recorded poses have small errors.

use carff_dataset::Image;
use carff_field::{Displacement, Field, HypothesisBuffer, RenderOptions, TrainingView};
use carff_messages::LATENT_DIM;
use carff_unknown::displacement;

/// Shares of a field's training after which its images are aligned.
const AFTER: [f64; 3] = [0.25, 0.4, 0.6];

/// Longest side of the compared images, pixels.
const SIDE_PX: u32 = 64;

/// Returns true if images are aligned after `done` of `total` steps.
pub fn is_due(done: usize, total: usize) -> bool {
    AFTER.iter().any(|share| (share * total as f64) as usize == done && done > 0)
}

/// Returns the displacement of the image of a view against the field under a latent; `None` if none fits.
pub fn against(
    field: &Field,
    view: &TrainingView,
    image: &Image,
    latent: [f32; LATENT_DIM],
    options: &RenderOptions,
    buffer: &mut HypothesisBuffer,
) -> Option<Displacement> {
    let (width, height) = (view.camera.width_px, view.camera.height_px);
    let longer = width.max(height).max(1);
    let scaled = |side: u32| (side * SIDE_PX.min(longer) / longer).max(1);
    let (columns, rows) = (scaled(width), scaled(height));
    field.render_hypotheses(&view.camera.resized(columns, rows), &[latent], options, buffer);
    let rendered = buffer.images.first()?;
    let mut is_valid = vec![view.valid.is_empty(); view.rgb.len() / 3];
    view.valid.iter().for_each(|&pixel| is_valid[pixel as usize] = true);
    let middle = |i: u32, n: u32, all: u32| (2 * i + 1) * all / (2 * n);
    let counts = |i: usize| {
        let (x, y) = (middle(i as u32 % columns, columns, width), middle(i as u32 / columns, rows, height));
        is_valid[(y * width + x) as usize]
    };
    displacement(image.view()?, &rendered.rgb, columns as usize, rows as usize, counts)
}
