//! `carff bench field` and `carff bench encoder`: native code and ONNX Runtime against libtorch.

mod encoder;
mod field;
mod inputs;
mod limits;

use carff_bench::TensorBench;
use carff_bench::stats::{Contender, timed};
use std::process::ExitCode;
use std::time::Instant;

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

/// Returns the fastest setting after two trials of each. A long trial is the last one.
fn best(settings: &[i64], mut action: impl FnMut(i64)) -> i64 {
    const LONG_S: f64 = 4.0;
    let mut least = (f64::INFINITY, settings[0]);
    for &setting in settings {
        for _ in 0..2 {
            let start = Instant::now();
            action(setting);
            let seconds = start.elapsed().as_secs_f64();
            if seconds < least.0 {
                least = (seconds, setting);
            }
            if seconds > LONG_S {
                return least.1;
            }
        }
    }
    least.1
}

/// Times an action on the next of `count` items at each turn.
fn round_and_round<'a>(count: usize, mut action: impl FnMut(usize) + 'a) -> Contender<'a> {
    let mut turn = 0;
    timed(move || {
        action(turn % count);
        turn += 1;
    })
}
