//! Images of the field, and the measures that compare them with true images.

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Image, PIXEL_TOLERANCE};
use carff_field::{Field, RenderBuffer, RenderOptions, to_bytes};
use carff_messages::LATENT_DIM;

/// Smallest difference of a channel in 0..=1 above which a pixel counts as changed.
pub const CHANGED: f32 = PIXEL_TOLERANCE as f32 / 255.0;

/// Renders a field with buffers that are reused from image to image.
pub struct FieldRenderer {
    options: RenderOptions,
    buffer: RenderBuffer,
}

impl FieldRenderer {
    /// A renderer on `threads` threads.
    pub fn new(threads: usize) -> Self {
        let options = RenderOptions { threads: threads.max(1), ..RenderOptions::default() };
        Self { options, buffer: RenderBuffer::new() }
    }

    /// RGB values of an image, in 0..=1 up to rounding.
    pub fn values(&mut self, field: &Field, camera: &PinholeCamera, latent: &[f32; LATENT_DIM]) -> &[f32] {
        field.render(camera, latent, &self.options, &mut self.buffer);
        &self.buffer.rgb
    }

    /// An image, rounded to bytes.
    pub fn image(&mut self, field: &Field, camera: &PinholeCamera, latent: &[f32; LATENT_DIM]) -> Image {
        let rgb = to_bytes(self.values(field, camera, latent));
        Image { width_px: camera.width_px, height_px: camera.height_px, rgb }
    }
}

/// Values in 0..=1 of an image's bytes.
pub fn to_unit(bytes: &[u8]) -> Vec<f32> {
    bytes.iter().map(|&b| f32::from(b) / 255.0).collect()
}

/// Mean of images in 0..=1; `None` for no images, or for images of different sizes.
pub fn mean_image(images: &[Vec<f32>]) -> Option<Vec<f32>> {
    let first = images.first()?;
    let n = images.len() as f32;
    let sum = |i: usize| images.iter().map(|image| image[i]).sum::<f32>();
    images.iter().all(|image| image.len() == first.len()).then(|| (0..first.len()).map(|i| sum(i) / n).collect())
}

/// PSNR in dB over the pixels of `truth` that differ from `mean` by more than [`CHANGED`]; `None` where none does.
pub fn psnr_of_changed(image: &[f32], truth: &[f32], mean: &[f32]) -> Option<f64> {
    carff_base::statistics::psnr_where(image, truth, |i| {
        let pixel = i / 3 * 3;
        (pixel..pixel + 3).any(|j| (mean[j] - truth[j]).abs() > CHANGED)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The mean of images is taken pixel by pixel; images of different sizes have none.
    #[test]
    fn mean_of_images() {
        assert_eq!(mean_image(&[vec![0.0, 1.0], vec![1.0, 1.0]]), Some(vec![0.5, 1.0]));
        assert_eq!(mean_image(&[vec![0.0, 1.0], vec![1.0]]), None);
        assert_eq!(mean_image(&[]), None);
    }
}
