//! The `carff` command. It runs the commands that observe a run, and executes `carff-launch` for all others.
//! `carff-launch` knows every command, and executes `carff-lab` for those that compute with libtorch.

use carff::{Attach, become_program, end_on_signals, parse, run_program};
use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// The program of the other commands, in the same folder.
const LAUNCH: &str = "carff-launch";

#[derive(Debug, Parser)]
#[command(name = "carff", version = carff::provenance::VERSION)]
struct Cli {
    #[command(subcommand)]
    command: Attach,
}

fn main() -> ExitCode {
    let args: Vec<_> = std::env::args_os().skip(1).collect();
    let here = args.first().and_then(|word| word.to_str()).is_some_and(Attach::has_subcommand);
    run_program(|| if here { run() } else { become_program(LAUNCH, &args) })
}

fn run() -> anyhow::Result<ExitCode> {
    end_on_signals()?;
    parse::<Cli>()?.command.run()
}
