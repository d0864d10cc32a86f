//! `carff launch`: starts a graph, watches it, prints its decisions, ends it, and writes a report.

use crate::decisions::{Decisions, Shown};
use crate::planning::{Planning, RunOutcome};
use crate::report::{ReportFiles, RunReport};
use crate::supervision::monitor::FrameHistory;
use crate::supervision::{Ended, Feed, LAUNCHER, Supervisor};
use anyhow::{Context, bail, ensure};
use carff::provenance;
use carff::runs::log_path;
use carff::terminal::Terminal;
use carff_base::files::{check_distinct, check_writable};
use carff_checkpoint::{Manifest, ScenarioIdentity};
use carff_config::{CameraSource, GraphConfig, is_stream};
use carff_dataset::{Dataset, ScenarioInfo};
use carff_observe::{RunLock, RunRecord};
use carff_runtime::StageArgs;
use carff_scenes::{Extras, Scenario};
use carff_transport::{
    Node, Run, Stop, check_space, graph_bytes, monotonic_now_ns, remove_run_leftovers, run_id_of, runtime_dir,
};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::SystemTime;

/// Assumed bytes of a frame in the check of shared memory, before the image size is known.
pub(crate) const FRAME_BYTES: usize = 1 << 17;

/// Start a graph.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct LaunchArgs {
    /// The graph file, as in configs/graphs.
    pub graph: PathBuf,
    /// Dataset folder; replaces the graph file's.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Checkpoint folder; replaces the graph file's.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Stop after this many frames.
    #[arg(long)]
    pub frames: Option<u64>,
    /// Number of drives; replaces the graph file's.
    #[arg(long)]
    pub drives: Option<u32>,
    /// Write the report here, as JSON.
    #[arg(long)]
    pub report: Option<PathBuf>,
    /// Run name; replaces the graph file's. Two concurrent runs need two names.
    #[arg(long)]
    pub run: Option<String>,
    /// Set a key of the graph file, for example `run.samples=35`; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print the effective configuration, and exit.
    #[arg(long)]
    pub print_config: bool,
    /// Print each frame's decision instead of one line for each drive.
    #[arg(long, short)]
    pub verbose: bool,
    /// Write each decision here as one JSON line.
    #[arg(long, value_name = "FILE")]
    pub decisions: Option<PathBuf>,
    /// After the run, also compute every rule over its drives and over every eligible image (minutes).
    #[arg(long)]
    pub tables: bool,
    /// Folder of the stages' programs; default: this program's folder.
    #[arg(long, hide = true)]
    pub stages: Option<PathBuf>,
}

/// Launches a graph. Ends when the camera is done (exit code 0), on Ctrl-C (130), or with an error when a stage is
/// lost.
pub fn run(args: &LaunchArgs) -> anyhow::Result<ExitCode> {
    if args.print_config {
        print!("{}", load(args)?.to_toml()?);
        return Ok(ExitCode::SUCCESS);
    }
    let files = args.report.as_deref().map(ReportFiles::checked).transpose()?;
    args.decisions.as_deref().map_or(Ok(()), check_writable)?;
    let of_report = files.iter().flat_map(|files| [&*files.json, &*files.text, &*files.strip]);
    check_distinct([args.graph.as_path()], of_report.chain(args.decisions.as_deref()))?;
    let terminal = Arc::new(Terminal::new());
    let (ended, outcome) = run_graph(args, None, &terminal)?;
    report(args, files.as_ref(), ended, &outcome, &terminal)?;
    terminal.check()?;
    Ok(ExitCode::SUCCESS)
}

/// Prints and writes the report of a run: first the run's own figures, then what takes longer.
fn report(
    args: &LaunchArgs,
    files: Option<&ReportFiles>,
    ended: Ended,
    outcome: &RunOutcome,
    terminal: &Terminal,
) -> anyhow::Result<()> {
    let mut own = RunReport::of(outcome);
    let mut text = own.text();
    terminal.line(&text);
    if let Some(files) = files {
        files.write(&own, &text)?;
        terminal.line(&format!("report: {}\nJSON: {}", files.text.display(), files.json.display()));
    }
    if ended == Ended::Interrupted || (files.is_none() && !args.tables) {
        return Ok(());
    }
    let Some(planning) = Planning::load(outcome)? else { return Ok(()) };
    if let Some(files) = files {
        planning.write_filmstrip(&files.strip)?;
        terminal.line(&format!("filmstrip: {}", files.strip.display()));
    }
    if args.tables {
        let tables = planning.tables(|progress| terminal.status(progress))?;
        terminal.status(String::new());
        terminal.line(&tables.text());
        text += &tables.text();
        own.planning = Some(tables);
        files.map_or(Ok(()), |files| files.write(&own, &text))?;
    }
    Ok(())
}

