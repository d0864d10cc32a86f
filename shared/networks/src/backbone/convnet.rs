//! A small convolutional network, from scratch: the paper's "vanilla" encoder.

use super::{Backbone, resize};
use tch::{Tensor, nn, nn::Module};

/// Four strided 3x3 convolutions with group normalisation: stride 16, 112 channels.
#[derive(Debug)]
pub struct ConvNet {
    layers: Vec<(nn::Conv2D, nn::GroupNorm)>,
    input_px: i64,
}

const WIDTHS: [i64; 5] = [3, 32, 64, 96, 112];

impl ConvNet {
    /// Builds the network with random weights.
    pub fn new(path: &nn::Path, input_px: i64) -> Self {
        let layers = WIDTHS
            .windows(2)
            .enumerate()
            .map(|(i, w)| {
                let p = path / i;
                let conv = nn::ConvConfig { stride: 2, padding: 1, ..Default::default() };
                (
                    nn::conv2d(&p / "conv", w[0], w[1], 3, conv),
                    nn::group_norm(&p / "norm", 8, w[1], nn::GroupNormConfig::default()),
                )
            })
            .collect();
        Self { layers, input_px }
    }
}

impl Backbone for ConvNet {
    fn features(&self, images: &Tensor) -> Tensor {
        let x = (resize(images, self.input_px) - 0.5) * 4.0;
        self.layers.iter().fold(x, |x, (conv, norm)| norm.forward(&conv.forward(&x)).relu())
    }

    fn channels(&self) -> i64 {
        112
    }

    fn grid(&self) -> i64 {
        self.input_px / 16
    }
}
