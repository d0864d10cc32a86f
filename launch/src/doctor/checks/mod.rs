//! Turns facts about the machine into findings. These modules do not access the machine.

mod limits;
mod logind;
mod machine;
mod programs;
mod runs;
mod shared_memory;
mod size;
#[cfg(test)]
mod testing;

pub use limits::{Allowed, bound_cores, limits};
pub use logind::{Logind, remove_ipc, remove_ipc_setting};
pub use machine::{Clock, clock, cores, disk, governor, memory, processor};
pub use programs::{libtorch, onnx_runtime, programs};
pub use runs::{RunFiles, Strays, leftovers, run_folder};
pub use shared_memory::{SharedMemory, shared_memory};