/// Reads the graph file with the settings of `--set`.
fn load(args: &LaunchArgs) -> anyhow::Result<GraphConfig> {
    Ok(GraphConfig::load_with(&args.graph, &args.set)?)
}

/// Starts a graph, and watches it to its end.
pub(crate) fn run_graph(
    args: &LaunchArgs,
    feed: Option<Feed>,
    terminal: &Arc<Terminal>,
) -> anyhow::Result<(Ended, RunOutcome)> {
    let graph = load(args)?;
    terminal.set_log_format(graph.launcher.log_format);
    for warning in graph.warnings() {
        terminal.log(LAUNCHER, &format!("WARN {}: {warning}", args.graph.display()));
    }
    let name = args.run.clone().unwrap_or_else(|| graph.run.name.clone());
    let run = Run::new(&name, run_id_of(&name, monotonic_now_ns()))?;
    let dataset = graph.resolve(args.dataset.as_ref().unwrap_or(&graph.run.dataset));
    let checkpoint = graph.resolve(args.checkpoint.as_ref().unwrap_or(&graph.run.checkpoint));
    // Settings of the command line and a piped file exist only here: stages and probes read a copy.
    let copied = !args.set.is_empty() || is_stream(&args.graph);
    let graph_file = if copied { runtime_dir().join(format!("{name}.toml")) } else { args.graph.clone() };
    let record = run_record(&run, [&graph_file, &dataset, &checkpoint])?;
    let lock = RunLock::take(&runtime_dir(), &name, &record, "--run")?;
    lock.sweep(&run, "--run")?;
    terminal.log_to(&log_path(run.dir(), &name)).context("cannot write the run's log")?;
    let origin = provenance::of(Some(record.started_unix_s), Some(&checkpoint));
    let _copy = copied.then(|| write_copy(&graph, &graph_file)).transpose()?;

    // A feed brings its own images.
    let scenario = if feed.is_none() {
        provide_dataset(&graph, args, &dataset, terminal)?;
        scenario_of(&graph, &dataset, &checkpoint)?
    } else {
        None
    };
    let drives = args.drives.unwrap_or(graph.camera.drives);
    let decisions = args.decisions.as_deref();
    let shown = match (feed.as_ref().is_some_and(|feed| feed.is_quiet), args.verbose) {
        (true, _) => Shown::Nothing,
        (_, true) => Shown::Frames,
        _ => Shown::Drives,
    };
    let mut decisions = Decisions::new(&graph, drives, shown, decisions, scenario.clone(), terminal)?;
    // From here on Ctrl-C ends the run in order. Before, no stage runs, and the process may simply end.
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let view_bytes = carff_messages::rgb_bytes(graph.renderer.width_px, graph.renderer.height_px);
    check_space(Path::new("/dev/shm"), "the graph", graph_bytes(FRAME_BYTES, view_bytes))?;

    let result = {
        let node = Node::open(&run, "launcher")?;
        let mut decided = |frame: &FrameHistory| decisions.take(frame);
        let programs = stage_programs(args, &run, [&graph_file, &dataset, &checkpoint])?;
        let mut supervisor = Supervisor::new(&node, &graph, programs, &stop, terminal, &mut decided)?;
        let result = supervisor.drive(&run, &stop, feed);
        terminal.status(String::new());
        supervisor.shut_down();
        result.map(|ended| {
            let outcome = RunOutcome {
                run: name,
                origin,
                graph_file: args.graph.display().to_string(),
                graph: graph.clone(),
                scenario,
                interrupted: ended == Ended::Interrupted,
                dataset,
                checkpoint,
                restarts: supervisor.restarts().into_iter().collect(),
                records: supervisor.take_records(),
                invalid: node.counters().invalid(),
            };
            (ended, outcome)
        })
    };
    // All stages are dead and reaped, and the lock is held: remaining files belong to no process.
    remove_run_leftovers(&run)?;
    let result = result?;
    if result.0 == Ended::Interrupted {
        terminal.log(LAUNCHER, "INFO interrupted: all stages have ended");
    }
    decisions.finish()?;
    Ok(result)
}

