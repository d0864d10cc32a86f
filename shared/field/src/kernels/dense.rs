//! Fully connected layers over blocks, forward and backward.
//!
//! These bodies take plain slices and the strides of their blocks, where [`super::dispatch`] takes views: only of
//! slices that are arguments of the compiled function does the compiler know that they do not overlap, and without that
//! it does not vectorise the sums.

#![allow(clippy::too_many_arguments, reason = "only slices that are arguments are known not to overlap")]

use super::block::LANES;
use super::math::fma;

/// The weights of a layer, `[inputs][outputs]`, and its biases, one for each output (a multiple of 4).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Affine<'a> {
    pub weights: &'a [f32],
    pub bias: &'a [f32],
}

/// The gradients by the weights and biases of a layer, in the layout of [`Affine`].
#[derive(Debug)]
pub(crate) struct AffineGradient<'a> {
    pub weights: &'a mut [f32],
    pub bias: &'a mut [f32],
}

/// The function that a layer applies to its sums.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Activation {
    Identity,
    Relu,
}

#[inline(always)]
fn row(block: &[f32], r: usize) -> &[f32; LANES] {
    block[r * LANES..].first_chunk().expect("a block holds all its rows")
}

/// One fully connected layer: y = W^T x + b, clamped from below at zero when `relu`. Blocks of `y` may have more rows
/// than the layer has outputs.
#[inline(always)]
pub(crate) fn forward<const FMA: bool>(
    weights: &[f32],
    bias: &[f32],
    x: &[f32],
    x_stride: usize,
    y: &mut [f32],
    y_stride: usize,
    relu: bool,
) {
    let outputs = bias.len();
    let inputs = weights.len() / outputs;
    for (xb, yb) in x.chunks_exact(x_stride).zip(y.chunks_exact_mut(y_stride)) {
        let xb = &xb[..inputs * LANES];
        for (o, (yo, bo)) in yb[..outputs * LANES].chunks_exact_mut(4 * LANES).zip(bias.chunks_exact(4)).enumerate() {
            let mut acc = [[0.0_f32; LANES]; 4];
            for j in 0..4 {
                acc[j] = [bo[j]; LANES];
            }
            for (xr, wr) in xb.as_chunks::<LANES>().0.iter().zip(weights.chunks_exact(outputs)) {
                let w: &[f32; 4] = wr[o * 4..].first_chunk().expect("outputs are a multiple of 4");
                for j in 0..4 {
                    for l in 0..LANES {
                        acc[j][l] = fma::<FMA>(xr[l], w[j], acc[j][l]);
                    }
                }
            }
            if relu {
                // Row by row and not in a loop: see `dispatched`.
                let clamped = |a: &[f32; LANES]| a.map(|v| v.max(0.0));
                acc = [clamped(&acc[0]), clamped(&acc[1]), clamped(&acc[2]), clamped(&acc[3])];
            }
            yo.copy_from_slice(acc.as_flattened());
        }
    }
}

/// y = max(x + b, 0), row by row, for blocks of `x` and `y` with one row for each bias.
#[inline(always)]
pub(crate) fn bias_relu<const FMA: bool>(x: &[f32], bias: &[f32], y: &mut [f32], stride: usize) {
    for (xb, yb) in x.chunks_exact(stride).zip(y.chunks_exact_mut(stride)) {
        for ((xr, yr), b) in xb.as_chunks::<LANES>().0.iter().zip(yb.as_chunks_mut::<LANES>().0).zip(bias) {
            for l in 0..LANES {
                yr[l] = (xr[l] + b).max(0.0);
            }
        }
    }
}

