//! Fixtures of the cross-process tests: the built programs, graphs, datasets, and watchdogs.
//!
//! The tests start the programs as a user does, and check the visible results. Each graph has a unique run name and
//! folder, so tests can run in parallel; a process that exceeds its watchdog is killed and fails its test.

#![allow(
    clippy::unwrap_used,
    clippy::missing_panics_doc,
    reason = "a helper of a test fails it by panicking, with a message that describes the error"
)]

mod graph;
mod process;
mod sets;

pub use graph::{PATIENT, PATIENT_AND_ENDLESS, TestGraph, decisions};
pub use process::{Finished, Process};
pub use sets::{copy_checkpoint, image_set, scenario_set};

use carff_transport::monotonic_now_ns;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Time limit that only a hanging process exceeds, even on a busy machine. It does not assert a speed.
pub const WATCHDOG: Duration = Duration::from_mins(10);

/// Returns the project's root.
pub fn project_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// Returns the shipped checkpoint. A test that needs it fails if it is missing.
pub fn shipped_checkpoint() -> PathBuf {
    let folder = project_root().join("configs/checkpoints/approaching-intersection");
    assert!(
        folder.join("manifest.json").is_file(),
        "{} contains no checkpoint: train it with `carff train configs/training/approaching-intersection.toml`",
        folder.display()
    );
    folder
}

/// Returns the folder of the built programs: the one above this test's own.
pub fn programs() -> PathBuf {
    std::env::current_exe().unwrap().parent().and_then(Path::parent).unwrap().to_owned()
}

/// Returns the path of a built program. Cargo does not build other crates' programs for a test: `make test` does.
pub fn program(name: &str) -> PathBuf {
    let program = programs().join(name);
    assert!(
        program.is_file(),
        "{} is missing: run `make test`, or first `cargo build --release --workspace --bins`",
        program.display()
    );
    program
}

/// Reports that this system lacks something that the test needs. The line appears although the test passes: the test
/// harness captures only `print!` and `eprint!`.
pub fn skipped(why: &str) {
    let thread = std::thread::current();
    let _ = writeln!(std::io::stderr(), "skipped: {}: {why}", thread.name().unwrap_or("test"));
}

/// Returns true if the condition becomes true before the watchdog's limit.
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
