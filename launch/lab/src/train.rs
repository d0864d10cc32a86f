//! `carff train`: trains a scenario's models and writes the checkpoint.

use anyhow::{Context, bail};
use carff_base::files::check_writable;
use carff_checkpoint::Manifest;
use carff_launch::dataset::render;
use carff_launch::lab::{PhaseName, TrainArgs};
use carff_scenes::{
    ClosedLoop, Extras, Scenario,
    config::{BystanderPlace, VariationRole},
};
use carff_training::{
    FreePoses, Phases, Progress, Training, TrainingConfig, TrainingError, TrainingRun, forget_run, render_free_poses,
};
use carff_transport::{INTERRUPTED, Stop};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::Value;
use std::{
    collections::BTreeMap,
    io::IsTerminal,
    path::{Path, PathBuf},
    process::ExitCode,
    sync::Mutex,
    time::{Duration, Instant},
};

/// Longest time from a signal to the end of the process.
const GRACE: Duration = Duration::from_millis(1500);

/// Runs the command.
pub fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    let config = TrainingConfig::load(&args.config)?;
    let out = args.out.clone().unwrap_or_else(|| config.out.clone());
    if args.dataset.is_some() && args.out.is_none() {
        bail!("--dataset without --out would overwrite {}: name the folder of this checkpoint", config.out.display());
    }
    check_writable(&out.join(carff_checkpoint::files::MANIFEST))?;
    let (dataset, rendered) = datasets(&config, args.dataset.as_deref())?;
    let name = out.file_name().map_or_else(|| "training".into(), |n| n.to_string_lossy().into_owned());
    let dir = args.run_dir.clone().unwrap_or_else(|| Path::new("runs").join(name));
    std::fs::create_dir_all(&dir).with_context(|| format!("cannot make {}", dir.display()))?;
    if args.force {
        forget_another_configuration(&dir, &config, &dataset)?;
    } else {
        refuse_finished(&dir, &out)?;
    }
    refuse_another_configuration(&dir, &config, &dataset)?;

    let shown = args.dataset.is_none() && config.scenario.is_some();
    let scenario = shown.then(|| scenario(&config)).transpose()?;
    let device = carff_networks::device::parse(&args.device)?;
    let stop = stop_on_signals(&dir)?;
    let display = Display::default();
    let report = |progress: &Progress| display.show(progress);
    let run = TrainingRun { dir: dir.clone(), on_progress: &report, stop: stop.flag() };
    let phases = match args.phase {
        None => Phases::All,
        Some(PhaseName::Vae) => Phases::Vae,
        Some(PhaseName::Nerf) => Phases::Field,
        Some(PhaseName::Mdn) => Phases::Mixture,
    };
    let result = with_free_poses(rendered, &config, &dataset, &run).and_then(|free_poses| {
        let (free_poses, scenario) = (&free_poses, scenario.as_ref());
        Training { config: &config, dataset: &dataset, free_poses, scenario, out: &out, device }.run(phases, &run)
    });
    display.finish();
    match result {
        Ok(figures) => {
            println!("{}", figures.summary());
            println!("checkpoint: {}", out.display());
            println!("metrics and saved states: {}", dir.display());
            Ok(ExitCode::SUCCESS)
        }
        Err(TrainingError::Stopped) => {
            debug_assert!(stop.is_stopped());
            Ok(stopped(&dir))
        }
        Err(error) => Err(error.into()),
    }
}

/// A stop that signals trigger. It ends the process after [`GRACE`]: long computations look at it seldom, and saved
/// states are complete at any moment.
pub fn stop_on_signals(dir: &Path) -> anyhow::Result<Stop> {
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let dir = dir.to_owned();
    stop.exit_after(GRACE, move || {
        stopped(&dir);
    })?;
    Ok(stop)
}

/// Reports that the user stopped a training.
pub fn stopped(dir: &Path) -> ExitCode {
    carff::say(&format!("\nstopped; the same command resumes from the states saved in {}", dir.display()));
    ExitCode::from(INTERRUPTED)
}

/// Folders of the dataset and of the datasets of free poses. Missing ones are rendered from the training
/// file's scenario.
pub fn datasets(config: &TrainingConfig, given: Option<&Path>) -> anyhow::Result<(PathBuf, Vec<PathBuf>)> {
    let dataset = given.unwrap_or(&config.dataset).to_owned();
    if !dataset.join("transforms.json").is_file() && given.is_none() {
        render(&scenario(config)?, &dataset, Extras::None)?;
    }
    Ok((dataset, rendered_free_poses(config, given)?))
}

fn scenario(config: &TrainingConfig) -> anyhow::Result<Scenario> {
    match &config.scenario {
        Some(path) => Ok(Scenario::load(path)?),
        None => bail!(
            "no dataset in {}: name one with --dataset, or a `scenario` in the training file",
            config.dataset.display()
        ),
    }
}

