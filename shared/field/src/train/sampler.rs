//! Batches of rays drawn from posed images of several states, with more rays through pixels that differ among states.

use carff_base::geometry::PinholeCamera;

use super::batch::RayBatch;
use crate::config::LATENT_DIM;
use crate::kernels::math::hash;

/// Rays of a batch that come from one image and share its latent.
pub const RAYS_PER_GROUP: usize = 32;

/// The places at which an image's pixels are seen, against the pixels of its camera: for each axis (right, down) the shift,
/// and its change along both axes from the middle of the image to the end of its longer side, as shares of the longer
/// side. All zeros for an exact pose.
pub type Displacement = [[f32; 3]; 2];

/// Difference between an image and what its camera sees at the recorded pose. The default is an exact image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correction {
    /// Displacement of the pixels, by the error of the camera's pose.
    pub displacement: Displacement,
    /// Brightness of each colour channel relative to the other images: exposure and white balance.
    pub gain: [f32; 3],
}

impl Correction {
    /// Count of the numbers of a correction.
    pub const LEN: usize = 9;

    /// Returns the numbers: both axes of the displacement, then the gains.
    pub fn to_array(self) -> [f32; Self::LEN] {
        let ([[u, du_x, du_y], [v, dv_x, dv_y]], [red, green, blue]) = (self.displacement, self.gain);
        [u, du_x, du_y, v, dv_x, dv_y, red, green, blue]
    }
}

impl From<[f32; Correction::LEN]> for Correction {
    fn from([u, du_x, du_y, v, dv_x, dv_y, red, green, blue]: [f32; Correction::LEN]) -> Self {
        Self { displacement: [[u, du_x, du_y], [v, dv_x, dv_y]], gain: [red, green, blue] }
    }
}

impl Default for Correction {
    fn default() -> Self {
        Self { displacement: [[0.0; 3]; 2], gain: [1.0; 3] }
    }
}

/// One posed image.
#[derive(Clone, Debug)]
pub struct TrainingView {
    /// The camera that took the image.
    pub camera: PinholeCamera,
    /// RGB, row by row, 8 bit, width x height x 3.
    pub rgb: Vec<u8>,
    /// Pixels (y * width + x) that differ among states ([`changed_pixels`]); may be empty.
    pub changed: Vec<u32>,
    /// Pixels that rays are drawn from; empty: all.
    pub valid: Vec<u32>,
    /// Difference between the image and what the camera sees.
    pub correction: Correction,
}

impl TrainingView {
    /// Position of a pixel's centre in the camera's image, pixels.
    fn in_camera(&self, x: u64, y: u64) -> [f64; 2] {
        let (width, height) = (f64::from(self.camera.width_px), f64::from(self.camera.height_px));
        let (longer, seen) = (width.max(height), [x as f64 + 0.5, y as f64 + 0.5]);
        let terms = [longer, 2.0 * seen[0] - width, 2.0 * seen[1] - height];
        let by = self
            .correction
            .displacement
            .map(|axis| axis.iter().zip(terms).map(|(a, b)| f64::from(*a) * b).sum::<f64>());
        [seen[0] - by[0], seen[1] - by[1]]
    }

    /// Colour of a pixel without the image's gains, 0..=1.
    fn colour(&self, pixel: u64) -> [f32; 3] {
        let rgb = &self.rgb[pixel as usize * 3..][..3];
        [0, 1, 2].map(|c| (f32::from(rgb[c]) / 255.0 / self.correction.gain[c]).min(1.0))
    }
}

/// Returns the pixels that differ by more than `threshold` (0..=255) in any channel between any two images: RGB of equal
/// size, one for each state of one view.
///
/// ```
/// let (black, red) = ([0; 6], [0, 0, 0, 255, 0, 0]);
/// assert_eq!(carff_field::changed_pixels(&[&black, &red], 12), [1]);
/// ```
pub fn changed_pixels(images: &[&[u8]], threshold: u8) -> Vec<u32> {
    let pixels = images.iter().map(|p| p.len() / 3).min().unwrap_or(0);
    (0..pixels)
        .filter(|i| {
            (0..3).any(|c| {
                let values = images.iter().map(|p| p[i * 3 + c]);
                let (low, high) = values.fold((u8::MAX, 0), |(l, h), v| (l.min(v), h.max(v)));
                high.saturating_sub(low) > threshold
            })
        })
        .map(|i| i as u32)
        .collect()
}

