//! The noise of a small camera: read noise, and exposure and white balance that vary per frame.
//!
//! The camera stage and the training apply it by one function, so that models are trained on the same noise. All draws
//! come from the counter-based stream of a key: the same key gives the same bytes. [`read_noise`] measures the noise that
//! images already have.

use crate::image::Image;
use carff_base::random::{Key, tag};
use rand::Rng;
use rand_distr::StandardNormal;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of the sensor noise. If all are zero, the image is unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SensorNoise {
    /// Standard deviation of the read noise, per pixel and channel, in units of 1/255. 0 to 64.
    #[schemars(range(min = 0.0, max = 64.0))]
    pub sigma: f32,
    /// Standard deviation of the exposure's relative error, one draw a frame. 0 to 0.5.
    #[schemars(range(min = 0.0, max = 0.5))]
    pub gain_sigma: f32,
    /// Standard deviation of each channel's relative gain error (white balance), one draw a frame. 0 to 0.5.
    #[schemars(range(min = 0.0, max = 0.5))]
    pub channel_gain_sigma: f32,
    /// Standard deviation of each channel's offset, one draw a frame, in units of 1/255. 0 to 64.
    #[schemars(range(min = 0.0, max = 64.0))]
    pub channel_offset_sigma: f32,
}

impl Default for SensorNoise {
    fn default() -> Self {
        Self { sigma: 2.0, gain_sigma: 0.02, channel_gain_sigma: 0.01, channel_offset_sigma: 1.0 }
    }
}

/// Reason why noise cannot be applied.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// A parameter is out of range.
    #[error("sensor noise: `{key}` is {value}; allowed are 0 to {limit}")]
    OutOfRange {
        /// Name of the parameter.
        key: &'static str,
        /// Value of the parameter.
        value: f32,
        /// The largest allowed value.
        limit: f32,
    },
    /// Source and destination have different lengths, or a length that is not a multiple of 3.
    #[error("sensor noise: {source_len} bytes into {destination_len}; both must be the same multiple of 3")]
    Lengths {
        /// Number of bytes in the source.
        source_len: usize,
        /// Number of bytes in the destination.
        destination_len: usize,
    },
}

/// Name of the random stream, so that no other draw of the same run shares it.
const STREAM: u64 = tag("sensornz");

impl SensorNoise {
    /// Largest allowed `sigma`.
    pub const LARGEST_SIGMA: f32 = 64.0;

    /// Parameters without any noise.
    pub const OFF: Self = Self { sigma: 0.0, gain_sigma: 0.0, channel_gain_sigma: 0.0, channel_offset_sigma: 0.0 };

    /// Checks that each parameter is finite and in range.
    pub fn validate(&self) -> Result<(), SensorError> {
        for (key, value, limit) in [
            ("sigma", self.sigma, Self::LARGEST_SIGMA),
            ("gain_sigma", self.gain_sigma, 0.5),
            ("channel_gain_sigma", self.channel_gain_sigma, 0.5),
            ("channel_offset_sigma", self.channel_offset_sigma, 64.0),
        ] {
            if !(0.0..=limit).contains(&value) {
                return Err(SensorError::OutOfRange { key, value, limit });
            }
        }
        Ok(())
    }
}

/// Writes `source` (RGB, 8 bit) with noise into `destination`. It writes each byte once and in order, so that the
/// destination can be a loaned sample in shared memory. It allocates nothing. The same key gives the same noise.
pub fn apply_noise_into(
    source: &[u8],
    destination: &mut [u8],
    noise: &SensorNoise,
    key: Key,
) -> Result<(), SensorError> {
    noise.validate()?;
    if source.len() != destination.len() || !source.len().is_multiple_of(3) {
        return Err(SensorError::Lengths { source_len: source.len(), destination_len: destination.len() });
    }
    if *noise == SensorNoise::OFF {
        destination.copy_from_slice(source);
        return Ok(());
    }
    transform(source.iter().copied(), destination, noise, key);
    Ok(())
}

fn transform(source: impl Iterator<Item = u8>, destination: &mut [u8], noise: &SensorNoise, key: Key) {
    let mut pixels = Noise::new(noise, key);
    for (i, (to, from)) in destination.iter_mut().zip(source).enumerate() {
        *to = pixels.next(i % 3, from);
    }
}

/// Median of the magnitude of a normal variable of deviation 1.
const NORMAL_MEDIAN: f64 = 0.674_49;

