//! The inner loops, as plain generic bodies that vectorise when compiled for a wide instruction set.
//!
//! Activations are blocked: 16 samples (columns) at a time, each block holds `rows` rows of 16 numbers one after the
//! other, so that a block is read front to back. Blocks are `stride(rows)` apart: one row of padding keeps equal rows
//! of neighbouring blocks out of the same cache set.

use crate::layout::Level;
use crate::math::{exp, fma};

/// Samples of one block.
pub(crate) const LANES: usize = 16;

/// Numbers between two blocks of `rows` rows.
pub(crate) const fn stride(rows: usize) -> usize {
    rows * LANES + LANES
}

#[inline(always)]
fn row(block: &[f32], r: usize) -> &[f32; LANES] {
    block[r * LANES..].first_chunk().expect("a block holds all its rows")
}

/// One fully connected layer over `blocks` blocks: y = W^T x + b, with ReLU if asked.
/// `weights` is `[inputs][outputs]`; x blocks are `x_stride` apart, y blocks `y_stride`.
#[inline(always)]
pub(crate) fn dense_forward<const FMA: bool>(
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
            for (yr, a) in yo.as_chunks_mut::<LANES>().0.iter_mut().zip(&acc) {
                if relu {
                    for l in 0..LANES {
                        yr[l] = a[l].max(0.0);
                    }
                } else {
                    *yr = *a;
                }
            }
        }
    }
}

