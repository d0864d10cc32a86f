//! `carff view`: the live window, a program of its own beside this one.

use anyhow::Context;
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode};

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
    let program = std::env::current_exe()?.with_file_name(PROGRAM);
    let error = Command::new(&program).args(&args.args).exec();
    Err(error).with_context(|| format!("cannot start {}; build it with `cargo build --release`", program.display()))
}
