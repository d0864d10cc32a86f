//! The kernels compiled for each instruction set, chosen at run time. With `bf16`, the only module of this crate with
//! `unsafe`.

#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
use crate::bf16;
use crate::kernels::{self, AdamStep};
use crate::layout::Level;
use crate::walk::{self, OCTET, Octet, Placed, Walk};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Set {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx512Bf16,
}

/// An instruction set that this processor is known to have: the value can only be made by asking it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InstructionSet(Set);

impl InstructionSet {
    /// The best one here that works in f32.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma");
            if avx2 && std::is_x86_feature_detected!("avx512f") && std::is_x86_feature_detected!("avx512vl") {
                return Self(Set::Avx512);
            }
            if avx2 {
                return Self(Set::Avx2);
            }
        }
        Self(Set::Portable)
    }

    /// The quickest one here, for pictures: products of the networks in bf16, where the processor has an instruction for
    /// them. Otherwise as [`Self::detect`].
    pub fn detect_for_pictures() -> Self {
        #[cfg(target_arch = "x86_64")]
        if Self::detect().0 == Set::Avx512
            && std::is_x86_feature_detected!("avx512bw")
            && std::is_x86_feature_detected!("avx512bf16")
        {
            return Self(Set::Avx512Bf16);
        }
        Self::detect()
    }

    /// Whether the networks' products are in bf16.
    pub fn is_bf16(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.0 == Set::Avx512Bf16;
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// What every processor has.
    pub fn portable() -> Self {
        Self(Set::Portable)
    }

    /// Its name, for reports.
    pub fn name(self) -> &'static str {
        match self.0 {
            Set::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Set::Avx2 => "avx2+fma",
            #[cfg(target_arch = "x86_64")]
            Set::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Set::Avx512Bf16 => "avx512+bf16",
        }
    }
}

/// Asks for an entry's cache line ahead of its use; nothing where there is no such instruction.
#[inline(always)]
pub(crate) fn prefetch<T>(table: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: prefetching reads nothing and cannot fault, whatever the address; the instruction is part of every x86-64
    // processor (SSE).
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<{ _MM_HINT_T0 }>(table.as_ptr().wrapping_add(index).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (table, index);
}

/// Fused multiply-add pays on the portable path too where the architecture always has it.
const PORTABLE_FMA: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));

/// Makes, for one generic body, its versions for each instruction set and the function that picks one. The literal is what
/// the version for AVX-512 is compiled with: `"avx2,fma"` for bodies whose loops over rows the compiler would turn into
/// gathers and scatters of single numbers, if it had the instructions.
macro_rules! dispatched {
    ($(#[$doc:meta])* $name:ident, $wide:literal, $room:ident::$body:ident, [$($generic:tt)*], ($($arg:ident: $ty:ty),* $(,)?)
     $(-> $result:ty)?) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        pub(crate) fn $name(set: InstructionSet, $($arg: $ty),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            #[allow(clippy::too_many_arguments)]
            fn avx2($($arg: $ty),*) $(-> $result)? {
                $room::$body::<true $($generic)*>($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = $wide)]
            #[allow(clippy::too_many_arguments)]
            fn avx512($($arg: $ty),*) $(-> $result)? {
                $room::$body::<true $($generic)*>($($arg),*)
            }
            match set.0 {
                Set::Portable => $room::$body::<PORTABLE_FMA $($generic)*>($($arg),*),
                // SAFETY: `Set::Avx2` is only ever made by `detect`, after the processor said that it has AVX2 and FMA.
                #[cfg(target_arch = "x86_64")]
                Set::Avx2 => unsafe { avx2($($arg),*) },
                // SAFETY: `Set::Avx512` is only ever made by `detect`, after the processor said that it has AVX2, FMA,
                // AVX-512F and AVX-512VL; `Set::Avx512Bf16` only where `detect` makes `Set::Avx512`.
                #[cfg(target_arch = "x86_64")]
                Set::Avx512 | Set::Avx512Bf16 => unsafe { avx512($($arg),*) },
            }
        }
    };
}

