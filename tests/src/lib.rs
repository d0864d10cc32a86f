//! What the cross-process tests share: the built programs, graphs of their own, datasets, and watchdogs.
//!
//! Nothing here computes what a stage computes: the tests start the programs that a user starts, and look at what a
//! user sees. Each graph has a run name and a folder of its own, so tests run side by side; whatever outlives its
//! watchdog is killed and fails its test.

#![allow(
    clippy::unwrap_used,
    clippy::missing_panics_doc,
    reason = "a helper of a test fails it by panicking, with a message that says what is wrong"
)]

mod graph;
mod process;
mod sets;

pub use graph::TestGraph;
pub use process::{Finished, Process};
pub use sets::{copy_checkpoint, picture_set, scenario_set};

use carff_transport::monotonic_now_ns;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What nothing takes even on a machine that is busy with other things. It ends what hangs and asserts no speed.
pub const WATCHDOG: Duration = Duration::from_secs(600);

/// The project's root.
pub fn project_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// The checkpoint that ships with the project. It must be there: a test that needs it fails without it.
pub fn shipped_checkpoint() -> PathBuf {
    let folder = project_root().join("configs/checkpoints/approaching-intersection");
    assert!(
        folder.join("manifest.json").is_file(),
        "{} holds no checkpoint: train it with `carff train configs/training/approaching-intersection.toml`",
        folder.display()
    );
    folder
}

/// The folder of the built programs: the one above this test's own.
pub fn programs() -> PathBuf {
    std::env::current_exe().unwrap().parent().and_then(Path::parent).unwrap().to_owned()
}

/// A built program. Cargo does not build the programs of other crates for a test: `make test` does.
pub fn program(name: &str) -> PathBuf {
    let program = programs().join(name);
    assert!(
        program.is_file(),
        "{} is missing: run `make test`, or first `cargo build --release --workspace --bins`",
        program.display()
    );
    program
}

/// Whether it comes true before the watchdog barks.
pub fn eventually(mut condition: impl FnMut() -> bool) -> bool {
    let deadline_ns = monotonic_now_ns() + WATCHDOG.as_nanos() as u64;
    while monotonic_now_ns() < deadline_ns {
        if condition() {
            return true;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    false
}