/// Returns the record by which other programs find the run.
fn run_record(run: &Run, files: [&Path; 3]) -> anyhow::Result<RunRecord> {
    let absolute = |path: &Path| std::path::absolute(path).map(|p| p.display().to_string());
    let [graph, dataset, checkpoint] = files.map(absolute);
    Ok(RunRecord {
        pid: std::process::id(),
        run_id: run.id(),
        graph: graph?,
        dataset: dataset?,
        checkpoint: checkpoint?,
        started_unix_s: SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs(),
    })
}

/// Returns the folder of the stages' programs, and the arguments that all stages get.
fn stage_programs(args: &LaunchArgs, run: &Run, files: [&Path; 3]) -> anyhow::Result<(PathBuf, StageArgs)> {
    let [graph_file, dataset, checkpoint] = files;
    let mut stage_args = StageArgs::new(graph_file, run.name(), run.id());
    stage_args.dataset = Some(dataset.to_owned());
    stage_args.checkpoint = Some(checkpoint.to_owned());
    (stage_args.drives, stage_args.frames) = (args.drives, args.frames);
    stage_args.parent_pid = Some(std::process::id());
    let folder = match &args.stages {
        Some(folder) => folder.clone(),
        None => std::env::current_exe()?
            .parent()
            .context("this program has no folder: start it by its whole path, or pass --stages")?
            .to_owned(),
    };
    Ok((folder, stage_args))
}

/// Writes the effective configuration for the time of the run.
fn write_copy(graph: &GraphConfig, path: &Path) -> anyhow::Result<tempfile::TempPath> {
    std::fs::write(path, graph.to_toml()?).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(tempfile::TempPath::try_from_path(path)?)
}

/// Renders the dataset if it is missing and the graph names its scenario.
fn provide_dataset(graph: &GraphConfig, args: &LaunchArgs, dataset: &Path, terminal: &Terminal) -> anyhow::Result<()> {
    let complete = std::fs::read_dir(dataset)
        .is_ok_and(|entries| entries.flatten().any(|e| e.file_name().to_string_lossy().starts_with("transforms")));
    let camera = &graph.camera;
    let is_needed = camera.source.has_truth() || camera.calibration.is_some();
    let is_foreign = matches!(camera.source, CameraSource::Folder | CameraSource::External);
    if complete || !is_needed && (is_foreign || graph.scenario_path().is_none()) {
        return Ok(());
    }
    ensure!(
        args.dataset.is_none() || !dataset.exists(),
        "{} contains no dataset (no transforms.json): name another folder with --dataset, or omit it",
        dataset.display()
    );
    match graph.scenario_path() {
        Some(scenario) if args.dataset.is_none() => {
            let (missing, from) = (dataset.display(), scenario.display());
            terminal.log(LAUNCHER, &format!("INFO {missing} is missing: rendering it from {from}"));
            crate::dataset::render(&Scenario::load(&scenario)?, dataset, Extras::None).map(drop)
        }
        _ => bail!(
            "dataset {} is missing: pass --dataset, or name its scenario in the graph file (`run.scenario`){}",
            dataset.display(),
            carff_base::names::beside(dataset)
        ),
    }
}

/// Returns the scenario of the dataset. Refuses a checkpoint of another scenario, whose decisions would be confident and
/// wrong. The stage that needs a missing checkpoint reports it.
fn scenario_of(graph: &GraphConfig, dataset: &Path, checkpoint: &Path) -> anyhow::Result<Option<ScenarioInfo>> {
    let has_truth = graph.camera.source.has_truth();
    if !has_truth && graph.camera.calibration.is_none() {
        return Ok(None);
    }
    let dataset = Dataset::open(dataset)?;
    let scenario = dataset.scenario();
    if let Some(scenario) = scenario
        && checkpoint.join(carff_checkpoint::files::MANIFEST).exists()
    {
        let identity = ScenarioIdentity::of(scenario, dataset.view_count());
        Manifest::load(checkpoint)?.check_scenario(checkpoint, &identity)?;
    }
    Ok(scenario.filter(|_| has_truth).cloned())
}
