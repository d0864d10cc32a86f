//! `carff ablate`: the same training with one thing changed at a time, as one table.

use crate::eval;
use crate::train::{Display, data_sets, refuse_another_configuration, stop_on_signals, with_free_poses};
use anyhow::Context;
use carff_results::ResultsError;
use carff_results::ablation::{AblationTable, Variant, folders, row, write_table};
use carff_training::{TrainingError, config::TrainingConfig, run::Run};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// What to train, and where it goes.
#[derive(Debug, clap::Args)]
pub struct AblateArgs {
    /// The training file, for example configs/training/approaching-intersection-ablation.toml.
    config: PathBuf,
    /// Data set to train on, in place of the training file's.
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// These variants alone, by the name of their folder: full, stem, conv-net, unfrozen, transformer, no-pose.
    #[arg(long, value_parser = variant)]
    only: Vec<Variant>,
    /// Where training and scoring compute: `auto`, `cpu` or `cuda:N`.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Folder for ablation.json, README.md, and a folder for each variant. The same command goes on where it stopped.
    #[arg(long)]
    out: PathBuf,
}

fn variant(name: &str) -> Result<Variant, String> {
    let names = || Variant::ALL.map(Variant::name).join(", ");
    Variant::ALL.into_iter().find(|v| v.name() == name).ok_or_else(|| {
        let hint = carff_nearest::hint(name, Variant::ALL.map(Variant::name));
        format!("one of {} is wanted{hint}", names())
    })
}

/// Runs the command.
pub fn run(args: &AblateArgs) -> anyhow::Result<ExitCode> {
    let config = TrainingConfig::load(&args.config)?;
    let (dataset, free) = data_sets(&config, args.dataset.as_deref())?;
    let threads = u16::try_from(config.threads).unwrap_or(1);
    let options = eval::options(&args.device, threads, config.seed + 1)?;
    let stop = stop_on_signals()?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    refuse_another_configuration(&args.out, &config, &dataset)?;
    let display = Display::default();
    let report = |progress: &carff_training::run::Progress| display.show(progress);
    let made =
        with_free_poses(free, &config, &dataset, &Run { dir: args.out.clone(), on_progress: &report, stop: &stop });
    display.finish();
    let free = match made {
        Err(TrainingError::Stopped) => return Ok(stopped(&args.out)),
        made => made?,
    };
    let variants = if args.only.is_empty() { Variant::ALL.to_vec() } else { args.only.clone() };
    let mut table = AblationTable {
        dataset: dataset.display().to_string(),
        epochs: config.vae.epochs,
        free_poses: free.as_ref().map_or(0, |_| config.free_poses.count),
        seed: config.seed,
        rows: Vec::new(),
    };
    for variant in variants {
        eprintln!("{}: {}", variant.name(), variant.description(&config));
        let (dir, _) = folders(&args.out, variant);
        std::fs::create_dir_all(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
        refuse_another_configuration(&dir, &variant.apply(&config), &dataset)?;
        let display = Display::default();
        let report = |progress: &carff_training::run::Progress| display.show(progress);
        let run = Run { dir, on_progress: &report, stop: &stop };
        let found = row(&config, variant, &dataset, free.as_deref(), &args.out, &run, options);
        display.finish();
        match found {
            Ok(row) => table.rows.push(row),
            Err(ResultsError::Training(TrainingError::Stopped)) => return Ok(stopped(&args.out)),
            Err(error) => return Err(error.into()),
        }
        // After each variant, so that there is a table to look at.
        write_table(&table, &args.out)?;
    }
    println!("table: {}", args.out.join("README.md").display());
    Ok(ExitCode::SUCCESS)
}

fn stopped(out: &Path) -> ExitCode {
    eprintln!("stopped; the same command goes on from what is in {}", out.display());
    ExitCode::from(130)
}
