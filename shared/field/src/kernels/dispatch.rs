//! The kernels compiled for each instruction set, chosen at run time.

#![allow(unsafe_code, reason = "calls of functions compiled for an instruction set that was found at run time")]

use super::activation;
use super::adam::{self, AdamStep};
#[cfg(target_arch = "x86_64")]
use super::bf16;
use super::bf16::PackedAffine;
use super::block::{Blocks, BlocksMut};
use super::dense::{self, Activation, Affine, AffineGradient};
use super::hash_grid::{self, HashGrid, Level};
use super::traverse::{self, PACKET, RayPacket, SamplePoints, Traversal};

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

/// An instruction set that this processor has: a value is only made by asking the processor.
///
/// ```
/// use carff_field::{Field, FieldConfig, InstructionSet};
/// let config = FieldConfig { log2_table_size: 10, occupancy_resolution: 16, ..FieldConfig::default() };
/// let mut field = Field::new(config, 7)?;
/// assert_eq!(field.instruction_set(), InstructionSet::detect());
/// field.set_instruction_set(InstructionSet::portable());
/// assert_eq!(field.instruction_set().name(), "portable");
/// # Ok::<(), carff_field::FieldError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InstructionSet(Set);

impl InstructionSet {
    /// Returns the best instruction set of this processor that works in f32.
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

    /// Returns the fastest instruction set of this processor for images: with products of the networks in bf16 where
    /// the processor has an instruction for them, else as [`Self::detect`].
    pub fn detect_for_images() -> Self {
        #[cfg(target_arch = "x86_64")]
        if Self::detect().0 == Set::Avx512
            && std::is_x86_feature_detected!("avx512bw")
            && std::is_x86_feature_detected!("avx512bf16")
        {
            return Self(Set::Avx512Bf16);
        }
        Self::detect()
    }

    /// Returns true if the products of the networks are in bf16.
    pub fn is_bf16(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self.0 == Set::Avx512Bf16;
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Returns the instruction set that every processor has.
    pub fn portable() -> Self {
        Self(Set::Portable)
    }

    /// Returns the name for reports.
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

/// True where the architecture always has fused multiply-add: the portable path then uses it.
const PORTABLE_FMA: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));

