//! The pose-conditional VAE's decoder: from a scene latent and a pose index to that pose's image (section 3.2).

use carff_checkpoint::shapes::DecoderConfig;
use carff_messages::LATENT_DIM;
use tch::{Tensor, nn, nn::Module};

/// Side of the decoder's images, pixels.
pub const IMAGE_PX: i64 = 128;

/// Side of the images of a small decoder, pixels.
pub const SMALL_PX: i64 = 32;

/// Number of inputs of the first layer: the one-hot pose, and the latent or its product with the pose, which gives each
/// pose its own map of the latent.
fn joined(poses: i64, concatenated: bool) -> i64 {
    let latent = LATENT_DIM as i64;
    if concatenated { poses + latent } else { poses + poses.max(1) * latent }
}

/// The decoder.
#[derive(Debug)]
pub struct Decoder {
    join: nn::Linear,
    spread: nn::Linear,
    /// Each follows a doubling of the side.
    up: Vec<nn::Conv2D>,
    out: nn::Conv2D,
    channels: i64,
    poses: i64,
    concatenated: bool,
}

impl Decoder {
    /// Builds a decoder for `poses` fixed camera poses, with images of [`IMAGE_PX`].
    pub fn new(path: &nn::Path, config: &DecoderConfig, poses: i64) -> Self {
        let c = config.channels;
        Self::with_layers(path, config, poses, &[("up16", c), ("up32", c * 3 / 4), ("up64", c * 3 / 8)])
    }

    /// Builds a decoder with images of [`SMALL_PX`]: it costs a thirtieth of [`Self::new`].
    pub fn small(path: &nn::Path, config: &DecoderConfig, poses: i64) -> Self {
        Self::with_layers(path, config, poses, &[("up16", config.channels)])
    }

    /// Builds a decoder; `layers` has the name and the output channels of the layer after each doubling.
    fn with_layers(path: &nn::Path, config: &DecoderConfig, poses: i64, layers: &[(&str, i64)]) -> Self {
        let same = nn::ConvConfig { padding: 1, ..Default::default() };
        let linear = nn::LinearConfig::default();
        let poses = if config.pose_condition { poses } else { 0 };
        let mut channels = config.channels;
        let up = layers.iter().map(|&(name, to)| {
            let layer = nn::conv2d(path / name, channels, to, 3, same);
            channels = to;
            layer
        });
        let up = up.collect();
        Self {
            join: nn::linear(path / "join", joined(poses, config.concatenated), config.hidden, linear),
            spread: nn::linear(path / "spread", config.hidden, config.channels * 64, linear),
            up,
            // 12 = 3 colours of 2x2 pixels: the last doubling is a pixel shuffle.
            out: nn::conv2d(path / "out", channels, 12, 3, same),
            channels: config.channels,
            poses,
            concatenated: config.concatenated,
        }
    }

    /// Returns the device of the weights.
    pub fn device(&self) -> tch::Device {
        self.join.ws.device()
    }

    /// Maps latents `[N, 8]` and pose indices `[N]` (int64) to `[N, 3, S, S]`: an image in 0..=1, or the residual over
    /// the pose's mean image, as trained.
    pub fn forward(&self, latents: &Tensor, poses: &Tensor) -> Tensor {
        let input = if self.poses > 0 {
            let one_hot = poses.one_hot(self.poses).to_kind(latents.kind());
            let latent = if self.concatenated {
                latents.shallow_clone()
            } else {
                (one_hot.unsqueeze(2) * latents.unsqueeze(1)).flatten(1, -1)
            };
            Tensor::cat(&[latent, one_hot], 1)
        } else {
            latents.shallow_clone()
        };
        let x = self.join.forward(&input).relu();
        let mut x = self.spread.forward(&x).relu().view([-1, self.channels, 8, 8]);
        for layer in &self.up {
            let side = x.size()[2] * 2;
            x = layer.forward(&x.upsample_nearest2d([side, side], None, None)).relu();
        }
        self.out.forward(&x).pixel_shuffle(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::{Device, Kind, nn::VarStore};

    /// A decoder with a pose input draws different images for different poses; one without draws the same.
    #[test]
    fn pose_condition_is_a_setting() {
        let differs = |pose_condition, concatenated| {
            tch::manual_seed(1);
            let store = VarStore::new(Device::Cpu);
            let config = DecoderConfig { hidden: 16, channels: 16, pose_condition, concatenated };
            let decoder = Decoder::new(&store.root(), &config, 3);
            let latents = Tensor::ones([2, LATENT_DIM as i64], (Kind::Float, Device::Cpu));
            let out = decoder.forward(&latents, &Tensor::from_slice(&[0_i64, 2]));
            assert_eq!(out.size(), [2, 3, IMAGE_PX, IMAGE_PX]);
            (out.get(0) - out.get(1)).abs().max().double_value(&[]) > 1e-6
        };
        assert!(differs(true, false) && differs(true, true) && !differs(false, false));
    }
}
