//! `carff eval`: every table and image of a checkpoint, as JSON and one page.

mod images;

use crate::train::Display;
use anyhow::bail;
use carff_base::files::check_writable;
use carff_checkpoint::{Manifest, TrainedWith};
use carff_evaluation::{EvalOptions, Subject, Table, evaluate};
use carff_launch::dataset::render;
use carff_launch::lab::{EvalArgs, TableName};
use carff_scenes::{Extras, Scenario};
use carff_training::training_curves;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Largest distance of two cameras that count as the same, metres.
const SAME_PLACE_M: f64 = 1e-3;
/// Free poses among which the gallery looks for one with an unknown object in sight.
const GALLERY_POSES: u32 = 12;

/// Returns the table of a name.
fn table(name: TableName) -> Table {
    match name {
        TableName::Psnr => Table::Psnr,
        TableName::Encoder => Table::Encoder,
        TableName::Recall => Table::Recall,
        TableName::Planning => Table::Planning,
        TableName::Trials => Table::Trials,
        TableName::Horizon => Table::Horizon,
        TableName::Robustness => Table::Robustness,
        TableName::Localisation => Table::Localisation,
        TableName::Memory => Table::Memory,
        TableName::Vehicles => Table::Vehicles,
        TableName::Frequencies => Table::Frequencies,
        TableName::Images => Table::Images,
    }
}

/// Runs the command.
pub fn run(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    check_writable(&args.out.join("results.json"))?;
    let options = options(&args.device, args.threads, args.seed)?;
    // One image at a time gains little from a second thread, and loses much on busy cores.
    carff_networks::device::set_threads(1);
    let manifest = Manifest::load(&args.checkpoint)?;
    let dataset = match &args.dataset {
        Some(dataset) => dataset.clone(),
        None => trained_on(&manifest.trained_with(&args.checkpoint)?)?,
    };
    let display = Display::default();
    let mut subject = Subject::load(&args.checkpoint, &dataset, options, &|p| display.show(p))?;
    if let Some(run_dir) = run_dir(args) {
        subject.training_curves = training_curves(&run_dir)?;
    }
    let asked: Vec<Table> = args.only.iter().map(|&name| table(name)).collect();
    let tables = if asked.is_empty() { Table::ALL.to_vec() } else { asked };
    let wants = |table| tables.contains(&table);
    if let Some(scenario) = shown_scenario(&subject).filter(|s| !s.info().hazard_branches.is_empty()) {
        if wants(Table::Planning) || wants(Table::Robustness) {
            subject.free_drives = images::free_drives(&scenario, args.free_drives, args.seed, &display)?;
        }
        // The gallery shows the first pose that has each in sight.
        let novelty_poses = if wants(Table::Robustness) { args.free_poses } else { args.free_poses.min(GALLERY_POSES) };
        if wants(Table::Robustness) || wants(Table::Images) {
            subject.novelties = images::novelties(&scenario, novelty_poses, args.seed, &display)?;
        }
        if [Table::Trials, Table::Horizon, Table::Robustness].into_iter().any(wants) {
            subject.free_poses = images::free_poses(&scenario, args.free_poses, args.seed, &display)?;
        }
        if wants(Table::Robustness) {
            subject.other_places =
                images::other_places(&scenario, &subject.free_poses, args.free_poses, args.seed, &display)?;
        }
        if wants(Table::Localisation) {
            subject.masked_views = images::masked_views(&subject, &scenario, args.seed, &display)?;
        }
        if wants(Table::Vehicles) {
            subject.lane_drives = images::lane_drives(&scenario, args.free_drives, args.seed, &display)?;
        }
        if wants(Table::Memory) && subject.memory.is_some() {
            subject.watches = images::watches(&subject, &scenario, args.free_drives, args.seed, &display)?;
        }
    }
    let results = evaluate(&subject, &tables, &args.out, &|p| display.show(p))?;
    display.finish();
    for target in &results.targets {
        let verdict = if target.reached { "reached" } else { "missed " };
        println!("{verdict}  {}: {} (target: {})", target.what, target.found, target.wanted);
    }
    for (table, why) in &results.left_out {
        println!("no {table}: {why}");
    }
    println!("page: {}", args.out.join("README.md").display());
    println!("figures: {}", args.out.join("results.json").display());
    Ok(ExitCode::SUCCESS)
}

/// Sets up the allocator, and returns the settings of the evaluation.
pub fn options(device: &str, threads: u16, seed: u64) -> anyhow::Result<EvalOptions> {
    carff_networks::allocator::keep_large_blocks();
    Ok(EvalOptions { device: carff_networks::device::parse(device)?, threads: usize::from(threads), seed })
}

/// Training dataset of a checkpoint, rendered when it is missing and its scenario file is available.
fn trained_on(trained: &TrainedWith) -> anyhow::Result<PathBuf> {
    let dataset = trained.dataset.clone();
    let there = ["transforms.json", "transforms_train.json"].iter().any(|f| dataset.join(f).is_file());
    if !there {
        match trained.scenario.as_ref().filter(|scenario| scenario.is_file()) {
            Some(scenario) => {
                render(&Scenario::load(scenario)?, &dataset, Extras::None)?;
            }
            None => bail!("no dataset in {}: name a dataset with --dataset", dataset.display()),
        }
    }
    Ok(dataset)
}

/// Scenario from which the dataset was rendered: that of the checkpoint, when its cameras are those of the dataset.
fn shown_scenario(subject: &Subject) -> Option<Scenario> {
    let scenario = Scenario::load(subject.trained.scenario.as_ref()?).ok()?;
    let dataset = &subject.posed.dataset;
    let same_place = |view: usize, there: &carff_scenes::ScenarioCamera| {
        let frame = dataset.frame_index(0, view).and_then(|i| dataset.frames().get(i));
        frame.is_some_and(|frame| {
            let (a, b) = (frame.camera.position_m(), there.camera.position_m());
            (0..3).all(|k| (a[k] - b[k]).abs() < SAME_PLACE_M)
        })
    };
    let same = scenario.cameras().len() == dataset.view_count()
        && scenario.cameras().iter().enumerate().all(|(view, there)| same_place(view, there));
    same.then_some(scenario)
}

/// Folder of the training run: the given one, or the default of `carff train`.
fn run_dir(args: &EvalArgs) -> Option<PathBuf> {
    let has_metrics = |dir: &PathBuf| dir.join("metrics.jsonl").is_file();
    let by_name = args.checkpoint.file_name().map(|name| Path::new("runs").join(name));
    let beside = args.checkpoint.parent().map(Path::to_owned);
    args.run_dir.clone().or_else(|| [by_name, beside].into_iter().flatten().find(has_metrics))
}