/// Draws batches: groups of rays, each group from one image. Draw number n only depends on the seed and n.
///
/// ```
/// use carff_field::{Correction, RAYS_PER_GROUP, RayBatch, RaySampler, TrainingView};
/// use carff_base::geometry::PinholeCamera;
/// let camera = PinholeCamera::look_at([0.0, -5.0, 1.0], [0.0; 3], [0.0, 0.0, 1.0], 4, 4, 60.0);
/// let (rgb, correction) = (vec![255; 4 * 4 * 3], Correction::default());
/// let view = TrainingView { camera, rgb, changed: Vec::new(), valid: Vec::new(), correction };
/// let mut sampler = RaySampler::new(vec![view], 0.5, 1);
/// let mut batch = RayBatch::default();
/// sampler.next_batch(2 * RAYS_PER_GROUP, &mut batch, |_view, _draw| [0.0; 8]);
/// assert_eq!((batch.rays.len(), batch.latents.len()), (2 * RAYS_PER_GROUP, 2));
/// ```
#[derive(Clone, Debug)]
pub struct RaySampler {
    views: Vec<TrainingView>,
    changed_share: f32,
    seed: u64,
    drawn: u64,
}

impl RaySampler {
    /// Makes a sampler over `views`. A share `changed_share` (0..=1) of each group's rays goes through changed pixels where
    /// there are any. Views whose image does not fit their camera are left out.
    pub fn new(views: Vec<TrainingView>, changed_share: f32, seed: u64) -> Self {
        let mut views = views;
        views.retain(|v| {
            let pixels = v.camera.width_px as usize * v.camera.height_px as usize;
            pixels > 0 && v.rgb.len() == pixels * 3 && v.changed.iter().chain(&v.valid).all(|p| (*p as usize) < pixels)
        });
        Self { views, changed_share: changed_share.clamp(0.0, 1.0), seed, drawn: 0 }
    }

    /// Returns the views in use.
    pub fn views(&self) -> &[TrainingView] {
        &self.views
    }

    /// Sets the correction of a view's image.
    pub fn correct(&mut self, view: usize, correction: Correction) {
        if let Some(view) = self.views.get_mut(view) {
            view.correction = correction;
        }
    }

    /// Sets the number of batches drawn so far, to continue a resumed training.
    pub fn set_drawn(&mut self, drawn: u64) {
        self.drawn = drawn;
    }

    /// Returns the number of batches drawn so far.
    pub fn drawn(&self) -> u64 {
        self.drawn
    }

