//! `carff eval`: every table and picture of a checkpoint, as JSON and one page.

use crate::dataset::render;
use crate::train::Display;
use anyhow::{Context, bail};
use carff_checkpoint::Manifest;
use carff_results::{EvalOptions, Subject, Table, evaluate};
use carff_scenes::{Extras, Scenario};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// What to judge, and where the results go.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// The checkpoint's folder.
    checkpoint: PathBuf,
    /// Data set to judge it on, in place of the one it was trained on.
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// This table alone; may be given several times.
    #[arg(long, value_enum, value_name = "TABLE")]
    only: Vec<TableName>,
    /// Where the encoder computes: `auto`, `cpu` or `cuda:N`.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Folder of the training run, for its curves; else runs/NAME or the checkpoint's parent, where they have any.
    #[arg(long)]
    run_dir: Option<PathBuf>,
    /// Threads that render and probe.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Seed of sensor noise, draws and folds.
    #[arg(long, default_value_t = 2)]
    seed: u64,
    /// Folder for results.json, README.md and pictures; files of an earlier evaluation are written over.
    #[arg(long)]
    out: PathBuf,
}

/// The tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum TableName {
    /// PSNR matrices from above, and other poses.
    Psnr,
    /// Decoder, support vector machine, state accuracy.
    Encoder,
    /// Accuracy and recall against the number of samples.
    Recall,
    /// Every decision rule, and the reliability of the hazard probability.
    Planning,
    /// How often each outcome is drawn where several are open.
    Frequencies,
    /// t-SNE, reconstructions, curves, beliefs, density.
    Pictures,
}

impl From<TableName> for Table {
    fn from(name: TableName) -> Self {
        match name {
            TableName::Psnr => Self::Psnr,
            TableName::Encoder => Self::Encoder,
            TableName::Recall => Self::Recall,
            TableName::Planning => Self::Planning,
            TableName::Frequencies => Self::Frequencies,
            TableName::Pictures => Self::Pictures,
        }
    }
}

/// Runs the command.
pub fn run(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let options = options(&args.device, args.threads, args.seed)?;
    // A picture at a time gains little from a second thread, and loses much where cores are taken.
    carff_models::device::set_threads(1);
    let manifest = Manifest::load(&args.checkpoint)?;
    let dataset = match &args.dataset {
        Some(dataset) => dataset.clone(),
        None => trained_on(&manifest)?,
    };
    let display = Display::default();
    let mut subject = Subject::load(&args.checkpoint, &dataset, options, &|p| display.show(p))?;
    subject.run_dir = run_dir(args);
    let asked: Vec<Table> = args.only.iter().map(|t| Table::from(*t)).collect();
    let tables = if asked.is_empty() { Table::ALL.to_vec() } else { asked };
    let results = evaluate(&mut subject, &tables, &args.out, &|p| display.show(p))?;
    display.finish();
    for target in &results.targets {
        let verdict = if target.reached { "reached" } else { "missed " };
        println!("{verdict}  {}: {} (wanted: {})", target.what, target.found, target.wanted);
    }
    for (table, why) in &results.left_out {
        println!("no {table}: {why}");
    }
    println!("page: {}", args.out.join("README.md").display());
    println!("figures: {}", args.out.join("results.json").display());
    Ok(ExitCode::SUCCESS)
}

/// Sets up the allocator, and says how to evaluate.
pub fn options(device: &str, threads: u16, seed: u64) -> anyhow::Result<EvalOptions> {
    carff_models::allocator::keep_large_blocks();
    Ok(EvalOptions { device: carff_models::device::parse(device)?, threads: usize::from(threads), seed })
}

/// The data set that a checkpoint was trained on, rendered when it is missing and its scenario is at hand.
fn trained_on(manifest: &Manifest) -> anyhow::Result<PathBuf> {
    let path = |key: &str| manifest.training.get(key).and_then(|v| v.as_str()).map(PathBuf::from);
    let dataset =
        path("dataset").context("the checkpoint does not say what it was trained on: name it with --dataset")?;
    let there = ["transforms.json", "transforms_train.json"].iter().any(|f| dataset.join(f).is_file());
    if !there {
        match path("scenario").filter(|scenario| scenario.is_file()) {
            Some(scenario) => {
                render(&Scenario::load(&scenario)?, &dataset, Extras::None)?;
            }
            None => bail!("no data set in {}: name the one to judge on with --dataset", dataset.display()),
        }
    }
    Ok(dataset)
}

/// The folder with the run's metrics: the one named, or where `carff train` puts it.
fn run_dir(args: &EvalArgs) -> Option<PathBuf> {
    let has_metrics = |dir: &PathBuf| dir.join("metrics.jsonl").is_file();
    let by_name = args.checkpoint.file_name().map(|name| Path::new("runs").join(name));
    let beside = args.checkpoint.parent().map(Path::to_owned);
    args.run_dir.clone().or_else(|| [by_name, beside].into_iter().flatten().find(has_metrics))
}
