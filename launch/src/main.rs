//! The `carff` command.

use carff::ablate::AblateArgs;
use carff::dataset::DatasetCommand;
use carff::eval::EvalArgs;
use carff::launch::LaunchArgs;
use carff::soak::{InjectArgs, SoakArgs};
use carff::train::TrainArgs;
use carff_bench::BenchCommand;
use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// CARFF: from a camera image to a driving decision, in separate processes.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Start a graph, show its decisions, and end with a report.
    Launch(LaunchArgs),
    /// Render and check data sets.
    #[command(subcommand)]
    Dataset(DatasetCommand),
    /// Train a scenario's models; goes on where an earlier run stopped.
    Train(TrainArgs),
    /// Judge a checkpoint: every table and picture, as JSON and one page.
    Eval(EvalArgs),
    /// Train the encoder with one thing changed at a time, and tabulate; goes on where an earlier run stopped.
    Ablate(AblateArgs),
    /// Measure the program's parts, and the whole loop, on this machine.
    #[command(subcommand)]
    Bench(BenchCommand),
    /// Run a graph under a seeded schedule of faults, and hold it to its contract.
    Soak(SoakArgs),
    /// One fault from outside, for a soak.
    #[command(hide = true)]
    SoakInject(InjectArgs),
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Launch(args) => carff::launch::run(&args),
        Command::Train(args) => carff::train::run(&args),
        Command::Eval(args) => carff::eval::run(&args),
        Command::Ablate(args) => carff::ablate::run(&args),
        Command::Bench(command) => carff_bench::run(command),
        Command::Soak(args) => carff::soak::run(&args),
        Command::SoakInject(args) => carff::soak::inject(&args).map(|()| ExitCode::SUCCESS),
        Command::Dataset(command) => carff::dataset::run(command).map(|()| ExitCode::SUCCESS),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {}", carff_stage::describe(&error));
            ExitCode::FAILURE
        }
    }
}
