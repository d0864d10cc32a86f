//! Augmentation of the encoder's training images.

use carff_base::random::Key;
use carff_dataset::sensor::{SensorNoise, apply_noise_into};
use carff_dataset::{Corruption, Image};
use carff_evaluation::PosedImages;
use carff_networks::encoder::images_from_bytes;
use rand::Rng;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::Tensor;

/// Augmentation of the encoder's training images. The decoder's target is always the unchanged image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Augmented copies of each image, in addition to one with only sensor noise. With a frozen backbone their features
    /// are computed once and kept.
    pub copies: usize,
    /// Further copies of the training images of the dataset's own poses, which are few compared with those of free
    /// poses: the first copy is unchanged, the others are augmented.
    pub own_copies: usize,
    /// Sensor noise and colour errors, on every copy. Rendered images of free poses also get the noise of a camera's
    /// images.
    pub sensor: SensorNoise,
    /// Largest shift, as a share of the image's side.
    pub shift: f64,
    /// Largest relative change of scale.
    pub zoom: f64,
    /// Largest rotation about the optical axis, degrees.
    pub rotation_deg: f64,
    /// Share of the augmented copies, 0 to 1, that get one of `weather_kinds`. The copy with only sensor noise has none.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub weather: f64,
    /// Corruptions of weather, optics and sensor that the training may use, equally often. All others are held out.
    pub weather_kinds: Vec<Corruption>,
    /// Largest severity of these corruptions, 1 to 5; each severity up to it is equally often.
    #[schemars(range(min = 1, max = 5))]
    pub weather_severity: u8,
}

/// Number of the random stream of sensor noise, of the affine map and of weather.
const SENSOR: u32 = 0;
const AFFINE: u32 = 1;
const WEATHER: u32 = 2;

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            copies: 11,
            own_copies: 0,
            sensor: SensorNoise { sigma: 2.0, gain_sigma: 0.04, channel_gain_sigma: 0.02, channel_offset_sigma: 2.0 },
            shift: 0.1,
            zoom: 0.15,
            rotation_deg: 5.0,
            weather: 0.0,
            weather_kinds: Vec::new(),
            weather_severity: 3,
        }
    }
}

impl Augmentation {
    /// Checks that the weather is possible; the error names the key.
    pub(crate) fn validate_weather(&self) -> Result<(), String> {
        if !(1..=5).contains(&self.weather_severity) {
            return Err(format!("`augmentation.weather_severity` = {}: 1 to 5 are allowed", self.weather_severity));
        }
        if self.weather > 0.0 && self.weather_kinds.is_empty() {
            return Err("`augmentation.weather` needs corruptions: name some in `augmentation.weather_kinds`".into());
        }
        Ok(())
    }

    /// Returns the image in the weather that the key draws; `None` if it draws none.
    fn weathered(&self, image: &Image, key: Key) -> Option<Image> {
        let mut rng = carff_base::random::stream(key);
        if self.weather_kinds.is_empty() || rng.random::<f64>() >= self.weather {
            return None;
        }
        let kind = self.weather_kinds[rng.random_range(0..self.weather_kinds.len())];
        let severity = rng.random_range(1..=self.weather_severity).min(*kind.severities().end());
        // An image of the dataset has pixels, and the severity exists, so the corruption cannot fail.
        kind.apply(image, severity, key).ok()
    }

    /// Sensor noise of an image: that of the configuration, and on a rendered image also the noise of the camera that took
    /// the dataset's images.
    fn sensor_of(&self, posed: &PosedImages, image: usize) -> SensorNoise {
        let sigma = f64::from(self.sensor.sigma).hypot(posed.missing_noise(image)) as f32;
        SensorNoise { sigma: sigma.min(SensorNoise::LARGEST_SIGMA), ..self.sensor }
    }

