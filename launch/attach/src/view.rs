//! `carff view`: the live window, a program of its own beside this one.

use crate::become_program;
use std::ffi::OsString;
use std::process::ExitCode;

/// The window's program.
const PROGRAM: &str = "carff-viewer";

/// Open the live window.
#[derive(Clone, Debug, clap::Args)]
pub struct ViewArgs {
    /// What the window's program takes: see `carff view -- --help`.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub args: Vec<OsString>,
}

/// Becomes the window's program.
pub fn run(args: &ViewArgs) -> anyhow::Result<ExitCode> {
    become_program(PROGRAM, &args.args)
}