/// Gradient by a layer's inputs: dx = W dy for the first `rows` inputs (a multiple of 4). With the input's own
/// activations as `relu_of`, in the layout of `dx`, the gradient is zero wherever they are not positive.
#[inline(always)]
pub(crate) fn backward_input<const FMA: bool>(
    weights: &[f32],
    outputs: usize,
    dy: &[f32],
    dy_stride: usize,
    dx: &mut [f32],
    dx_stride: usize,
    rows: usize,
    relu_of: Option<&[f32]>,
) {
    for (b, (dyb, dxb)) in dy.chunks_exact(dy_stride).zip(dx.chunks_exact_mut(dx_stride)).enumerate() {
        let dyb = &dyb[..outputs * LANES];
        let gate = relu_of.map(|a| &a[b * dx_stride..][..rows * LANES]);
        for (k, (dxk, w)) in
            dxb[..rows * LANES].chunks_exact_mut(4 * LANES).zip(weights.chunks_exact(4 * outputs)).enumerate()
        {
            let (w0, w) = w.split_at(outputs);
            let (w1, w) = w.split_at(outputs);
            let (w2, w3) = w.split_at(outputs);
            let mut acc = [[0.0_f32; LANES]; 4];
            for ((((dyr, a), b), c), d) in dyb.as_chunks::<LANES>().0.iter().zip(w0).zip(w1).zip(w2).zip(w3) {
                let w = [*a, *b, *c, *d];
                for j in 0..4 {
                    for l in 0..LANES {
                        acc[j][l] = fma::<FMA>(dyr[l], w[j], acc[j][l]);
                    }
                }
            }
            for (j, (dxr, a)) in dxk.as_chunks_mut::<LANES>().0.iter_mut().zip(&acc).enumerate() {
                if let Some(gate) = gate {
                    let g = row(gate, k * 4 + j);
                    for l in 0..LANES {
                        dxr[l] = if g[l] > 0.0 { a[l] } else { 0.0 };
                    }
                } else {
                    *dxr = *a;
                }
            }
        }
    }
}

#[inline(always)]
fn sum8(a: &[f32; 8]) -> f32 {
    ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]))
}

/// Adds the gradients by a layer's weights and biases to `dw` (`[inputs][outputs]`) and `db`.
#[inline(always)]
pub(crate) fn backward_weights<const FMA: bool>(
    x: &[f32],
    x_stride: usize,
    dy: &[f32],
    dy_stride: usize,
    dw: &mut [f32],
    db: &mut [f32],
) {
    let outputs = db.len();
    let inputs = dw.len() / outputs;
    let blocks = dy.len() / dy_stride;
    for k in (0..inputs).step_by(4) {
        let rows = (inputs - k).min(4);
        for o in (0..outputs).step_by(2) {
            let mut acc = [[[0.0_f32; 8]; 2]; 4];
            for b in 0..blocks {
                // Rows past the last are the block's padding or its neighbour rows: computed, never stored.
                let first = (k.min(inputs - rows)) * LANES + b * x_stride;
                let dyb = &dy[b * dy_stride + o * LANES..][..2 * LANES];
                if rows == 4 {
                    let xb = &x[first..][..4 * LANES];
                    for half in 0..2 {
                        for j in 0..4 {
                            for i in 0..2 {
                                for l in 0..8 {
                                    acc[j][i][l] = fma::<FMA>(
                                        xb[j * LANES + half * 8 + l],
                                        dyb[i * LANES + half * 8 + l],
                                        acc[j][i][l],
                                    );
                                }
                            }
                        }
                    }
                } else {
                    for j in 0..rows {
                        let xr = &x[first + j * LANES..][..LANES];
                        for half in 0..2 {
                            for i in 0..2 {
                                for l in 0..8 {
                                    acc[j][i][l] =
                                        fma::<FMA>(xr[half * 8 + l], dyb[i * LANES + half * 8 + l], acc[j][i][l]);
                                }
                            }
                        }
                    }
                }
            }
            for j in 0..rows {
                for i in 0..2 {
                    dw[(k + j) * outputs + o + i] += sum8(&acc[j][i]);
                }
            }
        }
    }
    for (o, db) in db.iter_mut().enumerate() {
        let mut acc = [0.0_f32; 8];
        for b in 0..blocks {
            let r = row(&dy[b * dy_stride..], o);
            for l in 0..8 {
                acc[l] += r[l] + r[l + 8];
            }
        }
        *db += sum8(&acc);
    }
}
