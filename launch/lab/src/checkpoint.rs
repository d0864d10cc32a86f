//! `carff checkpoint`: the limits of what a checkpoint knows, and its memory.

use crate::train::Display;
use anyhow::Context;
use carff_base::files::check_writable;
use carff_base::statistics::percentile_of_sorted;
use carff_checkpoint::Manifest;
use carff_decision::MemorySettings;
use carff_launch::lab::{BoundArgs, CheckpointCommand, KnownArgs, MemoryArgs};
use carff_scenes::Scenario;
use carff_training::{BoundInput, KnownInput, MemoryInput, bound_threshold, calibrate_known, learn_memory};
use std::path::Path;
use std::process::ExitCode;

/// Runs the command.
pub fn run(command: &CheckpointCommand) -> anyhow::Result<ExitCode> {
    match command {
        CheckpointCommand::Onnx(args) => carff_launch::checkpoint::onnx(args)?,
        CheckpointCommand::Known(args) => known(args)?,
        CheckpointCommand::Bound(args) => bound(args)?,
        CheckpointCommand::Memory(args) => memory(args)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Checks, before minutes of work, that the folder is a checkpoint into which files can be written.
fn check_output(checkpoint: &Path) -> anyhow::Result<()> {
    Manifest::load(checkpoint)?;
    Ok(check_writable(&checkpoint.join(".writable"))?)
}

fn known(args: &KnownArgs) -> anyhow::Result<()> {
    check_output(&args.checkpoint)?;
    let scenario = args.scenario.as_deref().map(Scenario::load).transpose()?;
    let input = KnownInput {
        checkpoint: &args.checkpoint,
        dataset: &args.dataset,
        scenario: scenario.as_ref(),
        free_poses: args.free_poses,
        threads: args.threads,
    };
    let known = calibrate_known(input, &|_| {}).context("cannot calibrate what the checkpoint knows")?;
    for (side, limits) in [("clear", &known.clear), ("hazard", &known.hazard)] {
        let [unexpected, missing] = [&limits.unexpected, &limits.missing].map(|of| of.limit);
        println!("{side}: limits {unexpected:.2} (unexpected) and {missing:.2} (missing) on {} images", limits.images);
    }
    println!("this place: at least {:.2} of the view explained", known.least_explained);
    Ok(())
}

fn bound(args: &BoundArgs) -> anyhow::Result<()> {
    check_output(&args.checkpoint)?;
    let scenario = Scenario::load(&args.scenario)?;
    let display = Display::default();
    let input = BoundInput {
        checkpoint: &args.checkpoint,
        scenario: &scenario,
        drives: args.drives,
        level: args.level,
        confidence: args.confidence,
        remembers: args.memory,
        threads: args.threads,
    };
    let chosen = bound_threshold(input, &|p| display.show(p)).context("cannot bound the threshold")?;
    display.finish();
    let of = |sorted: &[f64], share: f64| percentile_of_sorted(sorted, share).unwrap_or(f64::NAN);
    println!("threshold {:.4}", chosen.planning.threshold(args.memory));
    for (kind, sorted) in [("hazard", &chosen.hazard), ("clear", &chosen.clear)] {
        let [p1, p5, p50, p95, p99] = [0.01, 0.05, 0.5, 0.95, 0.99].map(|share| of(sorted, share));
        println!(
            "{kind}: {} drives, hazard or unknown at 1, 5, 50, 95, 99 %: {p1:.3} {p5:.3} {p50:.3} {p95:.3} {p99:.3}",
            sorted.len()
        );
    }
    Ok(())
}

fn memory(args: &MemoryArgs) -> anyhow::Result<()> {
    check_output(&args.checkpoint)?;
    let scenario = Scenario::load(&args.scenario)?;
    let display = Display::default();
    let MemoryArgs { checkpoint, drives, threads, .. } = args;
    let input = MemoryInput { checkpoint, scenario: &scenario, drives: *drives, threads: *threads };
    let learned = learn_memory(input, &|p| display.show(p)).context("cannot learn the memory")?;
    display.finish();
    let MemorySettings { repeated_share, distrust, place_strength } = learned.settings;
    println!("share of repeated evidence {repeated_share}, distrust {distrust}, strength of places {place_strength}");
    println!("log loss a frame {:.4}, without memory {:.4}", learned.log_loss, learned.without_memory);
    Ok(())
}
