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

/// Maps latents `[N, 8]` and pose indices `[N]` to the inputs of the first layer.
fn join(latents: &Tensor, poses: &Tensor, count: i64, concatenated: bool) -> Tensor {
    if count == 0 {
        return latents.shallow_clone();
    }
    let one_hot = poses.one_hot(count).to_kind(latents.kind());
    let latent = if concatenated {
        latents.shallow_clone()
    } else {
        (one_hot.unsqueeze(2) * latents.unsqueeze(1)).flatten(1, -1)
    };
    Tensor::cat(&[latent, one_hot], 1)
}

/// The decoder.
#[derive(Debug)]
pub struct Decoder {
    join: nn::Linear,
    spread: nn::Linear,
    /// Each follows a doubling of the side.
    up: [nn::Conv2D; 3],
    out: nn::Conv2D,
    channels: i64,
    poses: i64,
    concatenated: bool,
}

impl Decoder {
    /// Builds a decoder for `poses` fixed camera poses.
    pub fn new(path: &nn::Path, config: &DecoderConfig, poses: i64) -> Self {
        let same = nn::ConvConfig { padding: 1, ..Default::default() };
        let linear = nn::LinearConfig::default();
        let poses = if config.pose_condition { poses } else { 0 };
        let c = config.channels;
        Self {
            join: nn::linear(path / "join", joined(poses, config.concatenated), config.hidden, linear),
            spread: nn::linear(path / "spread", config.hidden, c * 64, linear),
            up: [
                nn::conv2d(path / "up16", c, c, 3, same),
                nn::conv2d(path / "up32", c, c * 3 / 4, 3, same),
                nn::conv2d(path / "up64", c * 3 / 4, c * 3 / 8, 3, same),
            ],
            // 12 = 3 colours of 2x2 pixels: the last doubling is a pixel shuffle.
            out: nn::conv2d(path / "out", c * 3 / 8, 12, 3, same),
            channels: c,
            poses,
            concatenated: config.concatenated,
        }
    }

    /// Returns the device of the weights.
    pub fn device(&self) -> tch::Device {
        self.join.ws.device()
    }

    /// Maps latents `[N, 8]` and pose indices `[N]` (int64) to `[N, 3, 128, 128]`: an image in 0..=1, or the residual over
    /// the pose's mean image, as trained.
    pub fn forward(&self, latents: &Tensor, poses: &Tensor) -> Tensor {
        let x = self.join.forward(&join(latents, poses, self.poses, self.concatenated)).relu();
        let mut x = self.spread.forward(&x).relu().view([-1, self.channels, 8, 8]);
        for layer in &self.up {
            let side = x.size()[2] * 2;
            x = layer.forward(&x.upsample_nearest2d([side, side], None, None)).relu();
        }
        self.out.forward(&x).pixel_shuffle(2)
    }
}

/// A decoder of small images, for the poses that the input does not show. It has dense layers only.
#[derive(Debug)]
pub struct SmallDecoder {
    join: nn::Linear,
    out: nn::Linear,
    poses: i64,
    concatenated: bool,
}

impl SmallDecoder {
    /// Builds a decoder for `poses` fixed camera poses.
    pub fn new(path: &nn::Path, config: &DecoderConfig, poses: i64) -> Self {
        let linear = nn::LinearConfig::default();
        Self {
            join: nn::linear(path / "join", joined(poses, config.concatenated), config.hidden, linear),
            out: nn::linear(path / "out", config.hidden, 3 * SMALL_PX * SMALL_PX, linear),
            poses,
            concatenated: config.concatenated,
        }
    }

    /// Maps latents `[N, 8]` and pose indices `[N]` (int64) to `[N, 3, 32, 32]`, as [`Decoder::forward`] does.
    pub fn forward(&self, latents: &Tensor, poses: &Tensor) -> Tensor {
        let x = self.join.forward(&join(latents, poses, self.poses, self.concatenated)).relu();
        self.out.forward(&x).view([-1, 3, SMALL_PX, SMALL_PX])
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