/// Returns the standard deviation of the read noise of images, of 255: the median magnitude of the finest diagonal
/// detail of 2 x 2 pixels, which surfaces and edges hardly have (Donoho and Johnstone 1994). Clipped pixels are left out;
/// 0 without any other.
///
/// Fine texture counts as noise: images without noise have 0.2 to 1, and a read noise of 4 is found as 4.1 to 4.6.
///
/// ```
/// use carff_base::random::Key;
/// use carff_dataset::{Image, sensor::{SensorNoise, apply_noise_into, read_noise}};
/// let clean = Image::filled(64, 64, [90, 120, 150]);
/// let mut noisy = clean.clone();
/// let noise = SensorNoise { sigma: 4.0, ..SensorNoise::OFF };
/// apply_noise_into(&clean.rgb, &mut noisy.rgb, &noise, Key { seed: 1, frame: 0, step: 0, sample: 0 })?;
/// assert!((3.7..4.3).contains(&read_noise(&[noisy])));
/// assert!(read_noise(&[clean]) < 0.4);
/// # Ok::<(), carff_dataset::sensor::SensorError>(())
/// ```
pub fn read_noise(images: &[Image]) -> f64 {
    let mut counts = [0_u64; 4 * 255 + 1];
    for image in images {
        let row = image.width_px as usize * 3;
        for rows in image.rgb.chunks_exact((2 * row).max(1)) {
            let (above, below) = rows.split_at(row);
            for (above, below) in above.chunks_exact(6).zip(below.chunks_exact(6)) {
                for channel in 0..3 {
                    let block = [above[channel], above[channel + 3], below[channel], below[channel + 3]];
                    if block.iter().all(|value| (1..255).contains(value)) {
                        let [a, b, c, d] = block.map(usize::from);
                        counts[(a + d).abs_diff(b + c)] += 1;
                    }
                }
            }
        }
    }
    let half = counts.iter().sum::<u64>() as f64 / 2.0;
    let mut below = 0.0;
    for (detail, &count) in counts.iter().enumerate() {
        if count > 0 && below + count as f64 >= half {
            // A whole number stands for all values that round to it.
            let low = (detail as f64 - 0.5).max(0.0);
            let median = low + (detail as f64 + 0.5 - low) * (half - below) / count as f64;
            // The sum of four values has twice the deviation of one.
            return median / (2.0 * NORMAL_MEDIAN);
        }
        below += count as f64;
    }
    0.0
}

/// Random values of one frame.
struct Noise<R> {
    rng: R,
    sigma: f32,
    gain: [f32; 3],
    offset: [f32; 3],
}

impl Noise<()> {
    #[allow(clippy::new_ret_no_self, reason = "the type of the random stream has no name")]
    fn new(noise: &SensorNoise, key: Key) -> Noise<impl Rng> {
        let mut rng = carff_base::random::stream(Key { seed: key.seed ^ STREAM, ..key });
        let mut normal = |sigma: f32| sigma * rng.sample::<f32, _>(StandardNormal);
        let exposure = 1.0 + normal(noise.gain_sigma);
        let gain = [0; 3].map(|_| exposure * (1.0 + normal(noise.channel_gain_sigma)));
        let offset = [0; 3].map(|_| normal(noise.channel_offset_sigma));
        Noise { rng, sigma: noise.sigma, gain, offset }
    }
}

