//! The one interface of all sources of pictures; a real camera is a further one.

use carff_config::NoiseConfig;
use carff_dataset::sensor::SensorNoise;
use carff_messages::FrameMeta;

/// A source of pictures.
pub trait Source {
    /// Bytes of its largest picture.
    fn max_picture_bytes(&self) -> usize;

    /// Goes on to the next frame and describes it (all but the header); `None` at the end.
    fn advance(&mut self) -> Option<FrameMeta>;

    /// Writes the current frame's picture, RGB, 8 bit, once, into memory of exactly its size: that of the topic.
    /// `frame_id` names the noise.
    fn write(&mut self, frame_id: u64, picture: &mut [u8]) -> anyhow::Result<()>;
}

/// The graph file's noise, as the sensor model wants it.
pub(crate) fn sensor_noise(noise: &NoiseConfig) -> SensorNoise {
    SensorNoise {
        sigma: noise.sigma,
        gain_sigma: noise.gain_sigma,
        channel_gain_sigma: noise.channel_gain_sigma,
        channel_offset_sigma: noise.channel_offset_sigma,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The camera's default noise is the one that models are trained with.
    #[test]
    fn default_noise_is_that_of_training() {
        assert_eq!(sensor_noise(&NoiseConfig::default()), SensorNoise::default());
    }
}