/// Compiles one generic body for each instruction set, and makes the function that picks one of these versions.
///
/// The literal lists the features of the version for AVX-512. It is `"avx2,fma"` for bodies whose loops over rows the
/// compiler would turn into gathers and scatters of single numbers, if it had the instructions.
macro_rules! dispatched {
    ($(#[$doc:meta])* $name:ident, $wide:literal, $module:ident::$body:ident, [$($generic:tt)*], ($($arg:ident: $ty:ty),* $(,)?)
     $(-> $result:ty)?) => {
        $(#[$doc])*
        // Inlined, the portable version would lose what its arguments promise: that slices do not overlap.
        #[inline(never)]
        #[allow(clippy::too_many_arguments, reason = "the arguments of the body")]
        pub(crate) fn $name(set: InstructionSet, $($arg: $ty),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            #[allow(clippy::too_many_arguments, reason = "the arguments of the body")]
            fn avx2($($arg: $ty),*) $(-> $result)? {
                $module::$body::<true $($generic)*>($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = $wide)]
            #[allow(clippy::too_many_arguments, reason = "the arguments of the body")]
            fn avx512($($arg: $ty),*) $(-> $result)? {
                $module::$body::<true $($generic)*>($($arg),*)
            }
            match set.0 {
                Set::Portable => $module::$body::<PORTABLE_FMA $($generic)*>($($arg),*),
                // SAFETY: `Set::Avx2` is only ever made by `detect`, after the processor reported AVX2 and FMA.
                #[cfg(target_arch = "x86_64")]
                Set::Avx2 => unsafe { avx2($($arg),*) },
                // SAFETY: `Set::Avx512` is only ever made by `detect`, after the processor reported AVX2, FMA,
                // AVX-512F and AVX-512VL; `Set::Avx512Bf16` only where `detect` makes `Set::Avx512`.
                #[cfg(target_arch = "x86_64")]
                Set::Avx512 | Set::Avx512Bf16 => unsafe { avx512($($arg),*) },
            }
        }
    };
}

dispatched!(
    dense_forward_slices, "avx2,fma,avx512f,avx512vl", dense::forward, [],
    (weights: &[f32], bias: &[f32], x: &[f32], x_stride: usize, y: &mut [f32], y_stride: usize, relu: bool)
);
dispatched!(
    bias_relu_slices, "avx2,fma", dense::bias_relu, [], (x: &[f32], bias: &[f32], y: &mut [f32], stride: usize)
);
dispatched!(
    dense_backward_input_slices, "avx2,fma,avx512f,avx512vl", dense::backward_input, [],
    (weights: &[f32], outputs: usize, dy: &[f32], dy_stride: usize, dx: &mut [f32], dx_stride: usize, rows: usize,
     relu_of: Option<&[f32]>)
);
dispatched!(
    dense_backward_weights_slices, "avx2,fma,avx512f,avx512vl", dense::backward_weights, [],
    (x: &[f32], x_stride: usize, dy: &[f32], dy_stride: usize, dw: &mut [f32], db: &mut [f32])
);
dispatched!(
    /// See [`activation::sigma_and_alpha`].
    sigma_and_alpha, "avx2,fma,avx512f,avx512vl", activation::sigma_and_alpha, [],
    (raw: Blocks<'_>, offset: f32, delta_m: &[f32], sigma: &mut [f32], one_minus_alpha: &mut [f32])
);
dispatched!(
    /// See [`activation::sigma`].
    sigma, "avx2,fma,avx512f,avx512vl", activation::sigma, [], (raw: Blocks<'_>, offset: f32, sigma: &mut [f32])
);
dispatched!(
    /// See [`activation::logistic`].
    logistic, "avx2,fma,avx512f,avx512vl", activation::logistic, [], (values: BlocksMut<'_>)
);
dispatched!(
    /// See [`hash_grid::attenuate`].
    attenuate, "avx2,fma,avx512f,avx512vl", hash_grid::attenuate, [],
    (grid: &HashGrid, widths: &[f32], block: &mut [f32])
);
dispatched!(encode2, "avx2,fma", hash_grid::encode, [, 2], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(encode4, "avx2,fma", hash_grid::encode, [, 4], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(encode8, "avx2,fma", hash_grid::encode, [, 8], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(scatter2, "avx2,fma", hash_grid::scatter, [, 2], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(scatter4, "avx2,fma", hash_grid::scatter, [, 4], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(scatter8, "avx2,fma", hash_grid::scatter, [, 8], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(
    /// See [`adam::step`].
    adam_step, "avx2,fma,avx512f,avx512vl", adam::step, [],
    (step: AdamStep, sparse: bool, parameters: &mut [f32], moments: [&mut [f32]; 2], gradients: &mut [&mut [f32]])
);
dispatched!(
    /// See [`traverse::traverse`].
    traverse, "avx2,fma,avx512f,avx512vl", traverse::traverse, [],
    (traversal: &Traversal<'_>, packet: &mut RayPacket, want: [u32; PACKET], out: &mut SamplePoints, at: usize) -> usize
);

/// Computes y = activation(W^T x + b). Blocks of `y` may have more rows than the layer has outputs.
pub(crate) fn dense_forward(
    set: InstructionSet,
    layer: Affine<'_>,
    x: Blocks<'_>,
    y: BlocksMut<'_>,
    activation: Activation,
) {
    let (relu, y_stride) = (activation == Activation::Relu, y.stride());
    dense_forward_slices(set, layer.weights, layer.bias, x.as_slice(), x.stride(), y.into_mut_slice(), y_stride, relu);
}

/// Computes y = max(x + b, 0), row by row, for blocks with one row for each bias.
pub(crate) fn bias_relu(set: InstructionSet, bias: &[f32], x: Blocks<'_>, y: BlocksMut<'_>) {
    bias_relu_slices(set, x.as_slice(), bias, y.into_mut_slice(), x.stride());
}

/// Computes the gradient by a layer's inputs, dx = W dy, for as many inputs as `layer` has weights of (a multiple of
/// 4). With the input's own activations as `relu_of`, the gradient is zero wherever they are not positive; their blocks
/// have as many rows as those of `dx`.
pub(crate) fn dense_backward_input(
    set: InstructionSet,
    layer: Affine<'_>,
    dy: Blocks<'_>,
    dx: BlocksMut<'_>,
    relu_of: Option<Blocks<'_>>,
) {
    let (outputs, dx_stride) = (layer.bias.len(), dx.stride());
    let rows = layer.weights.len() / outputs;
    let (dx, relu_of) = (dx.into_mut_slice(), relu_of.map(Blocks::as_slice));
    dense_backward_input_slices(set, layer.weights, outputs, dy.as_slice(), dy.stride(), dx, dx_stride, rows, relu_of);
}

/// Adds the gradients by a layer's weights and biases to `gradient`.
pub(crate) fn dense_backward_weights(set: InstructionSet, x: Blocks<'_>, dy: Blocks<'_>, gradient: AffineGradient<'_>) {
    let AffineGradient { weights, bias } = gradient;
    dense_backward_weights_slices(set, x.as_slice(), x.stride(), dy.as_slice(), dy.stride(), weights, bias);
}

/// See [`bf16::forward`]; writes nothing without the instruction (see [`InstructionSet::is_bf16`]).
pub(crate) fn dense_forward_bf16(
    set: InstructionSet,
    layer: PackedAffine<'_>,
    x: Blocks<'_>,
    y: BlocksMut<'_>,
    activation: Activation,
) {
    #[cfg(target_arch = "x86_64")]
    if set.0 == Set::Avx512Bf16 {
        // SAFETY: `Set::Avx512Bf16` is only ever made by `detect_for_images`, after the processor reported
        // AVX-512F, AVX-512BW and AVX-512 BF16.
        unsafe { bf16::forward(layer, x, y, activation) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (set, layer, x, y, activation);
}

/// See [`hash_grid::encode`].
pub(crate) fn encode(set: InstructionSet, grid: &HashGrid, table: &[f32], points: &[[f32; 3]], block: &mut [f32]) {
    match grid.features_per_level {
        2 => encode2(set, &grid.levels, table, points, block),
        4 => encode4(set, &grid.levels, table, points, block),
        _ => encode8(set, &grid.levels, table, points, block),
    }
}

/// See [`hash_grid::scatter`].
pub(crate) fn scatter(set: InstructionSet, grid: &HashGrid, gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]) {
    match grid.features_per_level {
        2 => scatter2(set, &grid.levels, gradient, points, block),
        4 => scatter4(set, &grid.levels, gradient, points, block),
        _ => scatter8(set, &grid.levels, gradient, points, block),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::FieldConfig;
    use crate::kernels::block::{LANES, stride};
    use crate::model::layout::hash_grid;

    // Small enough for an interpreter (`make miri`), which has no instruction set but the portable one.
    const SETS: [fn() -> InstructionSet; 2] = [InstructionSet::portable, InstructionSet::detect];

    /// Reproducible numbers between -1 and 1.
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

    /// A layer computes its matrix product, and both backward kernels the adjoints, on every path.
    #[test]
    fn layers_are_their_sums() {
        let (inputs, outputs, blocks) = (8, 4, 2);
        let (x_apart, y_apart) = (stride(inputs), stride(outputs));
        let (weights, bias) = (numbers(inputs * outputs, 1), numbers(outputs, 2));
        let (x, dy) = (numbers(blocks * x_apart, 3), numbers(blocks * y_apart, 4));
        for set in SETS.map(|set| set()) {
            let mut y = vec![0.0; blocks * y_apart];
            let layer = Affine { weights: &weights, bias: &bias };
            let (x_blocks, dy_blocks) = (Blocks::new(&x, inputs), Blocks::new(&dy, outputs));
            dense_forward(set, layer, x_blocks, BlocksMut::new(&mut y, outputs), Activation::Identity);
            let (mut dx, mut dw, mut db) = (vec![0.0; x.len()], vec![0.0; weights.len()], vec![0.0; outputs]);
            dense_backward_input(set, layer, dy_blocks, BlocksMut::new(&mut dx, inputs), None);
            dense_backward_weights(set, x_blocks, dy_blocks, AffineGradient { weights: &mut dw, bias: &mut db });
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

    /// With bf16 products a layer is the sum of the rounded numbers' products, for any number of blocks and inputs:
    /// also odd numbers, and more inputs than are packed at once. (Only where the processor has the instruction.)
    #[test]
    fn bf16_layers_are_the_sums_of_rounded_numbers() {
        let set = InstructionSet::detect_for_images();
        if !set.is_bf16() {
            eprintln!("no bf16 instruction on this processor: not tested");
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
            crate::kernels::bf16::pack(&weights, outputs, &mut pairs);
            let mut y = vec![0.0; blocks * y_apart];
            let layer = PackedAffine { pairs: &pairs, inputs, bias: &bias };
            let activation = if relu { Activation::Relu } else { Activation::Identity };
            dense_forward_bf16(set, layer, Blocks::new(&x, inputs), BlocksMut::new(&mut y, outputs), activation);
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

    /// A level is scaled by 1 / sqrt(1 + w^2 / 2) for a sample w of its cells wide; samples of no width and the block's
    /// padding keep their values.
    #[test]
    fn fine_levels_count_less_for_wide_samples() {
        let features = 4;
        let config = FieldConfig {
            levels: 3,
            features_per_level: features,
            base_resolution: 4,
            max_resolution: 64,
            ..FieldConfig::default()
        };
        let grid = hash_grid(&config);
        let before = numbers(stride(grid.levels.len() * features), 7);
        let widths = [0.0, 0.01, 0.1, 0.5];
        for set in SETS.map(|set| set()) {
            let mut block = before.clone();
            attenuate(set, &grid, &widths, &mut block);
            for (i, (found, was)) in block.iter().zip(&before).enumerate() {
                let (row, lane) = (i / LANES, i % LANES);
                let cells = grid.levels.get(row / features).map_or(0.0, |level| f64::from(level.resolution));
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
        let grid = hash_grid(&FieldConfig {
            levels: 2,
            features_per_level: features,
            log2_table_size: 6,
            base_resolution: 2,
            max_resolution: 8,
            ..FieldConfig::default()
        });
        let levels = &grid.levels;
        assert!(levels[0].dense && !levels[1].dense);
        let table = numbers(levels.iter().map(|l| l.entries).sum::<usize>() * features, 5);
        let points = [[0.3, 0.6, 0.9], [0.0, 1.0, 0.5], [1.0, 1.0, 1.0], [-3.0, 0.2, f32::NAN]];
        let gradient = numbers(levels.len() * features * LANES, 6);
        for set in SETS.map(|set| set()) {
            let mut block = vec![0.0; gradient.len()];
            encode(set, &grid, &table, &points, &mut block);
            let mut back = vec![0.0; table.len()];
            scatter(set, &grid, &mut back, &points, &gradient);
            assert!(block.iter().any(|v| *v != 0.0));
            assert!(near(dot(&table, &back), dot(&block, &gradient)), "{}", set.name());
        }
    }
}
