//! Images of the decoder, and their quality.

use crate::PosedImages;
use carff_base::statistics::psnr_of_mse;
use carff_dataset::PIXEL_TOLERANCE;
use carff_messages::LATENT_DIM;
use carff_networks::decoder::Decoder;
use carff_trials::DecodedQuality;
use tch::{Device, Kind, Tensor};

/// Images that are decoded at a time.
const BATCH: usize = 60;

/// Mask `[N, 1, H, W]` of the pixels in which `difference` `[N, 3, H, W]` exceeds [`PIXEL_TOLERANCE`].
pub fn changed_pixels(difference: &Tensor) -> Tensor {
    let tolerance = f64::from(PIXEL_TOLERANCE) / 255.0;
    difference.abs().amax([1_i64].as_slice(), true).gt(tolerance).to_kind(Kind::Float)
}

/// A decoder with its training target.
#[derive(Clone, Copy)]
pub struct Decoding<'a> {
    /// Images of the scenario.
    pub posed: &'a PosedImages,
    /// The decoder.
    pub decoder: &'a Decoder,
    /// True if the decoder was trained on the residual over the pose's mean image, false if on the image.
    pub residual: bool,
}

impl Decoding<'_> {
    /// Decoded images `[N, 3, 128, 128]` in 0..=1, and the mean images of their poses, both on the CPU. Each pair is an
    /// image of the dataset, which gives the pose, and a latent.
    pub fn images(&self, pairs: &[(usize, [f32; LATENT_DIM])]) -> (Tensor, Tensor) {
        tch::no_grad(|| {
            let device = self.decoder.device();
            let latents: Vec<f32> = pairs.iter().flat_map(|pair| pair.1).collect();
            let views: Vec<i64> = pairs.iter().map(|pair| self.posed.labels[pair.0].view as i64).collect();
            let views = Tensor::from_slice(&views);
            let means = self.posed.pose_means.index_select(0, &views);
            let latents = Tensor::from_slice(&latents).view([-1, LATENT_DIM as i64]).to_device(device);
            let out = self.decoder.forward(&latents, &views.to_device(device)).to_device(Device::Cpu);
            let out = if self.residual { out + &means } else { out };
            (out.clamp(0.0, 1.0), means)
        })
    }

    /// Quality of the images decoded from `pairs`, each against its image of the dataset.
    pub fn quality(&self, pairs: &[(usize, [f32; LATENT_DIM])]) -> DecodedQuality {
        let [mut error, mut mean_error, mut changed_error, mut changed_count, mut count] = [0.0_f64; 5];
        for chunk in pairs.chunks(BATCH) {
            let chosen: Vec<usize> = chunk.iter().map(|pair| pair.0).collect();
            let (out, means) = self.images(chunk);
            let targets = self.posed.targets(&chosen);
            let valid = self.posed.valid_targets(&chosen);
            let of_valid = |t: Tensor| valid.as_ref().map_or_else(|| t.shallow_clone(), |valid| &t * valid);
            let difference = of_valid(&targets - &means);
            let changed = changed_pixels(&difference);
            let squares = of_valid((&out - &targets).square());
            error += squares.sum(Kind::Double).double_value(&[]);
            mean_error += difference.square().sum(Kind::Double).double_value(&[]);
            changed_error += (squares * &changed).sum(Kind::Double).double_value(&[]);
            changed_count += changed.sum(Kind::Double).double_value(&[]) * 3.0;
            count += valid.map_or(targets.numel() as f64, |valid| valid.sum(Kind::Double).double_value(&[]) * 3.0);
        }
        let psnr = |sum: f64, n: f64| psnr_of_mse(sum / n.max(1.0));
        DecodedQuality {
            psnr_db: psnr(error, count),
            mean_image_psnr_db: psnr(mean_error, count),
            changed_pixels_psnr_db: psnr(changed_error, changed_count),
            images: pairs.len(),
        }
    }
}
