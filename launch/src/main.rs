//! The commands that start graphs, and those that need neither a graph nor libtorch. It executes `carff-lab` for commands
//! that compute with libtorch.

use anyhow::Context;
use carff::{end_on_signals, parse, run_program};
#[cfg(feature = "bench")]
use carff_bench::BenchCommand;
use carff_inference::library;
use carff_launch::command::{Cli, Command};
use carff_launch::lab::{self, CheckpointCommand, LabCommand};
use carff_launch::schema::{FileKind, SchemaArgs};
use clap::CommandFactory;
use std::process::ExitCode;

fn main() -> ExitCode {
    run_program(run)
}

fn run() -> anyhow::Result<ExitCode> {
    library::without_telemetry().context("the telemetry of ONNX Runtime cannot be switched off")?;
    carff_launch::shell::answer_shell(Cli::command);
    let command = parse::<Cli>()?.command;
    if needs_libtorch(&command) {
        return lab::start();
    }
    end_on_signals()?;
    match command {
        Command::Launch(args) => carff_launch::launch::run(&args),
        Command::Drive(args) => carff_launch::drive::run(&args),
        Command::Attach(command) => command.run(),
        #[cfg(feature = "recording")]
        Command::Replay(args) => carff_launch::replay::run(&args),
        #[cfg(not(feature = "recording"))]
        Command::Replay(args) => args.run("carff replay"),
        Command::Lab(LabCommand::Checkpoint(CheckpointCommand::Onnx(args))) => {
            done(carff_launch::checkpoint::onnx(&args))
        }
        Command::Lab(_) => lab::start(),
        #[cfg(feature = "bench")]
        Command::Bench(BenchCommand::Tensors(_)) => lab::start(),
        #[cfg(feature = "bench")]
        Command::Bench(BenchCommand::Graph(command)) => carff_bench::run(command),
        #[cfg(not(feature = "bench"))]
        Command::Bench(args) => args.run("carff bench"),
        #[cfg(feature = "recording")]
        Command::Soak(args) => carff_launch::soak::run(&args),
        #[cfg(not(feature = "recording"))]
        Command::Soak(args) => args.run("carff soak"),
        #[cfg(feature = "recording")]
        Command::SoakInject(args) => done(carff_launch::soak::inject(&args)),
        Command::Doctor(args) => carff_launch::doctor::run(&args),
        Command::Schema(args) => done(carff_launch::schema::run(&args)),
        Command::Completions(args) => done(carff_launch::shell::completions(&args)),
        Command::Man(args) => done(carff_launch::shell::man(&args, Cli::command())),
        Command::Dataset(command) => done(carff_launch::dataset::run(command)),
    }
}

/// Returns true for the commands of `carff-lab`.
fn needs_libtorch(command: &Command) -> bool {
    match command {
        Command::Lab(LabCommand::Checkpoint(CheckpointCommand::Onnx(_))) => false,
        Command::Lab(_) | Command::Schema(SchemaArgs { kind: Some(FileKind::Training), .. }) => true,
        #[cfg(feature = "bench")]
        Command::Bench(BenchCommand::Tensors(_)) => true,
        _ => false,
    }
}

fn done(result: anyhow::Result<()>) -> anyhow::Result<ExitCode> {
    result.map(|()| ExitCode::SUCCESS)
}