    /// Encoder inputs `[N, 3, H, W]`, 0..=1: augmented copy number `copy` of each chosen image. Copy 0 has only sensor
    /// noise. Equal seeds give equal copies.
    pub fn inputs(&self, posed: &PosedImages, chosen: &[usize], copy: usize, seed: u64) -> Tensor {
        let mut planes = Vec::with_capacity(chosen.len());
        let mut affine = Vec::with_capacity(chosen.len() * 6);
        for &i in chosen {
            let image = &posed.images[i];
            let key = Key { seed, frame: i as u64, step: copy as u32, sample: SENSOR };
            let weathered = if copy == 0 { None } else { self.weathered(image, Key { sample: WEATHER, ..key }) };
            let image = weathered.as_ref().unwrap_or(image);
            let mut noisy = vec![0_u8; image.rgb.len()];
            if apply_noise_into(&image.rgb, &mut noisy, &self.sensor_of(posed, i), key).is_err() {
                // Cannot happen: the configuration was validated, and the lengths are equal.
                noisy.copy_from_slice(&image.rgb);
            }
            planes.push(Tensor::from_slice(&noisy).view([1, i64::from(image.height_px), i64::from(image.width_px), 3]));
            let mut rng = carff_base::random::stream(Key { sample: AFFINE, ..key });
            let mut within = |limit: f64| if limit > 0.0 { rng.random_range(-limit..=limit) } else { 0.0 };
            let (angle, zoom) = (within(self.rotation_deg).to_radians(), 1.0 + within(self.zoom));
            let (dx, dy) = (2.0 * within(self.shift), 2.0 * within(self.shift));
            let (s, c) = (angle.sin() * zoom, angle.cos() * zoom);
            affine.extend([c, -s, dx, s, c, dy].map(|v| v as f32));
        }
        let one_size = planes.windows(2).all(|pair| pair[0].size() == pair[1].size());
        let images = if one_size {
            images_from_bytes(&Tensor::cat(&planes, 0))
        } else {
            // Datasets may mix sizes: a batch has the size of its first image.
            let size = planes[0].size();
            let resized = planes.iter().map(|plane| {
                let image = images_from_bytes(plane);
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

#[cfg(test)]
mod tests {
    use super::*;

    fn rainy(weather: f64) -> Augmentation {
        let weather_kinds = vec![Corruption::Rain, Corruption::Monochrome];
        Augmentation { weather, weather_kinds, ..Augmentation::default() }
    }

    /// The share of copies in weather is the configured one (400 draws, 4 standard errors), without a share or kinds
    /// there is none, and equal keys give equal images.
    #[test]
    fn weather_has_its_share() {
        let image = Image::filled(16, 12, [200, 80, 40]);
        let key = |frame| Key { seed: 3, frame, step: 1, sample: WEATHER };
        let count = |augmentation: &Augmentation| {
            (0..400).filter(|&frame| augmentation.weathered(&image, key(frame)).is_some()).count()
        };
        assert!((84..=156).contains(&count(&rainy(0.3))), "{}", count(&rainy(0.3)));
        assert_eq!(count(&rainy(0.0)) + count(&Augmentation::default()), 0);
        assert_eq!(count(&rainy(1.0)), 400);
        assert_eq!(rainy(1.0).weathered(&image, key(9)), rainy(1.0).weathered(&image, key(9)));
        let grey = Corruption::Monochrome.apply(&image, 1, key(0)).unwrap();
        let made = (0..40).filter_map(|frame| rainy(1.0).weathered(&image, key(frame)));
        let monochrome = made.filter(|made| *made == grey).count();
        assert!((5..=35).contains(&monochrome), "both kinds occur: {monochrome} of 40");
    }

    /// A share without kinds and an impossible severity are refused by key.
    #[test]
    fn weather_is_checked() {
        assert!(rainy(0.3).validate_weather().is_ok() && Augmentation::default().validate_weather().is_ok());
        let error = |augmentation: Augmentation| augmentation.validate_weather().unwrap_err();
        assert!(error(Augmentation { weather_kinds: Vec::new(), ..rainy(0.3) }).contains("augmentation.weather_kinds"));
        assert!(error(Augmentation { weather_severity: 6, ..rainy(0.3) }).contains("1 to 5 are allowed"));
    }
}
