//! Prefetching of table entries.

#![allow(unsafe_code, reason = "the prefetch instruction")]

/// Asks for an entry's cache line ahead of its use; does nothing on processors without such an instruction.
#[inline(always)]
pub(super) fn prefetch<T>(table: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: prefetching reads nothing and cannot fault, at any address; the instruction is part of every x86-64
    // processor (SSE).
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<{ _MM_HINT_T0 }>(table.as_ptr().wrapping_add(index).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (table, index);
}