/// Folders of the datasets of free poses, rendered where they are missing; none for a dataset without a scenario file.
fn rendered_free_poses(config: &TrainingConfig, given: Option<&Path>) -> anyhow::Result<Vec<PathBuf>> {
    let FreePoses { count, on_path, per_appearance, seed, .. } = config.free_poses;
    if count == 0 || given.is_some() || config.scenario.is_none() {
        return Ok(Vec::new());
    }
    let drawn = || Ok(scenario(config)?.with_free_cameras(count, seed)?);
    let mut all = vec![rendered(config, &format!("free-{count}-{seed}"), drawn)?];
    if on_path > 0 {
        let drawn = || Ok(ClosedLoop::new(scenario(config)?, None)?.with_training_cameras(on_path, seed)?);
        all.push(rendered(config, &format!("path-{on_path}-{seed}"), drawn)?);
    }
    if per_appearance == 0 {
        return Ok(all);
    }
    let scenario = scenario(config)?;
    let trained = scenario.appearances().iter().filter(|a| a.role == VariationRole::Trained);
    let harmless = scenario.bystanders().iter();
    let harmless = harmless.filter(|b| b.role == VariationRole::Trained && b.place == BystanderPlace::Roadside);
    let mut objects = harmless.cycle();
    for (number, appearance) in trained.enumerate() {
        let mut varied = scenario.with_appearance(&appearance.name)?;
        if let Some(object) = objects.next().filter(|_| number % 2 == 1) {
            varied = varied.with_object(&object.name)?;
        }
        // Each appearance has poses of its own.
        let seed = seed + 1 + number as u64;
        let suffix = format!("free-{per_appearance}-{seed}-{}", appearance.name);
        all.push(rendered(config, &suffix, || Ok(varied.with_free_cameras(per_appearance, seed)?))?);
    }
    Ok(all)
}

/// Folder of a dataset next to the training file's own, rendered if it is missing.
fn rendered(
    config: &TrainingConfig,
    suffix: &str,
    scenario: impl FnOnce() -> anyhow::Result<Scenario>,
) -> anyhow::Result<PathBuf> {
    let mut name = config.dataset.file_name().unwrap_or_default().to_owned();
    name.push(format!("-{suffix}"));
    let dir = config.dataset.with_file_name(name);
    if !dir.join("transforms.json").is_file() {
        render(&scenario()?, &dir, Extras::None)?;
    }
    Ok(dir)
}

/// Folders of the datasets of free poses: the rendered ones, else one that a field renders if the training file requests
/// it.
pub fn with_free_poses(
    rendered: Vec<PathBuf>,
    config: &TrainingConfig,
    dataset: &Path,
    run: &TrainingRun,
) -> Result<Vec<PathBuf>, TrainingError> {
    if rendered.is_empty() {
        return Ok(render_free_poses(config, dataset, run)?.into_iter().collect());
    }
    Ok(rendered)
}

const CONFIGURATION: &str = "configuration.json";

/// Refuses a new training that would overwrite a finished checkpoint. A resumed training overwrites only its own files.
fn refuse_finished(dir: &Path, out: &Path) -> anyhow::Result<()> {
    let begins = !dir.join(CONFIGURATION).is_file();
    if begins && Manifest::load(out).is_ok_and(|m| m.field.is_some()) {
        bail!(
            "{} holds a finished checkpoint: name another folder with --out, or replace it with --force",
            out.display()
        );
    }
    Ok(())
}

/// Removes the states of another configuration or dataset.
fn forget_another_configuration(dir: &Path, config: &TrainingConfig, dataset: &Path) -> anyhow::Result<()> {
    if !dir.join(CONFIGURATION).is_file() || refuse_another_configuration(dir, config, dataset).is_ok() {
        return Ok(());
    }
    forget_run(dir)?;
    std::fs::remove_file(dir.join(CONFIGURATION)).with_context(|| format!("cannot clear {}", dir.display()))
}

/// Refuses a run folder of another configuration or dataset: resuming with its states would mix them.
pub fn refuse_another_configuration(dir: &Path, config: &TrainingConfig, dataset: &Path) -> anyhow::Result<()> {
    let path = dir.join(CONFIGURATION);
    let mine = relevant_settings(config, dataset)?;
    match std::fs::read_to_string(&path) {
        // Keys that an earlier version did not have take their defaults.
        Ok(text) if serde_json::from_str::<Value>(&text).is_ok_and(|there| completed(there) == mine) => Ok(()),
        Ok(_) => bail!(
            "{} has states of another training configuration or dataset; name another folder with --run-dir, or remove \
             these states with --force",
            dir.display()
        ),
        Err(_) => std::fs::write(&path, serde_json::to_string_pretty(&mine)?)
            .with_context(|| format!("cannot write {}", path.display())),
    }
}