impl<R: Rng> Noise<R> {
    fn next(&mut self, channel: usize, value: u8) -> u8 {
        let read = if self.sigma > 0.0 { self.sigma * self.rng.sample::<f32, _>(StandardNormal) } else { 0.0 };
        // The cast saturates at 0 and 255.
        (f32::from(value) * self.gain[channel] + self.offset[channel] + read).round() as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The deviation is found over surfaces, edges and objects, within 15 % for 2 to 16 of 255. Black, white, narrow and
    /// no images have none.
    #[test]
    fn read_noise_is_found() {
        let mut scene = Image::filled(96, 64, [60, 120, 180]);
        for (i, pixel) in scene.rgb.chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % 96, i / 96);
            let step = if x + y < 50 { 40 } else { 0 };
            let object = if (40..60).contains(&x) && (20..41).contains(&y) { 25 } else { 0 };
            for value in pixel {
                *value = (usize::from(*value) + x / 3 + step - object) as u8;
            }
        }
        for sigma in [2.0_f32, 4.0, 8.0, 16.0] {
            let mut noisy = scene.clone();
            let noise = SensorNoise { sigma, gain_sigma: 0.05, ..SensorNoise::OFF };
            apply_noise_into(&scene.rgb, &mut noisy.rgb, &noise, Key { seed: 7, frame: 1, step: 0, sample: 0 })
                .unwrap();
            let ratio = read_noise(&[noisy]) / f64::from(sigma);
            assert!((0.85..=1.15).contains(&ratio), "{sigma}: {ratio}");
        }
        assert!(read_noise(&[scene]) < 1.0);
        let plain = |width, height, value| Image::filled(width, height, [value; 3]);
        assert_eq!(read_noise(&[plain(8, 8, 0), plain(8, 8, 255), plain(1, 9, 90), plain(9, 1, 90)]), 0.0);
        assert_eq!(read_noise(&[]), 0.0);
    }

    /// Applies noise in place.
    fn apply_noise(rgb: &mut [u8], noise: &SensorNoise, key: Key) -> Result<(), SensorError> {
        let source = rgb.to_vec();
        apply_noise_into(&source, rgb, noise, key)
    }

    const KEY: Key = Key { seed: 5, frame: 17, step: 0, sample: 0 };

    /// The same key gives the same bytes, in place or not; another key gives other bytes.
    #[test]
    fn noise_is_named_by_its_key() {
        let source = vec![128_u8; 64 * 64 * 3];
        let mut a = vec![0; source.len()];
        apply_noise_into(&source, &mut a, &SensorNoise::default(), KEY).unwrap();
        let mut b = source.clone();
        apply_noise(&mut b, &SensorNoise::default(), KEY).unwrap();
        assert_eq!(a, b);
        apply_noise_into(&source, &mut b, &SensorNoise::default(), Key { frame: 18, ..KEY }).unwrap();
        assert_ne!(a, b);
    }

    /// Read noise of sigma 4 on mid grey has mean 0 and variance 16 + 1/12 (rounding), within 5 standard errors.
    #[test]
    fn read_noise_has_its_variance() {
        let n = 128 * 128 * 3;
        let mut rgb = vec![128_u8; n];
        apply_noise(&mut rgb, &SensorNoise { sigma: 4.0, ..SensorNoise::OFF }, KEY).unwrap();
        let n = n as f64;
        let mean = rgb.iter().map(|&v| f64::from(v) - 128.0).sum::<f64>() / n;
        let variance = rgb.iter().map(|&v| (f64::from(v) - 128.0 - mean).powi(2)).sum::<f64>() / n;
        let expected = 16.0 + 1.0 / 12.0;
        assert!(mean.abs() < 5.0 * (expected / n).sqrt(), "{mean}");
        assert!((variance - expected).abs() < 5.0 * expected * (2.0 / n).sqrt(), "{variance}");
    }

    /// Gain and offset are drawn once per frame: without read noise, equal pixels stay equal within a channel.
    #[test]
    fn colour_changes_are_global() {
        let mut rgb = vec![100_u8; 30];
        let noise = SensorNoise { sigma: 0.0, gain_sigma: 0.2, channel_gain_sigma: 0.2, channel_offset_sigma: 10.0 };
        apply_noise(&mut rgb, &noise, KEY).unwrap();
        assert!(rgb.chunks(3).all(|p| p == &rgb[..3]));
        assert_ne!(rgb[..3], [100; 3]);
    }

    /// Zero noise copies the image, black and white do not wrap around, and bad parameters or lengths are refused.
    #[test]
    fn limits() {
        let source = [0_u8, 255, 7];
        let mut to = [1; 3];
        apply_noise_into(&source, &mut to, &SensorNoise::OFF, KEY).unwrap();
        assert_eq!(source, to);
        let mut white = vec![255_u8; 300];
        apply_noise(&mut white, &SensorNoise { sigma: 8.0, ..SensorNoise::OFF }, KEY).unwrap();
        assert!(white.iter().all(|&v| v > 200));
        let error = apply_noise(&mut white, &SensorNoise { sigma: f32::NAN, ..SensorNoise::OFF }, KEY).unwrap_err();
        assert_eq!(error.to_string(), "sensor noise: `sigma` is NaN; allowed are 0 to 64");
        assert!(apply_noise_into(&source, &mut [0; 2], &SensorNoise::OFF, KEY).is_err());
        assert!(apply_noise(&mut [0; 4], &SensorNoise::OFF, KEY).is_err());
    }
}
