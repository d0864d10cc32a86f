//! The commands of `carff` that compute with libtorch.

use anyhow::bail;
use carff::{end_on_signals, parse, run_program};
use carff_bench::BenchCommand;
use carff_lab::{ablate, backbone, bench, checkpoint, eval, train};
use carff_launch::command::{Cli, Command};
use carff_launch::lab::LabCommand;
use carff_launch::schema::{self, FileKind};
use carff_training::TrainingConfig;
use std::process::ExitCode;

fn main() -> ExitCode {
    run_program(run)
}

fn run() -> anyhow::Result<ExitCode> {
    end_on_signals()?;
    match parse::<Cli>()?.command {
        Command::Lab(LabCommand::Train(args)) => train::run(&args),
        Command::Lab(LabCommand::Eval(args)) => eval::run(&args),
        Command::Lab(LabCommand::Ablate(args)) => ablate::run(&args),
        Command::Lab(LabCommand::Backbone(command)) => backbone::run(&command),
        Command::Lab(LabCommand::Checkpoint(command)) => checkpoint::run(&command),
        Command::Bench(BenchCommand::Tensors(command)) => bench::run(&command),
        Command::Schema(args) if args.kind == Some(FileKind::Training) => {
            print!("{}", schema::text(&schema::schema_of::<TrainingConfig>(FileKind::Training))?);
            Ok(ExitCode::SUCCESS)
        }
        _ => bail!("this command needs no libtorch: start it with `carff`"),
    }
}
