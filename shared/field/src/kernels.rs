//! The inner loops, as plain generic bodies that vectorise when compiled for a wide instruction set.
//!
//! Activations are blocked: 16 samples (columns) at a time, each block holds `rows` rows of 16 numbers one after the
//! other, so that a block is read front to back. Blocks are `stride(rows)` apart: one row of padding keeps equal rows
//! of neighbouring blocks out of the same cache set.

// Loops over lanes by index: that is the form which vectorises, and all of a loop's arrays read alike.
#![allow(clippy::needless_range_loop, clippy::too_many_arguments)]

use crate::dispatch::prefetch;
use crate::layout::Level;
use crate::math::{exp, fma, sigmoid};

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

/// One fully connected layer over `blocks` blocks: y = W^T x + b, `relu` clamps it from below at zero.
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
            if relu {
                // Row by row and not in a loop: see `dispatched`.
                let least = |a: &[f32; LANES]| a.map(|v| v.max(0.0));
                acc = [least(&acc[0]), least(&acc[1]), least(&acc[2]), least(&acc[3])];
            }
            yo.copy_from_slice(acc.as_flattened());
        }
    }
}

/// y = max(x + b, 0), row by row; x and y blocks are `blocks_apart` apart.
#[inline(always)]
pub(crate) fn bias_relu<const FMA: bool>(x: &[f32], bias: &[f32], y: &mut [f32], blocks_apart: usize) {
    for (xb, yb) in x.chunks_exact(blocks_apart).zip(y.chunks_exact_mut(blocks_apart)) {
        for ((xr, yr), b) in xb.as_chunks::<LANES>().0.iter().zip(yb.as_chunks_mut::<LANES>().0).zip(bias) {
            for l in 0..LANES {
                yr[l] = (xr[l] + b).max(0.0);
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

/// For 16 points at once: entry numbers and blend weights of the eight corners of each one's cell, `[corner][lane]`.
/// `points` is shorter than 16 only at the end; the rest of the lanes stand at the cube's corner.
#[inline(always)]
fn corners(level: &Level, points: &[[f32; LANES]; 3], index: &mut [[u32; LANES]; 8], weight: &mut [[f32; LANES]; 8]) {
    const PY: u32 = 2_654_435_761;
    const PZ: u32 = 805_459_861;
    let n = level.resolution;
    let scale = n as f32;
    let mut low = [[0_u32; LANES]; 3];
    let mut part = [[0.0_f32; LANES]; 3];
    for a in 0..3 {
        for l in 0..LANES {
            let scaled = points[a][l] * scale;
            // Below 2^23: adding it leaves the whole part in the low bits. (Rounding by truncation of a value >= 0.)
            let cell = scaled.floor().min(scale - 1.0);
            low[a][l] = (cell + 8_388_608.0).to_bits() & 0x007f_ffff;
            part[a][l] = scaled - cell;
        }
    }
    let first = level.first as u32;
    if level.dense {
        let side = n + 1;
        for l in 0..LANES {
            low[0][l] = (low[2][l] * side + low[1][l]) * side + low[0][l] + first;
        }
        for c in 0..8_u32 {
            let offset = (c & 1) + ((c >> 1) & 1) * side + (c >> 2) * side * side;
            for l in 0..LANES {
                index[c as usize][l] = low[0][l] + offset;
            }
        }
    } else {
        let mask = level.entries as u32 - 1;
        for l in 0..LANES {
            low[1][l] = low[1][l].wrapping_mul(PY);
            low[2][l] = low[2][l].wrapping_mul(PZ);
        }
        for c in 0..8_u32 {
            let (dx, dy, dz) = (c & 1, ((c >> 1) & 1).wrapping_mul(PY), (c >> 2).wrapping_mul(PZ));
            for l in 0..LANES {
                let hash = (low[0][l] + dx) ^ low[1][l].wrapping_add(dy) ^ low[2][l].wrapping_add(dz);
                index[c as usize][l] = (hash & mask) + first;
            }
        }
    }
    for c in 0..8 {
        for l in 0..LANES {
            let x = if c & 1 == 1 { part[0][l] } else { 1.0 - part[0][l] };
            let y = if c & 2 == 2 { part[1][l] } else { 1.0 - part[1][l] };
            let z = if c & 4 == 4 { part[2][l] } else { 1.0 - part[2][l] };
            weight[c][l] = x * (y * z);
        }
    }
}

/// Points lane by lane, brought into the cube (NaN goes to its corner).
#[inline(always)]
fn lanes_of(points: &[[f32; 3]]) -> [[f32; LANES]; 3] {
    let mut lanes = [[0.0; LANES]; 3];
    for (l, q) in points.iter().enumerate().take(LANES) {
        for a in 0..3 {
            lanes[a][l] = if q[a].is_nan() { 0.0 } else { q[a].clamp(0.0, 1.0) };
        }
    }
    lanes
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
    let count = points.len().min(LANES);
    let points = lanes_of(points);
    let mut index = [[0_u32; LANES]; 8];
    let mut weight = [[0.0_f32; LANES]; 8];
    for (level, rows) in levels.iter().zip(block.chunks_exact_mut(F * LANES)) {
        corners(level, &points, &mut index, &mut weight);
        // All at once, so that the misses overlap: the gathers below would wait for them a few at a time.
        for c in 0..8 {
            for l in 0..count {
                prefetch(table, index[c][l] as usize);
            }
        }
        let mut sums = [[0.0_f32; F]; LANES];
        for l in 0..count {
            // All eight before the sums: a check between them would keep the sums from being vectors.
            let entries: [&[f32; F]; 8] = std::array::from_fn(|c| &table[index[c][l] as usize]);
            let mut sum = [0.0_f32; F];
            for c in 0..8 {
                for f in 0..F {
                    sum[f] = fma::<FMA>(entries[c][f], weight[c][l], sum[f]);
                }
            }
            sums[l] = sum;
        }
        for f in 0..F {
            for l in 0..LANES {
                rows[f * LANES + l] = sums[l][f];
            }
        }
    }
}

/// Weakens one block's features, level by level, where a lane's sample is wider than the level's cells: by
/// 1 / sqrt(1 + w^2 / 2) for a width of w cells. That is Zip-NeRF's erf(1 / sqrt(8 s^2)) (Barron et al. 2023, section 3),
/// within 0.11, for the deviation s = w / sqrt(12) of what is spread evenly over w. `widths` are in sides of the unit cube, one a
/// lane. It is its own adjoint.
#[inline(always)]
pub(crate) fn attenuate<const FMA: bool>(
    levels: &[Level],
    features_per_level: usize,
    widths: &[f32],
    block: &mut [f32],
) {
    let mut width = [0.0_f32; LANES];
    for (to, from) in width.iter_mut().zip(widths) {
        *to = *from;
    }
    let mut weight = [0.0_f32; LANES];
    for (level, rows) in levels.iter().zip(block.chunks_exact_mut(features_per_level * LANES)) {
        let cells = level.resolution as f32;
        for l in 0..LANES {
            let w = width[l] * cells;
            weight[l] = 1.0 / fma::<FMA>(0.5 * w, w, 1.0).sqrt();
        }
        for row in rows.as_chunks_mut::<LANES>().0 {
            for l in 0..LANES {
                row[l] *= weight[l];
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
    let count = points.len().min(LANES);
    let points = lanes_of(points);
    let mut index = [[0_u32; LANES]; 8];
    let mut weight = [[0.0_f32; LANES]; 8];
    for (level, rows) in levels.iter().zip(block.chunks_exact(F * LANES)) {
        corners(level, &points, &mut index, &mut weight);
        for c in 0..8 {
            for l in 0..count {
                prefetch(gradient, index[c][l] as usize);
            }
        }
        for l in 0..count {
            let mut d = [0.0_f32; F];
            for f in 0..F {
                d[f] = rows[f * LANES + l];
            }
            for c in 0..8 {
                let entry = &mut gradient[index[c][l] as usize];
                for f in 0..F {
                    entry[f] = fma::<FMA>(d[f], weight[c][l], entry[f]);
                }
            }
        }
    }
}

/// From raw outputs (row 0 of each block, blocks `apart` from each other) to densities exp(raw + offset), 1/metre, and to
/// the share of light that passes each sample's length, metres.
#[inline(always)]
pub(crate) fn activate<const FMA: bool>(
    raw: &[f32],
    apart: usize,
    offset: f32,
    length_m: &[f32],
    density: &mut [f32],
    passes: &mut [f32],
) {
    let rows = density.as_chunks_mut::<LANES>().0.iter_mut().zip(passes.as_chunks_mut::<LANES>().0);
    for ((block, length), (density, passes)) in raw.chunks_exact(apart).zip(length_m.as_chunks::<LANES>().0).zip(rows) {
        let raw = row(block, 0);
        for l in 0..LANES {
            density[l] = exp((raw[l] + offset).min(15.0));
            passes[l] = exp(-density[l] * length[l]);
        }
    }
}

/// The densities alone; the last block may be needed in part.
#[inline(always)]
pub(crate) fn densities<const FMA: bool>(raw: &[f32], apart: usize, offset: f32, density: &mut [f32]) {
    for (block, out) in raw.chunks_exact(apart).zip(density.chunks_mut(LANES)) {
        let raw = row(block, 0);
        let mut lanes = [0.0; LANES];
        for l in 0..LANES {
            lanes[l] = exp((raw[l] + offset).min(15.0));
        }
        out.copy_from_slice(&lanes[..out.len()]);
    }
}

/// The logistic function of every number.
#[inline(always)]
pub(crate) fn logistic<const FMA: bool>(values: &mut [f32]) {
    for row in values.as_chunks_mut::<LANES>().0 {
        for l in 0..LANES {
            row[l] = sigmoid(row[l]);
        }
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
