//! `carff ablate`: one training with one setting changed at a time, as one table.

use crate::eval;
use crate::train::{Display, datasets, refuse_another_configuration, stop_on_signals, stopped, with_free_poses};
use anyhow::{Context, anyhow};
use carff_base::files::check_writable;
use carff_launch::lab::AblateArgs;
use carff_training::ablation::{AblationTable, Variant, folder, row, rows, write_table};
use carff_training::{Progress, Training, TrainingConfig, TrainingError, TrainingRun};
use std::process::ExitCode;

fn variant(name: &str) -> anyhow::Result<Variant> {
    let names = || Variant::ALL.map(Variant::name).join(", ");
    Variant::ALL.into_iter().find(|v| v.name() == name).ok_or_else(|| {
        let hint = carff_base::names::hint(name, Variant::ALL.map(Variant::name));
        anyhow!("--only {name}: one of {} is wanted{hint}", names())
    })
}

/// Runs the command.
pub fn run(args: &AblateArgs) -> anyhow::Result<ExitCode> {
    let named = args.only.iter().map(|name| variant(name)).collect::<anyhow::Result<Vec<_>>>()?;
    let variants = if named.is_empty() { Variant::ALL.to_vec() } else { named };
    let config = TrainingConfig::load(&args.config)?;
    check_writable(&args.out.join("ablation.json"))?;
    let (dataset, rendered) = datasets(&config, args.dataset.as_deref())?;
    let threads = u16::try_from(config.threads).unwrap_or(1);
    let options = eval::options(&args.device, threads, config.seed + 1)?;
    let stop = stop_on_signals(&args.out)?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    refuse_another_configuration(&args.out, &config, &dataset)?;
    let display = Display::default();
    let report = |progress: &Progress| display.show(progress);
    let run = TrainingRun { dir: args.out.clone(), on_progress: &report, stop: stop.flag() };
    let made = with_free_poses(rendered, &config, &dataset, &run);
    display.finish();
    let free_poses = match made {
        Err(TrainingError::Stopped) => return Ok(stopped(&args.out)),
        made => made?,
    };
    let mut table = AblationTable {
        dataset: dataset.display().to_string(),
        epochs: config.vae.epochs,
        free_poses: if free_poses.is_empty() { 0 } else { config.free_poses.count },
        rows: Vec::new(),
    };
    for (variant, seed) in variants.iter().flat_map(|&v| (0..args.seeds).map(move |k| (v, config.seed + k))) {
        let config = TrainingConfig { seed, ..config.clone() };
        carff::say(&format!("{}, seed {seed}: {}", variant.name(), variant.description(&config)));
        let dir = folder(&args.out, variant, seed).join("run");
        std::fs::create_dir_all(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
        refuse_another_configuration(&dir, &variant.apply(&config), &dataset)?;
        let display = Display::default();
        let report = |progress: &Progress| display.show(progress);
        let run = TrainingRun { dir, on_progress: &report, stop: stop.flag() };
        let training = Training {
            config: &config,
            dataset: &dataset,
            free_poses: &free_poses,
            scenario: None,
            out: &args.out,
            device: options.device,
        };
        let found = row(&training, variant, &run, options);
        display.finish();
        match found {
            Ok(_) => table.rows = rows(&args.out)?,
            Err(TrainingError::Stopped) => return Ok(stopped(&args.out)),
            Err(error) => return Err(error.into()),
        }
        // After each variant, so that the table is available early, and with the rows of earlier runs.
        write_table(&table, &args.out)?;
    }
    println!("table: {}", args.out.join("README.md").display());
    Ok(ExitCode::SUCCESS)
}
