//! The pose-conditional VAE's decoder: from a scene latent and a pose index to that pose's image (section 3.2).

use carff_checkpoint::shapes::DecoderConfig;
use carff_messages::LATENT_DIM;
use tch::{Tensor, nn, nn::Module};

/// Side of the decoder's images, pixels.
pub const PICTURE_PX: i64 = 128;

/// Number of inputs of the first layer: the one-hot pose, and its product with the latent, so that each pose has its
/// own map of the latent. With a concatenation of latent and pose, the decoder stayed at the pose's mean image.
fn joined(poses: i64) -> i64 {
    if poses > 0 { poses * (LATENT_DIM as i64 + 1) } else { LATENT_DIM as i64 }
}

/// The decoder.
#[derive(Debug)]
pub struct Decoder {
    join: nn::Linear,
    spread: nn::Linear,
    up16: nn::Conv2D,
    up32: nn::Conv2D,
    up64: nn::Conv2D,
    out: nn::Conv2D,
    channels: i64,
    poses: i64,
}

impl Decoder {
    /// Builds a decoder for `poses` fixed camera poses (0: without a pose input).
    pub fn new(path: &nn::Path, config: &DecoderConfig, poses: i64) -> Self {
        let same = nn::ConvConfig { padding: 1, ..Default::default() };
        let c = config.channels;
        let poses = if config.pose_condition { poses } else { 0 };
        let linear = nn::LinearConfig::default();
        Self {
            join: nn::linear(path / "join", joined(poses), config.hidden, linear),
            spread: nn::linear(path / "spread", config.hidden, c * 64, linear),
            up16: nn::conv2d(path / "up16", c, c, 3, same),
            up32: nn::conv2d(path / "up32", c, c * 3 / 4, 3, same),
            up64: nn::conv2d(path / "up64", c * 3 / 4, c * 3 / 8, 3, same),
            // 12 = 3 colours of 2x2 pixels: the last doubling is a pixel shuffle.
            out: nn::conv2d(path / "out", c * 3 / 8, 12, 3, same),
            channels: c,
            poses,
        }
    }

    /// Returns the device of the weights.
    pub fn device(&self) -> tch::Device {
        self.join.ws.device()
    }

    /// Maps latents `[N, 8]` and pose indices `[N]` (int64) to `[N, 3, 128, 128]`: an image in 0..=1, or the residual
    /// over the pose's mean image, as trained.
    pub fn forward(&self, latents: &Tensor, poses: &Tensor) -> Tensor {
        let input = if self.poses > 0 {
            let one_hot = poses.one_hot(self.poses).to_kind(latents.kind());
            let product = (one_hot.unsqueeze(2) * latents.unsqueeze(1)).flatten(1, -1);
            Tensor::cat(&[product, one_hot], 1)
        } else {
            latents.shallow_clone()
        };
        let x = self.join.forward(&input).relu();
        let x = self.spread.forward(&x).relu().view([-1, self.channels, 8, 8]);
        let double = |x: &Tensor| {
            let side = x.size()[2] * 2;
            x.upsample_nearest2d([side, side], None, None)
        };
        let x = self.up16.forward(&double(&x)).relu();
        let x = self.up32.forward(&double(&x)).relu();
        let x = self.up64.forward(&double(&x)).relu();
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
        let differs = |pose_condition| {
            tch::manual_seed(1);
            let store = VarStore::new(Device::Cpu);
            let config = DecoderConfig { hidden: 16, channels: 16, pose_condition };
            let decoder = Decoder::new(&store.root(), &config, 3);
            let latents = Tensor::ones([2, LATENT_DIM as i64], (Kind::Float, Device::Cpu));
            let out = decoder.forward(&latents, &Tensor::from_slice(&[0_i64, 2]));
            assert_eq!(out.size(), [2, 3, PICTURE_PX, PICTURE_PX]);
            (out.get(0) - out.get(1)).abs().max().double_value(&[]) > 1e-6
        };
        assert!(differs(true) && !differs(false));
    }
}
