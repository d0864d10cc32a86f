//! Fully connected networks over blocks of samples: one forward and one backward pass for inference and training.

use std::ops::Range;

use crate::config::{LATENT_DIM, MAX_HIDDEN_WIDTH};
use crate::kernels::bf16::PackedAffine;
use crate::kernels::block::{BlockBuffer, Blocks, BlocksMut};
use crate::kernels::dense::{Activation, Affine, AffineGradient};
use crate::kernels::dispatch::{self, InstructionSet};

/// Blocks that go through a network together: their activations stay in the second-level cache.
pub(crate) const GROUP: usize = 8;

/// The numbers of all networks, as kernels of one instruction set read them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Weights<'a> {
    pub set: InstructionSet,
    pub numbers: &'a [f32],
    /// Weights in bf16, layer by layer ([`Dense::pairs`]); empty unless `set` works in bf16.
    pub pairs: &'a [u32],
}

/// The place of one fully connected layer in a flat buffer: weights input-major, `[inputs + latents][outputs]`, then
/// biases. The latent's rows are last, so that a prefix of the rows is the layer without the latent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Dense {
    /// Inputs, not counting the latent.
    pub inputs: usize,
    /// 8 when the layer takes the latent, else 0.
    pub latents: usize,
    /// Outputs, padded to a multiple of 4.
    pub outputs: usize,
    /// Outputs without the padding.
    pub outputs_used: usize,
    /// Index of the first weight.
    pub weight: usize,
    /// Index of the first bias.
    pub bias: usize,
}

impl Dense {
    /// Returns the number of inputs, the latent's included.
    pub fn rows(&self) -> usize {
        self.inputs + self.latents
    }

    /// Returns the weights without the latent's.
    pub fn weights<'a>(&self, numbers: &'a [f32]) -> &'a [f32] {
        &numbers[self.weight..self.weight + self.inputs * self.outputs]
    }

    /// Returns the biases.
    pub fn biases<'a>(&self, numbers: &'a [f32]) -> &'a [f32] {
        &numbers[self.bias..self.bias + self.outputs]
    }

    /// Returns the range of the layer's weights in a buffer of bf16 pairs, which is half as long as the networks'. They
    /// fit: rounding up an odd number of inputs takes less room than the biases leave.
    pub fn pairs(&self) -> Range<usize> {
        let start = self.weight / 2;
        start..start + self.inputs.div_ceil(2) * self.outputs
    }

    /// Computes the biases with the latent's share added: `W_z z + b`.
    pub fn fold(&self, numbers: &[f32], latent: &[f32; LATENT_DIM], out: &mut Vec<f32>) {
        out.clear();
        out.extend_from_slice(self.biases(numbers));
        for (k, z) in latent.iter().enumerate().take(self.latents) {
            let row = &numbers[self.weight + (self.inputs + k) * self.outputs..][..self.outputs];
            for (o, w) in out.iter_mut().zip(row) {
                *o += z * w;
            }
        }
    }

    /// Backward of [`Self::fold`]: from the gradient by the folded biases, adds the gradient by biases and latent rows
    /// to `gradient`, and the gradient by the latent to `latent_gradient`.
    pub fn fold_backward(
        &self,
        numbers: &[f32],
        latent: &[f32; LATENT_DIM],
        folded_gradient: &[f32],
        gradient: &mut [f32],
        latent_gradient: &mut [f32; LATENT_DIM],
    ) {
        for (g, d) in gradient[self.bias..self.bias + self.outputs].iter_mut().zip(folded_gradient) {
            *g += d;
        }
        for k in 0..self.latents {
            let at = self.weight + (self.inputs + k) * self.outputs;
            let mut sum = 0.0;
            for (o, d) in folded_gradient.iter().enumerate().take(self.outputs) {
                gradient[at + o] += latent[k] * d;
                sum += numbers[at + o] * d;
            }
            latent_gradient[k] += sum;
        }
    }

    /// Computes y = activation(W^T x + `bias`), without the latent's rows.
    pub fn forward(&self, weights: Weights<'_>, bias: &[f32], x: Blocks<'_>, y: BlocksMut<'_>, activation: Activation) {
        if weights.set.is_bf16() {
            let layer = PackedAffine { pairs: &weights.pairs[self.pairs()], inputs: self.inputs, bias };
            dispatch::dense_forward_bf16(weights.set, layer, x, y, activation);
        } else {
            let layer = Affine { weights: self.weights(weights.numbers), bias };
            dispatch::dense_forward(weights.set, layer, x, y, activation);
        }
    }

    /// Computes the gradient by the first `rows` inputs, gated by the rectifier whose outputs are `relu_of`.
    fn backward_input(
        &self,
        weights: Weights<'_>,
        rows: usize,
        dy: Blocks<'_>,
        dx: BlocksMut<'_>,
        relu_of: Option<Blocks<'_>>,
    ) {
        let matrix = &self.weights(weights.numbers)[..rows * self.outputs];
        let layer = Affine { weights: matrix, bias: self.biases(weights.numbers) };
        dispatch::dense_backward_input(weights.set, layer, dy, dx, relu_of);
    }

    /// Splits the gradient of this layer from the gradient of all networks.
    fn gradient<'a>(&self, gradient: &'a mut [f32]) -> AffineGradient<'a> {
        let (weights, bias) = gradient[self.weight..].split_at_mut(self.bias - self.weight);
        AffineGradient { weights: &mut weights[..self.inputs * self.outputs], bias: &mut bias[..self.outputs] }
    }
}