    /// Fills `batch` with `rays` rays (rounded up to whole groups). `latent_of(view index, draw)` returns the latent of a
    /// group; `draw` is a different number for each group, which may seed noise.
    pub fn next_batch(
        &mut self,
        rays: usize,
        batch: &mut RayBatch,
        mut latent_of: impl FnMut(usize, u64) -> [f32; LATENT_DIM],
    ) {
        batch.rays.clear();
        batch.target_rgb.clear();
        batch.latent_index.clear();
        batch.latents.clear();
        if self.views.is_empty() {
            return;
        }
        let from_changed = (RAYS_PER_GROUP as f32 * self.changed_share).round() as usize;
        for group in 0..rays.div_ceil(RAYS_PER_GROUP) {
            let draw = hash(self.seed, self.drawn, group as u64);
            let at = (hash(draw, 0, 0) % self.views.len() as u64) as usize;
            let view = &self.views[at];
            let (width, height) = (u64::from(view.camera.width_px), u64::from(view.camera.height_px));
            batch.latents.push(latent_of(at, draw));
            for i in 0..RAYS_PER_GROUP {
                let r = hash(draw, 1, i as u64);
                let one_of = |pixels: &[u32]| u64::from(pixels[(r % pixels.len() as u64) as usize]);
                let pixel = if i < from_changed && !view.changed.is_empty() {
                    one_of(&view.changed)
                } else if view.valid.is_empty() {
                    r % (width * height)
                } else {
                    one_of(&view.valid)
                };
                let (x, y) = (pixel % width, pixel / width);
                let [u, v] = view.in_camera(x, y);
                batch.rays.push(view.camera.ray(u, v));
                batch.target_rgb.push(view.colour(pixel));
                batch.latent_index.push(group as u32);
            }
        }
        self.drawn += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pixel that is seen displaced has the ray of the camera's pixel that it shows; a turn moves opposite edges apart.
    #[test]
    fn displaced_pixels_have_other_rays() {
        let camera = PinholeCamera::look_at([0.0, -5.0, 1.0], [0.0; 3], [0.0, 0.0, 1.0], 8, 4, 60.0);
        let of = |displacement| TrainingView {
            camera,
            rgb: vec![0; 96],
            changed: Vec::new(),
            valid: Vec::new(),
            correction: Correction { displacement, ..Correction::default() },
        };
        assert_eq!(of([[0.0; 3]; 2]).in_camera(3, 2), [3.5, 2.5]);
        assert_eq!(of([[0.25, 0.0, 0.0], [-0.125, 0.0, 0.0]]).in_camera(3, 2), [1.5, 3.5]);
        let turned = of([[0.0, 0.0, 0.5], [0.0, -0.25, 0.0]]);
        assert_eq!(turned.in_camera(0, 0), [0.5 + 0.5 * 3.0, 0.5 - 0.25 * 7.0]);
        assert_eq!(turned.in_camera(7, 3), [7.5 - 0.5 * 3.0, 3.5 + 0.25 * 7.0]);
    }

    /// Colours are those at the gains of the other images, and never beyond white.
    #[test]
    fn gains_are_taken_out() {
        let camera = PinholeCamera::look_at([0.0, -5.0, 1.0], [0.0; 3], [0.0, 0.0, 1.0], 1, 1, 60.0);
        let correction = Correction { gain: [0.5, 1.0, 2.0], ..Correction::default() };
        let (rgb, changed, valid) = (vec![51, 51, 51, 204, 204, 204], Vec::new(), Vec::new());
        let view = TrainingView { camera, rgb, changed, valid, correction };
        assert_eq!(view.colour(0), [0.4, 0.2, 0.1]);
        assert_eq!(view.colour(1), [1.0, 0.8, 0.4]);
        assert_eq!(Correction::from(correction.to_array()), correction);
    }

    /// Rays go through valid pixels only; with all pixels, the draws are those of a view without a list.
    #[test]
    fn rays_go_through_valid_pixels() {
        let camera = PinholeCamera::look_at([0.0, -5.0, 1.0], [0.0; 3], [0.0, 0.0, 1.0], 8, 8, 60.0);
        let rgb: Vec<u8> = (0..64).flat_map(|i| [i; 3]).collect();
        let drawn = |changed: Vec<u32>, valid: Vec<u32>| {
            let view = TrainingView { camera, rgb: rgb.clone(), changed, valid, correction: Correction::default() };
            let mut batch = RayBatch::default();
            RaySampler::new(vec![view], 0.5, 1).next_batch(16 * RAYS_PER_GROUP, &mut batch, |_, _| [0.0; 8]);
            batch.target_rgb.iter().map(|rgb| (rgb[0] * 255.0).round() as u32).collect::<Vec<_>>()
        };
        let valid: Vec<u32> = (0..64).filter(|i| i % 8 > 2).collect();
        let pixels = drawn(vec![5, 60], valid.clone());
        assert!(pixels.iter().all(|p| valid.contains(p)) && valid.iter().all(|p| pixels.contains(p)));
        assert_eq!(drawn(vec![5], (0..64).collect()), drawn(vec![5], Vec::new()));
    }
}
