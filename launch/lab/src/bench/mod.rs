//! `carff bench field` and `carff bench encoder`: native code and ONNX Runtime against libtorch.

mod encoder;
mod field;
mod limits;

use carff_bench::TensorBench;
use std::process::ExitCode;

/// Runs a benchmark, prints its tables, and writes its figures if requested.
pub fn run(command: &TensorBench) -> anyhow::Result<ExitCode> {
    command.output().check()?;
    let report = match command {
        TensorBench::Field(args) => field::run(args)?,
        TensorBench::Encoder(args) => encoder::run(args)?,
    };
    command.output().finish(&report)?;
    Ok(ExitCode::SUCCESS)
}