/// The function that a network applies to its last layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    Raw,
    Logistic,
}

/// A network of `N` fully connected layers (2 or 3) with rectifiers between them. Its first layer takes the latent,
/// which is folded into that layer's biases ([`Dense::fold`]).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mlp<const N: usize> {
    pub layers: [Dense; N],
    pub output: Output,
    /// Inputs, from the first on, by which training needs a gradient; 0 or a multiple of 4.
    pub trained_inputs: usize,
}

/// Activations of a network's hidden layers, or gradients by them.
pub(crate) type Hidden = [BlockBuffer; 2];

/// The input of a network.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Input<'a> {
    /// Inputs of the first layer.
    Features(Blocks<'a>),
    /// The first layer's products, without biases ([`Mlp::project`]).
    Projected(Blocks<'a>),
}

impl Input<'_> {
    /// Returns a part of the blocks.
    pub fn range(self, blocks: Range<usize>) -> Self {
        match self {
            Self::Features(x) => Self::Features(x.range(blocks)),
            Self::Projected(x) => Self::Projected(x.range(blocks)),
        }
    }
}

/// The gradients that a backward pass adds to, and the buffers it works in.
pub(crate) struct Backward<'a> {
    /// Gradient by all networks' numbers.
    pub gradient: &'a mut [f32],
    /// Gradient by the first layer's folded biases.
    pub folded_gradient: &'a mut [f32],
    pub hidden: &'a mut Hidden,
}

impl<const N: usize> Mlp<N> {
    /// Computes the first layer's products without biases, which are the same for all latents.
    pub fn project(&self, weights: Weights<'_>, x: Blocks<'_>, projected: BlocksMut<'_>) {
        let zeros = [0.0; MAX_HIDDEN_WIDTH];
        self.layers[0].forward(weights, &zeros[..self.layers[0].outputs], x, projected, Activation::Identity);
    }

    /// Computes the network's output, [`GROUP`] blocks at a time. `hidden` holds the activations of the last group
    /// afterwards, for [`Self::backward`].
    pub fn forward(
        &self,
        weights: Weights<'_>,
        folded: &[f32],
        input: Input<'_>,
        hidden: &mut Hidden,
        output: BlocksMut<'_>,
    ) {
        let last = &self.layers[N - 1];
        let mut done = 0;
        for mut y in output.groups(GROUP) {
            let count = y.count();
            let input = input.range(done..done + count);
            let x = self.forward_hidden(weights, folded, input, hidden, count);
            last.forward(weights, last.biases(weights.numbers), x, y.reborrow(), Activation::Identity);
            if self.output == Output::Logistic {
                dispatch::logistic(weights.set, y);
            }
            done += count;
        }
    }

    /// Computes all layers but the last for `count` blocks; returns the last hidden layer's activations.
    pub fn forward_hidden<'a>(
        &self,
        weights: Weights<'_>,
        folded: &[f32],
        input: Input<'_>,
        hidden: &'a mut Hidden,
        count: usize,
    ) -> Blocks<'a> {
        let y = hidden[0].blocks_mut(self.layers[0].outputs, count);
        match input {
            Input::Features(x) => self.layers[0].forward(weights, folded, x, y, Activation::Relu),
            Input::Projected(x) => dispatch::bias_relu(weights.set, folded, x, y),
        }
        for (i, layer) in self.layers.iter().enumerate().take(N - 1).skip(1) {
            let (before, after) = hidden.split_at_mut(i);
            let (x, y) = (before[i - 1].blocks(layer.inputs, count), after[0].blocks_mut(layer.outputs, count));
            layer.forward(weights, layer.biases(weights.numbers), x, y, Activation::Relu);
        }
        hidden[N - 2].blocks(self.layers[N - 1].inputs, count)
    }

    /// Backward of [`Self::forward`] for one group: from the gradient `dy` by the last layer's sums, adds the gradients
    /// by weights and biases to `work`, and computes the gradient `dx` by the first [`Self::trained_inputs`] inputs.
    pub fn backward(
        &self,
        weights: Weights<'_>,
        (input, hidden): (Blocks<'_>, &Hidden),
        dy: Blocks<'_>,
        work: Backward<'_>,
        mut dx: Option<BlocksMut<'_>>,
    ) {
        let Backward { gradient, folded_gradient, hidden: [above, below] } = work;
        let (mut above, mut below) = (above, below);
        let count = dy.count();
        for (i, layer) in self.layers.iter().enumerate().rev() {
            let dy = if i == N - 1 { dy } else { above.blocks(layer.outputs, count) };
            let mut gradient = layer.gradient(gradient);
            if i > 0 {
                let x = hidden[i - 1].blocks(layer.inputs, count);
                dispatch::dense_backward_weights(weights.set, x, dy, gradient);
                layer.backward_input(weights, layer.inputs, dy, below.blocks_mut(layer.inputs, count), Some(x));
                std::mem::swap(&mut above, &mut below);
            } else {
                gradient.bias = &mut *folded_gradient;
                dispatch::dense_backward_weights(weights.set, input, dy, gradient);
                if let Some(dx) = dx.take() {
                    layer.backward_input(weights, self.trained_inputs, dy, dx, None);
                }
            }
        }
    }
}
