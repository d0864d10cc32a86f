//! Rendered images, and what rendering reuses from image to image.

use carff_base::geometry::Ray;

use crate::pool::Pool;

/// A rendered image. Rendering reuses its memory and its threads.
///
/// ```
/// use carff_field::{Field, FieldConfig, RenderBuffer, RenderOptions};
/// use carff_base::geometry::PinholeCamera;
/// let config = FieldConfig { log2_table_size: 10, occupancy_resolution: 16, ..FieldConfig::default() };
/// let field = Field::new(config, 7)?;
/// let camera = PinholeCamera::look_at([0.0, -20.0, 9.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 16, 12, 60.0);
/// let mut image = RenderBuffer::new();
/// field.render(&camera, &[0.0; 8], &RenderOptions::default(), &mut image);
/// assert_eq!((image.rgb.len(), image.depth_m.len()), (16 * 12 * 3, 16 * 12));
/// # Ok::<(), carff_field::FieldError>(())
/// ```
#[derive(Debug, Default)]
pub struct RenderBuffer {
    /// Colours, row by row, RGB, 0..=1.
    pub rgb: Vec<f32>,
    /// Expected distance along the ray, metres, over the light that is stopped; 0 where none is.
    pub depth_m: Vec<f32>,
    /// Share of the light that is stopped, 0..=1.
    pub opacity: Vec<f32>,
    /// True where the ray meets a cell in which the states differ.
    pub changing: Vec<bool>,
    /// The image's rays, tile by tile.
    pub(super) rays: Vec<Ray>,
    /// The pixel of each ray.
    pub(super) pixels: Vec<u32>,
    pub(super) by_ray: RayPixels,
    pub(super) pool: Pool,
}

/// Rounds a value in 0..=1 to a byte; a value outside is clamped.
pub fn to_byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// Rounds values in 0..=1 to bytes; values outside are clamped.
pub fn to_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().map(|&value| to_byte(value)).collect()
}

/// Images of one camera under several latents. Rendering reuses their memory and threads.
#[derive(Debug, Default)]
pub struct HypothesisBuffer {
    /// One image for each latent.
    pub images: Vec<RenderBuffer>,
    /// Rays that meet a cell in which the states differ, by index in the first image's rays.
    pub(super) changing: Vec<u32>,
    pub(super) rays: Vec<Ray>,
    /// Results of these rays under each latent but the first.
    pub(super) by_ray: RayPixels,
    pub(super) pool: Pool,
}

/// Results of rays under one or several latents: chunk by chunk, in each chunk latent by latent.
#[derive(Debug, Default)]
pub(super) struct RayPixels {
    pub rgb: Vec<f32>,
    pub depth_m: Vec<f32>,
    pub opacity: Vec<f32>,
    pub changing: Vec<bool>,
}

/// A view of the results of some rays.
pub(super) struct PixelsMut<'a> {
    pub rgb: &'a mut [f32],
    pub depth_m: &'a mut [f32],
    pub opacity: &'a mut [f32],
    pub changing: &'a mut [bool],
}

impl RenderBuffer {
    /// Makes an empty buffer.
    pub fn new() -> Self {
        Self::default()
    }

    pub(super) fn resize(&mut self, pixels: usize) {
        self.rgb.resize(pixels * 3, 0.0);
        self.depth_m.resize(pixels, 0.0);
        self.opacity.resize(pixels, 0.0);
        self.changing.resize(pixels, false);
    }

    /// Clears all pixels, unless each of them has a ray.
    pub(super) fn blank(&mut self, rays: usize) {
        if rays < self.depth_m.len() {
            self.rgb.fill(0.0);
            self.depth_m.fill(0.0);
            self.opacity.fill(0.0);
            self.changing.fill(false);
        }
    }

    /// Copies a ray's results to a pixel.
    pub(super) fn set(&mut self, pixel: usize, from: &RayPixels, ray: usize) {
        self.rgb[pixel * 3..pixel * 3 + 3].copy_from_slice(&from.rgb[ray * 3..ray * 3 + 3]);
        self.depth_m[pixel] = from.depth_m[ray];
        self.opacity[pixel] = from.opacity[ray];
        self.changing[pixel] = from.changing[ray];
    }

    /// Copies the pixels of another image.
    pub(super) fn copy_pixels(&mut self, from: &Self) {
        self.rgb.clone_from(&from.rgb);
        self.depth_m.clone_from(&from.depth_m);
        self.opacity.clone_from(&from.opacity);
        self.changing.clone_from(&from.changing);
    }
}

impl RayPixels {
    /// Sets the number of results and returns a view of them.
    pub fn resize(&mut self, count: usize) -> PixelsMut<'_> {
        self.rgb.resize(count * 3, 0.0);
        self.depth_m.resize(count, 0.0);
        self.opacity.resize(count, 0.0);
        self.changing.resize(count, false);
        PixelsMut {
            rgb: &mut self.rgb,
            depth_m: &mut self.depth_m,
            opacity: &mut self.opacity,
            changing: &mut self.changing,
        }
    }
}

impl<'a> PixelsMut<'a> {
    /// The same view for a shorter time.
    pub fn reborrow(&mut self) -> PixelsMut<'_> {
        PixelsMut { rgb: self.rgb, depth_m: self.depth_m, opacity: self.opacity, changing: self.changing }
    }

    /// Views of up to `size` results at a time.
    pub fn chunks(self, size: usize) -> impl Iterator<Item = PixelsMut<'a>> {
        let Self { rgb, depth_m, opacity, changing } = self;
        rgb.chunks_mut(size * 3)
            .zip(depth_m.chunks_mut(size))
            .zip(opacity.chunks_mut(size))
            .zip(changing.chunks_mut(size))
            .map(|(((rgb, depth_m), opacity), changing)| PixelsMut { rgb, depth_m, opacity, changing })
    }
}
