//! `carff view`: starts the live window, a separate program in the same folder.

use crate::become_program;
use std::process::ExitCode;

pub use carff_observe::ViewArgs;

/// The window's program.
const PROGRAM: &str = "carff-viewer";

/// Replaces this process with the window's program, which gets the same arguments.
pub fn run() -> anyhow::Result<ExitCode> {
    become_program(PROGRAM, &std::env::args_os().skip(2).collect::<Vec<_>>())
}
