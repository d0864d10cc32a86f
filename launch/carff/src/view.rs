//! `carff view`: starts the live window, a separate program in the same folder.

use crate::become_program;
use std::ffi::OsString;
use std::process::ExitCode;

/// The window's program.
const PROGRAM: &str = "carff-viewer";

/// Open the live window.
#[derive(Clone, Debug, clap::Args)]
pub struct ViewArgs {
    /// Arguments of the window's program: see `carff view -- --help`.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub args: Vec<OsString>,
}

/// Replaces this process with the window's program.
pub fn run(args: &ViewArgs) -> anyhow::Result<ExitCode> {
    become_program(PROGRAM, &args.args)
}