/// Keys that change speed and output folder, not the trained models.
const OTHER_KEYS: [&str; 2] = ["threads", "out"];

fn relevant_settings(config: &TrainingConfig, dataset: &Path) -> anyhow::Result<Value> {
    let mut value = serde_json::to_value(config)?;
    value["dataset"] = serde_json::to_value(dataset)?;
    if let Some(map) = value.as_object_mut() {
        for key in OTHER_KEYS {
            map.remove(key);
        }
    }
    Ok(value)
}

/// A saved configuration with the defaults of missing keys; unchanged when it is not a configuration.
fn completed(there: Value) -> Value {
    let read = || {
        let mut whole = there.clone();
        // The output folder has no default, and is not saved.
        whole.as_object_mut()?.insert("out".to_owned(), Value::from(""));
        let config: TrainingConfig = serde_json::from_value(whole).ok()?;
        relevant_settings(&config, &config.dataset).ok()
    };
    read().unwrap_or(there)
}

/// Progress display: one bar for each phase on a terminal, else a line at intervals.
#[derive(Default)]
pub struct Display {
    bars: Mutex<BTreeMap<String, (ProgressBar, Instant)>>,
}

/// Time between two lines without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(15);

impl Display {
    /// Shows a step.
    pub fn show(&self, progress: &Progress) {
        let live = std::io::stderr().is_terminal();
        let Ok(mut bars) = self.bars.lock() else { return };
        let (bar, last) = bars.entry(progress.phase.to_owned()).or_insert_with(|| {
            let bar = ProgressBar::new(progress.total as u64);
            if !live {
                bar.set_draw_target(ProgressDrawTarget::hidden());
            }
            if let Ok(style) =
                ProgressStyle::with_template("{prefix:9} [{bar:24}] {pos}/{len} {elapsed} < {eta}  {wide_msg}")
            {
                bar.set_style(style);
            }
            bar.set_prefix(progress.phase.to_owned());
            (bar, Instant::now())
        });
        bar.set_position(progress.done as u64);
        bar.set_message(progress.line.clone());
        if !live && (last.elapsed() >= LINE_EVERY || progress.done == progress.total) {
            *last = Instant::now();
            let Progress { phase, done, total, line } = progress;
            carff::say(&format!("{phase} {done}/{total}  {line}, {:.0} s left", bar.eta().as_secs_f64()));
        }
        if progress.done == progress.total {
            bar.finish();
        }
    }

    /// Stops all bars.
    pub fn finish(&self) {
        if let Ok(bars) = self.bars.lock() {
            for (bar, _) in bars.values() {
                if !bar.is_finished() {
                    bar.abandon();
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder is resumed with the same configuration, also when it was saved before some key existed; another setting
    /// or another dataset is refused.
    #[test]
    fn a_run_folder_belongs_to_one_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let saved = folder.path().join("configuration.json");
        let text = include_str!("../../../configs/training/approaching-intersection.toml");
        let config: TrainingConfig = toml::from_str(text).unwrap();
        let refused = |dataset: &str| refuse_another_configuration(folder.path(), &config, Path::new(dataset)).is_err();
        assert!(!refused("data/x") && saved.is_file());
        assert!(!refused("data/x"));
        assert!(refused("data/y"));

        let mut value: Value = serde_json::from_str(&std::fs::read_to_string(&saved).unwrap()).unwrap();
        assert!(value["decoder"].as_object_mut().unwrap().remove("pose_condition").is_some());
        std::fs::write(&saved, value.to_string()).unwrap();
        assert!(!refused("data/x"));
        value["decoder"]["pose_condition"] = Value::from(false);
        std::fs::write(&saved, value.to_string()).unwrap();
        assert!(refused("data/x"));
        std::fs::write(&saved, "garbage").unwrap();
        assert!(refused("data/x"));

        // With force, states of another configuration are removed; own states are kept.
        let state = folder.path().join("vae.state.safetensors");
        std::fs::write(&state, "state").unwrap();
        forget_another_configuration(folder.path(), &config, Path::new("data/x")).unwrap();
        assert!(!state.exists() && !refused("data/x"));
        std::fs::write(&state, "state").unwrap();
        forget_another_configuration(folder.path(), &config, Path::new("data/x")).unwrap();
        assert!(state.exists());
    }

    /// A finished checkpoint is not overwritten by a new training. A resumed training may overwrite it.
    #[test]
    fn a_finished_checkpoint_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/checkpoints/approaching-intersection");
        let error = refuse_finished(folder.path(), &shipped).unwrap_err().to_string();
        assert!(error.contains("--out") && error.contains("--force"), "{error}");
        refuse_finished(folder.path(), &folder.path().join("new")).unwrap();
        std::fs::write(folder.path().join(CONFIGURATION), "{}").unwrap();
        refuse_finished(folder.path(), &shipped).unwrap();
    }
}
