//! The kernels compiled for each instruction set, chosen at run time. The only module of this crate with `unsafe`.

#![allow(unsafe_code)]

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
}

/// An instruction set that this processor is known to have: the value can only be made by asking it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InstructionSet(Set);

impl InstructionSet {
    /// The best one here.
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
        }
    }
}

/// Asks for a value's cache line ahead of its use; nothing where there is no such instruction.
#[inline(always)]
pub(crate) fn prefetch<T>(value: &T) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: prefetching reads nothing and cannot fault, and the address is that of a live reference; the instruction
    // is part of every x86-64 processor (SSE).
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// Fused multiply-add pays on the portable path too where the architecture always has it.
const PORTABLE_FMA: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));

/// Makes, for one generic body, its versions for each instruction set and the function that picks one.
macro_rules! dispatched {
    ($(#[$doc:meta])* $name:ident, $room:ident::$body:ident, [$($generic:tt)*], ($($arg:ident: $ty:ty),* $(,)?)
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
            #[target_feature(enable = "avx2,fma,avx512f,avx512vl")]
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
                // AVX-512F and AVX-512VL.
                #[cfg(target_arch = "x86_64")]
                Set::Avx512 => unsafe { avx512($($arg),*) },
            }
        }
    };
}

dispatched!(
    /// See [`kernels::dense_forward`].
    dense_forward, kernels::dense_forward, [],
    (weights: &[f32], bias: &[f32], x: &[f32], x_stride: usize, y: &mut [f32], y_stride: usize, relu: bool)
);
dispatched!(
    /// See [`kernels::bias_relu`].
    bias_relu, kernels::bias_relu, [], (x: &[f32], bias: &[f32], y: &mut [f32], blocks_apart: usize)
);
dispatched!(
    /// See [`kernels::activate`].
    activate, kernels::activate, [],
    (raw: &[f32], apart: usize, offset: f32, length_m: &[f32], density: &mut [f32], passes: &mut [f32])
);
dispatched!(
    /// See [`kernels::densities`].
    densities, kernels::densities, [], (raw: &[f32], apart: usize, offset: f32, density: &mut [f32])
);
dispatched!(
    /// See [`kernels::dense_backward_input`].
    dense_backward_input, kernels::dense_backward_input, [],
    (weights: &[f32], outputs: usize, dy: &[f32], dy_stride: usize, dx: &mut [f32], dx_stride: usize, rows: usize,
     relu_of: Option<&[f32]>)
);
dispatched!(
    /// See [`kernels::dense_backward_weights`].
    dense_backward_weights, kernels::dense_backward_weights, [],
    (x: &[f32], x_stride: usize, dy: &[f32], dy_stride: usize, dw: &mut [f32], db: &mut [f32])
);
dispatched!(encode2, kernels::encode, [, 2], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(encode4, kernels::encode, [, 4], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(encode8, kernels::encode, [, 8], (levels: &[Level], table: &[f32], points: &[[f32; 3]], block: &mut [f32]));
dispatched!(scatter2, kernels::scatter, [, 2], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(scatter4, kernels::scatter, [, 4], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(scatter8, kernels::scatter, [, 8], (levels: &[Level], gradient: &mut [f32], points: &[[f32; 3]], block: &[f32]));
dispatched!(
    /// See [`kernels::adam`].
    adam, kernels::adam, [],
    (step: AdamStep, sparse: bool, parameters: &mut [f32], first: &mut [f32], second: &mut [f32],
     gradients: &mut [&mut [f32]])
);

dispatched!(
    /// See [`walk::walk`].
    walk_octet, walk::walk, [],
    (about: &Walk<'_>, octet: &mut Octet, want: [u32; OCTET], first: u32, out: &mut Placed, at: usize) -> usize
);

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