/// Gradient by a layer's input: dx = W dy for the first `rows` inputs (a multiple of 4), zero where `relu_of` (the
/// input's own activations, same layout as dx) is not positive.
#[inline(always)]
pub(crate) fn dense_backward_input<const FMA: bool>(
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

/// Gradient by a layer's weights and biases, added to `dw` (`[inputs][outputs]`) and `db`.
#[inline(always)]
pub(crate) fn dense_backward_weights<const FMA: bool>(
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

/// The eight corners of a point's cell: entry numbers and blend weights.
#[inline(always)]
fn corners(level: &Level, q: [f32; 3]) -> ([usize; 8], [f32; 8]) {
    let n = level.resolution;
    let scaled = q.map(|v| v.clamp(0.0, 1.0) * n as f32);
    let cell = scaled.map(|v| (v as u32).min(n - 1));
    let f = [0, 1, 2].map(|i| scaled[i] - cell[i] as f32);
    let mut index = [0_usize; 8];
    if level.dense {
        let side = n + 1;
        let base = (cell[2] * side + cell[1]) * side + cell[0];
        let (sy, sz) = (side, side * side);
        for (c, at) in index.iter_mut().enumerate() {
            let c = c as u32;
            *at = (base + (c & 1) + ((c >> 1) & 1) * sy + (c >> 2) * sz) as usize + level.first;
        }
    } else {
        const PY: u32 = 2_654_435_761;
        const PZ: u32 = 805_459_861;
        let mask = level.entries as u32 - 1;
        let x = [cell[0], cell[0] + 1];
        let y = [cell[1].wrapping_mul(PY), (cell[1] + 1).wrapping_mul(PY)];
        let z = [cell[2].wrapping_mul(PZ), (cell[2] + 1).wrapping_mul(PZ)];
        for (c, at) in index.iter_mut().enumerate() {
            *at = ((x[c & 1] ^ y[(c >> 1) & 1] ^ z[c >> 2]) & mask) as usize + level.first;
        }
    }
    let wx = [1.0 - f[0], f[0]];
    let wy = [1.0 - f[1], f[1]];
    let wz = [1.0 - f[2], f[2]];
    let mut weight = [0.0_f32; 8];
    for (c, w) in weight.iter_mut().enumerate() {
        *w = wx[c & 1] * (wy[(c >> 1) & 1] * wz[c >> 2]);
    }
    (index, weight)
}

/// Features of up to 16 points into one block (rows = levels x F); lanes past the last point are zeroed.
#[inline(always)]
pub(crate) fn encode<const FMA: bool, const F: usize>(
    levels: &[Level],
    table: &[f32],
    points: &[[f32; 3]],
    block: &mut [f32],
) {
    let table = table.as_chunks::<F>().0;
    for (level, rows) in levels.iter().zip(block.chunks_exact_mut(F * LANES)) {
        for l in 0..LANES {
            let mut sum = [0.0_f32; F];
            if let Some(q) = points.get(l) {
                let (index, weight) = corners(level, *q);
                for c in 0..8 {
                    let entry = &table[index[c]];
                    for f in 0..F {
                        sum[f] = fma::<FMA>(entry[f], weight[c], sum[f]);
                    }
                }
            }
            for f in 0..F {
                rows[f * LANES + l] = sum[f];
            }
        }
    }
}

/// Backward of `encode`: adds the features' gradients to the table's.
#[inline(always)]
pub(crate) fn scatter<const FMA: bool, const F: usize>(
    levels: &[Level],
    gradient: &mut [f32],
    points: &[[f32; 3]],
    block: &[f32],
) {
    let gradient = gradient.as_chunks_mut::<F>().0;
    for (level, rows) in levels.iter().zip(block.chunks_exact(F * LANES)) {
        for (l, q) in points.iter().enumerate() {
            let mut d = [0.0_f32; F];
            for f in 0..F {
                d[f] = rows[f * LANES + l];
            }
            let (index, weight) = corners(level, *q);
            for c in 0..8 {
                let entry = &mut gradient[index[c]];
                for f in 0..F {
                    entry[f] = fma::<FMA>(d[f], weight[c], entry[f]);
                }
            }
        }
    }
}

/// Density of one row of raw outputs: exp(raw + offset), 1/metre.
#[inline(always)]
pub(crate) fn activate_density(raw: &[f32; LANES], offset: f32, out: &mut [f32; LANES]) {
    for l in 0..LANES {
        out[l] = exp((raw[l] + offset).min(15.0));
    }
}

/// The numbers of one Adam step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdamStep {
    /// Learning rate with the bias corrections folded in.
    pub rate: f32,
    pub beta1: f32,
    pub beta2: f32,
    /// Epsilon, scaled like the second moment.
    pub epsilon: f32,
    pub decay: f32,
}

/// Adam over `parameters` with gradients summed over `gradients` (which are zeroed), in groups of `group` numbers:
/// groups with no gradient at all are left alone when `sparse`.
#[inline(always)]
pub(crate) fn adam<const FMA: bool>(
    step: AdamStep,
    sparse: bool,
    parameters: &mut [f32],
    first: &mut [f32],
    second: &mut [f32],
    gradients: &mut [&mut [f32]],
) {
    const G: usize = 8;
    let (head, tail) = parameters.as_chunks_mut::<G>();
    let n = head.len();
    for (i, p) in head.iter_mut().enumerate() {
        let at = i * G;
        let mut g = [0.0_f32; G];
        for shard in gradients.iter_mut() {
            let s: &mut [f32; G] = (&mut shard[at..at + G]).try_into().expect("G numbers");
            for l in 0..G {
                g[l] += s[l];
            }
        }
        if sparse {
            let mut any = 0_u32;
            for v in &g {
                any |= v.to_bits() & 0x7fff_ffff;
            }
            if any == 0 {
                continue;
            }
        }
        for shard in gradients.iter_mut() {
            shard[at..at + G].fill(0.0);
        }
        let m: &mut [f32; G] = (&mut first[at..at + G]).try_into().expect("G numbers");
        let v: &mut [f32; G] = (&mut second[at..at + G]).try_into().expect("G numbers");
        for l in 0..G {
            let gl = fma::<FMA>(step.decay, p[l], g[l]);
            let live = !sparse || g[l] != 0.0;
            let ml = fma::<FMA>(step.beta1, m[l], (1.0 - step.beta1) * gl);
            let vl = fma::<FMA>(step.beta2, v[l], (1.0 - step.beta2) * gl * gl);
            let pl = p[l] - step.rate * ml / (vl.sqrt() + step.epsilon);
            m[l] = if live { ml } else { m[l] };
            v[l] = if live { vl } else { v[l] };
            p[l] = if live { pl } else { p[l] };
        }
    }
    for (i, p) in tail.iter_mut().enumerate() {
        let at = n * G + i;
        let mut g = 0.0;
        for shard in gradients.iter_mut() {
            g += std::mem::take(&mut shard[at]);
        }
        if sparse && g == 0.0 {
            continue;
        }
        g += step.decay * *p;
        first[at] = step.beta1 * first[at] + (1.0 - step.beta1) * g;
        second[at] = step.beta2 * second[at] + (1.0 - step.beta2) * g * g;
        *p -= step.rate * first[at] / (second[at].sqrt() + step.epsilon);
    }
}
