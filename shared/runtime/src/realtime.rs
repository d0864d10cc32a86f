//! System settings from the graph file for one process: processors, priority, resident memory. If the system refuses a
//! setting, the stage logs a warning and continues without it.

use carff_config::StageConfig;
use rustix::process::{Resource, getrlimit};
use std::io;

/// Distance of touched addresses, bytes: no page is smaller.
const PAGE_BYTES: usize = 4096;

/// Sets processors and scheduling policy of the calling thread; threads that it starts inherit them.
pub(crate) fn schedule(settings: &StageConfig) {
    if !settings.cpus.is_empty() {
        warn_if_refused("cpus", pin(&settings.cpus));
    }
    if let Some(priority) = settings.fifo_priority {
        warn_if_refused("fifo_priority", use_fifo(priority));
    }
}

/// Sets the niceness of the calling thread; threads that it starts afterwards inherit it.
pub(crate) fn renice(nice: Option<i32>) {
    if let Some(nice) = nice {
        warn_if_refused("nice", rustix::process::setpriority_process(None, nice).map_err(Into::into));
    }
}

/// Gives back what loading the models has left in the heap, or touches the heap; then locks memory.
pub(crate) fn settle(settings: &StageConfig) {
    if settings.prefault_mb == 0 {
        trim_heap();
    } else {
        prefault(settings.prefault_mb as usize * (1 << 20));
    }
    if settings.lock_memory {
        warn_if_refused("lock_memory", lock_memory());
    }
}

/// Returns free pages of the heap to the system: 5 MB of the encoder, whose copies of the weights were built there.
fn trim_heap() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        // SAFETY: the call only returns pages that no allocation uses, and may be made at any time from any thread.
        unsafe { libc::malloc_trim(0) };
    }
}

fn warn_if_refused(what: &str, result: io::Result<()>) {
    if let Err(error) = result {
        tracing::warn!(%error, "the system refuses the stage's setting `{what}`; the stage continues without it");
    }
}

fn pin(cpus: &[u32]) -> io::Result<()> {
    let mut set = rustix::thread::CpuSet::new();
    for &cpu in cpus {
        set.set(cpu as usize);
    }
    Ok(rustix::thread::sched_setaffinity(None, &set)?)
}

fn use_fifo(priority: u32) -> io::Result<()> {
    // SAFETY: a plain struct of integers, for which all zeros is a value.
    let mut parameters: libc::sched_param = unsafe { std::mem::zeroed() };
    parameters.sched_priority = priority as libc::c_int;
    // SAFETY: the pointer is to a live struct that the call only reads; 0 names the calling thread.
    let result = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const parameters) };
    if result == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// Locks current and future memory; only current memory if there is a limit, because a later allocation beyond it would
/// fail.
fn lock_memory() -> io::Result<()> {
    use rustix::mm::MlockAllFlags;
    let unlimited = getrlimit(Resource::Memlock).current.is_none();
    let later = if unlimited { MlockAllFlags::FUTURE } else { MlockAllFlags::empty() };
    Ok(rustix::mm::mlockall(MlockAllFlags::CURRENT | later)?)
}

/// Allocates and touches heap memory, and frees it to the allocator, which keeps blocks of this size for later
/// requests.
fn prefault(bytes: usize) {
    /// Size of blocks that the allocator takes from its heap; it would map and unmap larger ones.
    const BLOCK_BYTES: usize = 64 << 10;
    let mut blocks: Vec<Vec<u8>> = Vec::with_capacity(bytes / BLOCK_BYTES + 1);
    for _ in 0..bytes.div_ceil(BLOCK_BYTES) {
        let mut block = vec![0_u8; BLOCK_BYTES];
        for place in (0..BLOCK_BYTES).step_by(PAGE_BYTES) {
            block[place] = std::hint::black_box(1);
        }
        blocks.push(block);
    }
    drop(blocks);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Available settings are active afterwards; unavailable ones cause a warning and change nothing.
    #[test]
    fn what_is_asked_for_is_in_force_or_warned_of() {
        // A separate thread, because the settings apply to a thread.
        std::thread::spawn(|| {
            let all = rustix::thread::sched_getaffinity(None).unwrap();
            let first = (0..1024).find(|&cpu| all.is_set(cpu)).unwrap();
            schedule(&StageConfig { cpus: vec![first as u32], ..StageConfig::default() });
            renice(Some(19));
            let pinned = rustix::thread::sched_getaffinity(None).unwrap();
            assert_eq!((pinned.count(), pinned.is_set(first)), (1, true));
            assert_eq!(rustix::process::getpriority_process(None).unwrap(), 19);
            // No machine has this processor.
            schedule(&StageConfig { cpus: vec![1023], fifo_priority: Some(99), ..StageConfig::default() });
            assert!(rustix::thread::sched_getaffinity(None).unwrap().is_set(first));
            settle(&StageConfig { prefault_mb: 2, ..StageConfig::default() });
        })
        .join()
        .unwrap();
    }
}