dispatched!(
    /// See [`kernels::dense_forward`].
    dense_forward, "avx2,fma,avx512f,avx512vl", kernels::dense_forward, [],
    (weights: &[f32], bias: &[f32], x: &[f32], x_stride: usize, y: &mut [f32], y_stride: usize, relu: bool)
);
dispatched!(
    /// See [`kernels::bias_relu`].
    bias_relu, "avx2,fma", kernels::bias_relu, [], (x: &[f32], bias: &[f32], y: &mut [f32], blocks_apart: usize)
);
dispatched!(
    /// See [`kernels::attenuate`].
    attenuate, "avx2,fma,avx512f,avx512vl", kernels::attenuate, [],
    (levels: &[Level], features_per_level: usize, widths: &[f32], block: &mut [f32])
);
dispatched!(
    /// See [`kernels::activate`].
    activate, "avx2,fma,avx512f,avx512vl", kernels::activate, [],
    (raw: &[f32], apart: usize, offset: f32, length_m: &[f32], density: &mut [f32], passes: &mut [f32])
);
dispatched!(
    /// See [`kernels::densities`].
    densities, "avx2,fma,avx512f,avx512vl", kernels::densities, [], (raw: &[f32], apart: usize, offset: f32, density: &mut [f32])
);
dispatched!(
    /// See [`kernels::logistic`].
    logistic, "avx2,fma,avx512f,avx512vl", kernels::logistic, [], (values: &mut [f32])
);
dispatched!(
    /// See [`kernels::dense_backward_input`].
    dense_backward_input, "avx2,fma,avx512f,avx512vl", kernels::dense_backward_input, [],
    (weights: &[f32], outputs: usize, dy: &[f32], dy_stride: usize, dx: &mut [f32], dx_stride: usize, rows: usize,
     relu_of: Option<&[f32]>)
);
dispatched!(
    /// See [`kernels::dense_backward_weights`].
    dense_backward_weights, "avx2,fma,avx512f,avx512vl", kernels::dense_backward_weights, [],
    (x: &[f32], x_stride: usize, dy: &[f32], dy_stride: usize, dw: &mut [f32], db: &mut [f32])
);
dispatched!(encode2, "avx2,fma", kernels::encode, [, 2], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(encode4, "avx2,fma", kernels::encode, [, 4], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(encode8, "avx2,fma", kernels::encode, [, 8], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(scatter2, "avx2,fma", kernels::scatter, [, 2], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(scatter4, "avx2,fma", kernels::scatter, [, 4], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(scatter8, "avx2,fma", kernels::scatter, [, 8], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(
    /// See [`kernels::adam`].
    adam, "avx2,fma,avx512f,avx512vl", kernels::adam, [],
    (step: AdamStep, sparse: bool, parameters: &mut [f32], first: &mut [f32], second: &mut [f32],
     gradients: &mut [&mut [f32]])
);

dispatched!(
    /// See [`walk::walk`].
    walk_octet, "avx2,fma,avx512f,avx512vl", walk::walk, [],
    (about: &Walk<'_>, octet: &mut Octet, want: [u32; OCTET], first: u32, out: &mut Placed, at: usize) -> usize
);

/// See [`bf16::dense_forward`]; without the instruction, nothing is written (see [`InstructionSet::is_bf16`]).
#[allow(clippy::too_many_arguments)]
pub(crate) fn dense_forward_bf16(
    set: InstructionSet,
    pairs: &[u32],
    inputs: usize,
    bias: &[f32],
    x: &[f32],
    x_stride: usize,
    y: &mut [f32],
    y_stride: usize,
    relu: bool,
) {
    #[cfg(target_arch = "x86_64")]
    if set.0 == Set::Avx512Bf16 {
        // SAFETY: `Set::Avx512Bf16` is only ever made by `detect_for_pictures`, after the processor said that it has
        // AVX-512F, AVX-512BW and AVX-512 BF16.
        unsafe { bf16::dense_forward(pairs, inputs, bias, x, x_stride, y, y_stride, relu) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (set, pairs, inputs, bias, x, x_stride, y, y_stride, relu);
}

/// See [`kernels::encode`]; `features_per_level` is 2, 4 or 8.
pub(crate) fn encode(
    set: InstructionSet,
    features_per_level: usize,
    levels: &[Level],
    table: &[f32],
    points: &[[f32; 3]],
    block: &mut [f32],
) {
    match features_per_level {
        2 => encode2(set, levels, table, points, block),
        4 => encode4(set, levels, table, points, block),
        _ => encode8(set, levels, table, points, block),
    }
}

/// See [`kernels::scatter`]; `features_per_level` is 2, 4 or 8.
pub(crate) fn scatter(
    set: InstructionSet,
    features_per_level: usize,
    levels: &[Level],
    gradient: &mut [f32],
    points: &[[f32; 3]],
    block: &[f32],
) {
    match features_per_level {
        2 => scatter2(set, levels, gradient, points, block),
        4 => scatter4(set, levels, gradient, points, block),
        _ => scatter8(set, levels, gradient, points, block),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::FieldConfig;
    use crate::kernels::{LANES, stride};
    use crate::layout::grid_levels;

    // Small enough for an interpreter (`make miri`), which has no instruction set but the portable one.
    const SETS: [fn() -> InstructionSet; 2] = [InstructionSet::portable, InstructionSet::detect];

    /// Numbers between -1 and 1, the same for the same seed.
    fn numbers(count: usize, seed: u32) -> Vec<f32> {
        let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(1);
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        (0..count).map(|_| next()).collect()
    }

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() <= 1e-5 * (1.0 + b.abs())
    }

    fn dot(a: &[f32], b: &[f32]) -> f64 {
        a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    }

    /// A layer is its matrix: forward as the sum says, both backward kernels its adjoints, on every path.
    #[test]
    fn layers_are_their_sums() {
        let (inputs, outputs, blocks) = (8, 4, 2);
        let (x_apart, y_apart) = (stride(inputs), stride(outputs));
        let (weights, bias) = (numbers(inputs * outputs, 1), numbers(outputs, 2));
        let (x, dy) = (numbers(blocks * x_apart, 3), numbers(blocks * y_apart, 4));
        for set in SETS.map(|set| set()) {
            let mut y = vec![0.0; blocks * y_apart];
            dense_forward(set, &weights, &bias, &x, x_apart, &mut y, y_apart, false);
            let (mut dx, mut dw, mut db) = (vec![0.0; x.len()], vec![0.0; weights.len()], vec![0.0; outputs]);
            dense_backward_input(set, &weights, outputs, &dy, y_apart, &mut dx, x_apart, inputs, None);
            dense_backward_weights(set, &x, x_apart, &dy, y_apart, &mut dw, &mut db);
            let at = |block: usize, apart: usize, row: usize, lane: usize| block * apart + row * LANES + lane;
            let columns = || (0..blocks).flat_map(|b| (0..LANES).map(move |l| (b, l)));
            for (b, l) in columns() {
                for o in 0..outputs {
                    let sum: f64 = (0..inputs)
                        .map(|i| f64::from(weights[i * outputs + o]) * f64::from(x[at(b, x_apart, i, l)]))
                        .sum();
                    let found = f64::from(y[at(b, y_apart, o, l)]);
                    assert!(near(found, sum + f64::from(bias[o])), "{}: {found} for {sum}", set.name());
                }
                for i in 0..inputs {
                    let sum: f64 = (0..outputs)
                        .map(|o| f64::from(weights[i * outputs + o]) * f64::from(dy[at(b, y_apart, o, l)]))
                        .sum();
                    assert!(near(f64::from(dx[at(b, x_apart, i, l)]), sum), "{}", set.name());
                }
            }
            for o in 0..outputs {
                let sum: f64 = columns().map(|(b, l)| f64::from(dy[at(b, y_apart, o, l)])).sum();
                assert!(near(f64::from(db[o]), sum), "{}", set.name());
                for i in 0..inputs {
                    let product = |(b, l)| f64::from(x[at(b, x_apart, i, l)]) * f64::from(dy[at(b, y_apart, o, l)]);
                    let sum: f64 = columns().map(product).sum();
                    assert!(near(f64::from(dw[i * outputs + o]), sum), "{}", set.name());
                }
            }
        }
    }

    /// With bf16 products a layer is the sum of the rounded numbers' products, for any number of blocks and inputs, odd
    /// ones and more than are packed at once among them. (Where the processor has the instruction; else nothing is tried.)
    #[test]
    fn bf16_layers_are_the_sums_of_rounded_numbers() {
        let set = InstructionSet::detect_for_pictures();
        if !set.is_bf16() {
            eprintln!("no bf16 instruction on this processor: not tried");
            return;
        }
        let rounded = |v: f32| {
            let bits = v.to_bits();
            f64::from(f32::from_bits((bits + 0x7fff + ((bits >> 16) & 1)) & 0xffff_0000))
        };
        for (inputs, outputs, blocks, relu) in
            [(1, 4, 1, false), (7, 8, 2, true), (64, 16, 7, true), (130, 4, 5, false)]
        {
            let (x_apart, y_apart) = (stride(inputs), stride(outputs));
            let (weights, bias) = (numbers(inputs * outputs, 1), numbers(outputs, 2));
            let x = numbers(blocks * x_apart, 3);
            let mut pairs = vec![0; inputs.div_ceil(2) * outputs];
            crate::bf16::pack(&weights, outputs, &mut pairs);
            let mut y = vec![0.0; blocks * y_apart];
            dense_forward_bf16(set, &pairs, inputs, &bias, &x, x_apart, &mut y, y_apart, relu);
            for (b, o, l) in (0..blocks).flat_map(|b| (0..outputs * LANES).map(move |r| (b, r / LANES, r % LANES))) {
                let sum = (0..inputs)
                    .map(|i| rounded(weights[i * outputs + o]) * rounded(x[b * x_apart + i * LANES + l]))
                    .sum::<f64>()
                    + f64::from(bias[o]);
                let found = f64::from(y[b * y_apart + o * LANES + l]);
                let wanted = if relu { sum.max(0.0) } else { sum };
                assert!(near(found, wanted), "{inputs} inputs, block {b}: {found} for {wanted}");
            }
        }
    }

    /// A level counts the less, the more of its cells a sample is wide: by 1 / sqrt(1 + w^2 / 2); a sample of no width
    /// counts in full, and so does the block's padding.
    #[test]
    fn wide_samples_see_less_of_fine_levels() {
        let features = 4;
        let config = FieldConfig {
            levels: 3,
            features_per_level: features,
            base_resolution: 4,
            max_resolution: 64,
            ..FieldConfig::default()
        };
        let levels = grid_levels(&config);
        let before = numbers(stride(levels.len() * features), 7);
        let widths = [0.0, 0.01, 0.1, 0.5];
        for set in SETS.map(|set| set()) {
            let mut block = before.clone();
            attenuate(set, &levels, features, &widths, &mut block);
            for (i, (found, was)) in block.iter().zip(&before).enumerate() {
                let (row, lane) = (i / LANES, i % LANES);
                let cells = levels.get(row / features).map_or(0.0, |level| f64::from(level.resolution));
                let w = f64::from(widths.get(lane).copied().unwrap_or(0.0)) * cells;
                let wanted = f64::from(*was) / (1.0 + 0.5 * w * w).sqrt();
                assert!(near(f64::from(*found), wanted), "{}: {i}: {found} for {wanted}", set.name());
            }
        }
    }

    /// Scattering is the adjoint of encoding, for dense and hashed levels, also at the cube's faces and outside of it.
    #[test]
    fn scattering_is_the_adjoint_of_encoding() {
        let features = 4;
        let levels = grid_levels(&FieldConfig {
            levels: 2,
            features_per_level: features,
            log2_table_size: 6,
            base_resolution: 2,
            max_resolution: 8,
            ..FieldConfig::default()
        });
        assert!(levels[0].dense && !levels[1].dense);
        let table = numbers(levels.iter().map(|l| l.entries).sum::<usize>() * features, 5);
        let points = [[0.3, 0.6, 0.9], [0.0, 1.0, 0.5], [1.0, 1.0, 1.0], [-3.0, 0.2, f32::NAN]];
        let gradient = numbers(levels.len() * features * LANES, 6);
        for set in SETS.map(|set| set()) {
            let mut block = vec![0.0; gradient.len()];
            encode(set, features, &levels, &table, &points, &mut block);
            let mut back = vec![0.0; table.len()];
            scatter(set, features, &levels, &mut back, &points, &gradient);
            assert!(block.iter().any(|v| *v != 0.0));
            assert!(near(dot(&table, &back), dot(&block, &gradient)), "{}", set.name());
        }
    }
}
