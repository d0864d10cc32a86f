//! The `carff` command. What attaches to a run is done here; for all else this becomes `carff-launch`, which knows every
//! command and is linked with libtorch.

use anyhow::Context;
use carff::{Attach, exit_code};
use clap::{Parser, Subcommand};
use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode};

/// The program of the other commands, beside this one.
const LAUNCH: &str = "carff-launch";

#[derive(Debug, Parser)]
#[command(name = "carff", version)]
struct Cli {
    #[command(subcommand)]
    command: Attach,
}

fn main() -> ExitCode {
    let command = std::env::args_os().nth(1);
    let here = command.as_ref().and_then(|word| word.to_str()).is_some_and(Attach::has_subcommand);
    exit_code(if here { Cli::parse().command.run() } else { become_launch() })
}

fn become_launch() -> anyhow::Result<ExitCode> {
    let program = std::env::current_exe()?.with_file_name(LAUNCH);
    let error = Command::new(&program).args(std::env::args_os().skip(1)).exec();
    Err(error).with_context(|| format!("cannot start {}; build it with `make build`", program.display()))
}
