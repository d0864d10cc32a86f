//! Commands that a build without their features does not contain.

use std::ffi::OsString;
use std::process::ExitCode;

/// Any arguments of a command that is not part of this build.
#[derive(Clone, Debug, clap::Args)]
pub struct NotBuilt {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    args: Vec<OsString>,
}

impl NotBuilt {
    /// Fails with the command that builds the missing one.
    pub fn run(&self, command: &str) -> anyhow::Result<ExitCode> {
        anyhow::bail!("`{command}` is not part of this build, which `make run` made: run `make build`")
    }
}
