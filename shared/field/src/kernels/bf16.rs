//! Dense layers with bf16 products and f32 sums, on processors with the instruction for it (AVX-512 BF16, VDPBF16PS).
//!
//! A 32-bit lane of the instruction holds two neighbouring inputs of one sample, and two weights: the products of both
//! are added to the lane's f32 sum.

#![allow(unsafe_code, reason = "instructions that only some processors have")]

#[cfg(target_arch = "x86_64")]
use super::block::{Blocks, BlocksMut, LANES};
#[cfg(target_arch = "x86_64")]
use super::dense::Activation;
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{
    __m512, __m512bh, __m512i, _mm512_cvtne2ps_pbh, _mm512_dpbf16_ps, _mm512_loadu_ps, _mm512_max_ps,
    _mm512_permutexvar_epi16, _mm512_set1_epi32, _mm512_set1_ps, _mm512_setzero_ps, _mm512_setzero_si512,
    _mm512_storeu_ps,
};

/// Pairs of inputs that are packed at once: they stay in the first-level cache.
#[cfg(target_arch = "x86_64")]
const PAIRS: usize = 32;
/// Outputs that are summed together.
#[cfg(target_arch = "x86_64")]
const TILE: usize = 4;

/// The weights of a layer as [`pack`] leaves them, and its biases.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "only the kernel for x86-64 reads them"))]
pub(crate) struct PackedAffine<'a> {
    pub pairs: &'a [u32],
    pub inputs: usize,
    pub bias: &'a [f32],
}

/// Packs weights `[inputs][outputs]` to pairs `[inputs / 2][outputs]`, the even input in the low half, rounded to
/// nearest even. An odd last input is paired with zero.
pub(crate) fn pack(weights: &[f32], outputs: usize, pairs: &mut [u32]) {
    let rounded = |v: f32| {
        let bits = v.to_bits();
        bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16
    };
    for (rows, pairs) in weights.chunks(2 * outputs).zip(pairs.chunks_exact_mut(outputs)) {
        let (even, odd) = rows.split_at(outputs);
        for (o, pair) in pairs.iter_mut().enumerate() {
            *pair = rounded(even[o]) | odd.get(o).map_or(0, |v| rounded(*v) << 16);
        }
    }
}

/// As [`super::dense::forward`], with packed weights.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(crate) fn forward(layer: PackedAffine<'_>, x: Blocks<'_>, mut y: BlocksMut<'_>, activation: Activation) {
    let (x_stride, y_stride) = (x.stride(), y.stride());
    let blocks = x.count().min(y.count());
    let (x, y) = (x.as_slice(), y.as_mut_slice());
    let mut at = 0;
    while at < blocks {
        let (x, y) = ((&x[at * x_stride..], x_stride), (&mut y[at * y_stride..], y_stride));
        at += match blocks - at {
            1 => tile::<1>(layer, x, y, activation),
            2 | 3 => tile::<2>(layer, x, y, activation),
            _ => tile::<4>(layer, x, y, activation),
        };
    }
}

/// The same for `B` blocks, given with their strides; returns `B`.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn tile<const B: usize>(
    layer: PackedAffine<'_>,
    (x, x_stride): (&[f32], usize),
    (y, y_stride): (&mut [f32], usize),
    activation: Activation,
) -> usize {
    let PackedAffine { pairs, inputs, bias } = layer;
    let relu = activation == Activation::Relu;
    let outputs = bias.len();
    let mut packed = [[_mm512_setzero_si512(); B]; PAIRS];
    let mut done = 0;
    while done < inputs {
        let rows = (inputs - done).min(2 * PAIRS);
        for (k, packed) in packed[..rows.div_ceil(2)].iter_mut().enumerate() {
            for (b, packed) in packed.iter_mut().enumerate() {
                let row = |r: usize| &x[b * x_stride + (done + r) * LANES..];
                let odd = if 2 * k + 1 < rows { load(row(2 * k + 1)) } else { _mm512_setzero_ps() };
                *packed = pair_up(load(row(2 * k)), odd);
            }
        }
        let weights = &pairs[done / 2 * outputs..];
        for o in (0..outputs).step_by(TILE) {
            let mut sums = [[_mm512_setzero_ps(); B]; TILE];
            for (j, sums) in sums.iter_mut().enumerate() {
                for (b, sum) in sums.iter_mut().enumerate() {
                    let before = done > 0;
                    *sum =
                        if before { load(&y[b * y_stride + (o + j) * LANES..]) } else { _mm512_set1_ps(bias[o + j]) };
                }
            }
            for (x, w) in packed[..rows.div_ceil(2)].iter().zip(weights.chunks_exact(outputs)) {
                let w: &[u32; TILE] = w[o..].first_chunk().expect("outputs are a multiple of 4");
                for (w, sums) in w.iter().zip(&mut sums) {
                    let w = halves(_mm512_set1_epi32(*w as i32));
                    for (x, sum) in x.iter().zip(sums) {
                        *sum = _mm512_dpbf16_ps(*sum, halves(*x), w);
                    }
                }
            }
            let last = done + rows == inputs;
            for (j, sums) in sums.iter().enumerate() {
                for (b, sum) in sums.iter().enumerate() {
                    let sum = if relu && last { _mm512_max_ps(*sum, _mm512_setzero_ps()) } else { *sum };
                    store(sum, &mut y[b * y_stride + (o + j) * LANES..]);
                }
            }
        }
        done += rows;
    }
    B
}

/// Rounds two rows to bf16 and interleaves them lane by lane, the first in the low halves.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pair_up(even: __m512, odd: __m512) -> __m512i {
    const ORDER: [u16; 32] = {
        let mut order = [0; 32];
        let mut l = 0;
        while l < LANES {
            order[2 * l] = l as u16;
            order[2 * l + 1] = (LANES + l) as u16;
            l += 1;
        }
        order
    };
    // SAFETY: both are 512 bits, and every bit pattern is 32 whole numbers.
    let order = unsafe { std::mem::transmute::<[u16; 32], __m512i>(ORDER) };
    let rows = _mm512_cvtne2ps_pbh(odd, even);
    // SAFETY: as above.
    let rows = unsafe { std::mem::transmute::<__m512bh, __m512i>(rows) };
    _mm512_permutexvar_epi16(order, rows)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn halves(bits: __m512i) -> __m512bh {
    // SAFETY: both are 512 bits, and every bit pattern is 32 numbers in bf16.
    unsafe { std::mem::transmute::<__m512i, __m512bh>(bits) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn load(row: &[f32]) -> __m512 {
    let row: &[f32; LANES] = row.first_chunk().expect("a block holds all its rows");
    // SAFETY: the reference is to 16 numbers, and the load asks for no alignment.
    unsafe { _mm512_loadu_ps(row.as_ptr()) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn store(sum: __m512, row: &mut [f32]) {
    let row: &mut [f32; LANES] = row.first_chunk_mut().expect("a block holds all its rows");
    // SAFETY: the reference is to 16 numbers that nobody else reads or writes, and the store asks for no alignment.
    unsafe { _mm512_storeu_ps(row.as_mut_ptr(), sum) }
}
