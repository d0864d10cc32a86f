//! Augmentation of the encoder's training images.

use carff_base::random::Key;
use carff_dataset::sensor::{SensorNoise, apply_noise_into};
use carff_evaluation::PosedImages;
use carff_networks::encoder::pictures_from_bytes;
use rand::Rng;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::Tensor;

/// Augmentation of the encoder's training images. The decoder's target is always the clean image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Augmented copies of each image, in addition to one with only sensor noise. With a frozen backbone their features
    /// are computed once and kept.
    pub copies: usize,
    /// Further copies of the training images of the dataset's own poses, which are few compared with those of random
    /// poses: the first copy is unchanged, the others are augmented.
    pub own_copies: usize,
    /// Sensor noise and colour errors, on every copy.
    pub sensor: SensorNoise,
    /// Largest shift, as a share of the image's side.
    pub shift: f64,
    /// Largest relative change of scale.
    pub zoom: f64,
    /// Largest rotation about the optical axis, degrees.
    pub rotation_deg: f64,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            copies: 11,
            own_copies: 0,
            sensor: SensorNoise { sigma: 2.0, gain_sigma: 0.04, channel_gain_sigma: 0.02, channel_offset_sigma: 2.0 },
            shift: 0.1,
            zoom: 0.15,
            rotation_deg: 5.0,
        }
    }
}

impl Augmentation {
    /// Encoder inputs `[N, 3, H, W]`, 0..=1: augmented copy number `copy` of each chosen image. Copy 0 has only sensor
    /// noise. Equal seeds give equal copies.
    pub fn inputs(&self, posed: &PosedImages, chosen: &[usize], copy: usize, seed: u64) -> Tensor {
        let mut planes = Vec::with_capacity(chosen.len());
        let mut affine = Vec::with_capacity(chosen.len() * 6);
        for &i in chosen {
            let image = &posed.images[i];
            let key = Key { seed, frame: i as u64, step: copy as u32, sample: 0 };
            let mut noisy = vec![0_u8; image.rgb.len()];
            if apply_noise_into(&image.rgb, &mut noisy, &self.sensor, key).is_err() {
                // Cannot happen: the configuration was validated, and the lengths are equal.
                noisy.copy_from_slice(&image.rgb);
            }
            planes.push(Tensor::from_slice(&noisy).view([1, i64::from(image.height_px), i64::from(image.width_px), 3]));
            let mut rng = carff_base::random::stream(Key { sample: 1, ..key });
            let mut within = |limit: f64| if limit > 0.0 { rng.random_range(-limit..=limit) } else { 0.0 };
            let (angle, zoom) = (within(self.rotation_deg).to_radians(), 1.0 + within(self.zoom));
            let (dx, dy) = (2.0 * within(self.shift), 2.0 * within(self.shift));
            let (s, c) = (angle.sin() * zoom, angle.cos() * zoom);
            affine.extend([c, -s, dx, s, c, dy].map(|v| v as f32));
        }
        let one_size = planes.windows(2).all(|pair| pair[0].size() == pair[1].size());
        let images = if one_size {
            pictures_from_bytes(&Tensor::cat(&planes, 0))
        } else {
            // Datasets may mix sizes: a batch has the size of its first image.
            let size = planes[0].size();
            let resized = planes.iter().map(|plane| {
                let image = pictures_from_bytes(plane);
                image.internal_upsample_bilinear2d_aa([size[1], size[2]], false, None, None)
            });
            Tensor::cat(&resized.collect::<Vec<_>>(), 0)
        };
        if copy == 0 {
            return images;
        }
        let size = images.size();
        let theta = Tensor::from_slice(&affine).view([-1, 2, 3]);
        let grid = Tensor::affine_grid_generator(&theta, size.as_slice(), false);
        // Bilinear (0), edge pixels repeated (1).
        images.grid_sampler(&grid, 0, 1, false)
    }
}
