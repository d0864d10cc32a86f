//! `carff launch`: starts a graph, watches it, prints its decisions, ends it, and writes a report.

use crate::planning::{self, Planning};
use crate::report::{self, RunOutcome};
use crate::supervision::monitor::FrameRecord;
use crate::supervision::{Ended, Feed, LAUNCHER, Supervisor};
use anyhow::{Context, anyhow, bail, ensure};
use carff::terminal::Terminal;
use carff_checkpoint::{Manifest, ScenarioIdentity};
use carff_config::{CameraSource, GraphConfig};
use carff_dataset::Dataset;
use carff_messages::{ActionCode, Observability};
use carff_observe::{RunLock, RunRecord};
use carff_runtime::StageArgs;
use carff_scenes::{Extras, Scenario};
use carff_transport::{
    Node, Run, Stop, check_space, monotonic_now_ns, remove_run_leftovers, run_id_of, runtime_dir, topics,
};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

/// Exit code after Ctrl-C, as in shells: 128 plus the signal's number.
pub(crate) const INTERRUPTED: u8 = 130;
/// Assumed bytes of a frame in the check of shared memory, before the image size is known.
pub(crate) const FRAME_BYTES: usize = 1 << 17;

/// Start a graph.
#[derive(Clone, Debug, clap::Args)]
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
    /// Folder of the stages' programs; default: this program's folder.
    #[arg(long, hide = true)]
    pub stages: Option<PathBuf>,
}

/// Launches a graph. Ends when the camera is done (exit code 0), on Ctrl-C (130), or with an error when a stage is
/// lost.
pub fn run(args: &LaunchArgs) -> anyhow::Result<ExitCode> {
    let terminal = Arc::new(Terminal::new());
    let (ended, outcome) = run_graph(args, None, &terminal)?;
    if ended == Ended::Interrupted {
        terminal.log(LAUNCHER, "INFO interrupted: all stages have ended");
        return Ok(ExitCode::from(INTERRUPTED));
    }
    report(args, &Arc::new(outcome), &terminal)
}

/// Prints and writes the report of a finished run.
fn report(args: &LaunchArgs, outcome: &Arc<RunOutcome>, terminal: &Terminal) -> anyhow::Result<ExitCode> {
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let planning = evaluate(outcome, &stop, terminal)?;
    if stop.is_stopped() {
        return Ok(ExitCode::from(INTERRUPTED));
    }
    let tables = planning.as_ref().map(Planning::tables).transpose()?.unwrap_or_default();
    let report = report::json(outcome, tables);
    let text = format!("{}\n{}", summary(&report), planning.as_ref().map_or("", Planning::text));
    terminal.line(&text);
    if let Some(path) = &args.report {
        write(path, &(serde_json::to_string_pretty(&report)? + "\n"))?;
        let page = path.with_extension("txt");
        write(&page, &text)?;
        terminal.line(&format!("report: {}\nJSON: {}", page.display(), path.display()));
        if let Some(planning) = &planning {
            let strip = path.with_extension("png");
            planning.write_filmstrip(&strip)?;
            terminal.line(&format!("filmstrip: {}", strip.display()));
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Starts a graph, and watches it to its end.
pub(crate) fn run_graph(
    args: &LaunchArgs,
    feed: Option<Feed>,
    terminal: &Arc<Terminal>,
) -> anyhow::Result<(Ended, RunOutcome)> {
    let graph = GraphConfig::load(&args.graph)?;
    terminal.set_log_format(graph.launcher.log_format);
    for warning in graph.warnings() {
        terminal.log(LAUNCHER, &format!("WARN {}: {warning}", args.graph.display()));
    }
    let name = args.run.clone().unwrap_or_else(|| graph.run.name.clone());
    let run = Run::new(&name, run_id_of(&name, monotonic_now_ns()))?;
    let dataset = graph.resolve(args.dataset.as_ref().unwrap_or(&graph.run.dataset));
    let checkpoint = graph.resolve(args.checkpoint.as_ref().unwrap_or(&graph.run.checkpoint));
    let absolute = |path: &Path| std::path::absolute(path).map(|p| p.display().to_string());
    let record = RunRecord {
        pid: std::process::id(),
        run_id: run.id(),
        graph: absolute(&args.graph)?,
        dataset: absolute(&dataset)?,
        checkpoint: absolute(&checkpoint)?,
        started_unix_s: SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs(),
    };
    let lock = RunLock::take(&runtime_dir(), &name, &record, "--run")?;
    lock.sweep(&run, "--run")?;

    // A feed brings its own images.
    if feed.is_none() {
        provide_dataset(&graph, args, &dataset, terminal)?;
        refuse_another_scenario(&graph, &dataset, &checkpoint)?;
    }
    // From here on Ctrl-C ends the run in order. Before, no stage runs, and the process may simply end.
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let view_bytes = carff_messages::rgb_bytes(graph.renderer.width_px, graph.renderer.height_px);
    check_space(Path::new("/dev/shm"), "the graph", topics::graph_bytes(FRAME_BYTES, view_bytes))?;

    let mut stage_args = StageArgs::new(&args.graph, &name, run.id());
    stage_args.dataset = Some(dataset.clone());
    stage_args.checkpoint = Some(checkpoint.clone());
    (stage_args.drives, stage_args.frames) = (args.drives, args.frames);
    stage_args.parent_pid = Some(std::process::id());
    let folder = match &args.stages {
        Some(folder) => folder.clone(),
        None => std::env::current_exe()?.parent().context("this program has no folder")?.to_owned(),
    };

    let result = {
        let node = Node::open(&run, "launcher")?;
        let drives = args.drives.unwrap_or(graph.camera.drives);
        let decided = |frame: &FrameRecord| terminal.line(&decision_line(frame, &graph, drives, terminal));
        let mut supervisor = Supervisor::new(&node, &graph, (folder, stage_args), &stop, terminal, &decided)?;
        let result = supervisor.drive(&run, &stop, feed);
        terminal.status(String::new());
        supervisor.shut_down();
        result.map(|ended| {
            let outcome = RunOutcome {
                run: name,
                graph: args.graph.display().to_string(),
                seed: graph.run.seed,
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
    result
}

/// Computes the planning tables on a separate thread, so that Ctrl-C still ends the program. Returns none after Ctrl-C,
/// and for a run without drives.
fn evaluate(outcome: &Arc<RunOutcome>, stop: &Stop, terminal: &Terminal) -> anyhow::Result<Option<Planning>> {
    let theirs = Arc::clone(outcome);
    let work = std::thread::spawn(move || planning::evaluate(&theirs));
    let started_ns = monotonic_now_ns();
    while !work.is_finished() {
        if stop.is_stopped() {
            return Ok(None);
        }
        let seconds = (monotonic_now_ns() - started_ns) / 1_000_000_000;
        terminal.status(format!("planning table over every eligible view: {seconds} s"));
        std::thread::sleep(Duration::from_millis(50));
    }
    terminal.status(String::new());
    work.join().map_err(|_| anyhow!("the computation of the planning table failed"))?
}

/// Renders the dataset if it is missing and the graph names its scenario.
fn provide_dataset(graph: &GraphConfig, args: &LaunchArgs, dataset: &Path, terminal: &Terminal) -> anyhow::Result<()> {
    let complete = std::fs::read_dir(dataset)
        .is_ok_and(|entries| entries.flatten().any(|e| e.file_name().to_string_lossy().starts_with("transforms")));
    if complete || graph.camera.source == CameraSource::Folder {
        return Ok(());
    }
    ensure!(
        args.dataset.is_none() || !dataset.exists(),
        "{} contains no dataset (no transforms.json)",
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

/// Refuses a checkpoint of another scenario, whose decisions would be confident and wrong. The stage that needs a
/// missing checkpoint reports it.
fn refuse_another_scenario(graph: &GraphConfig, dataset: &Path, checkpoint: &Path) -> anyhow::Result<()> {
    if graph.camera.source == CameraSource::Folder || !checkpoint.join(carff_checkpoint::files::MANIFEST).exists() {
        return Ok(());
    }
    let manifest = Manifest::load(checkpoint)?;
    let dataset = Dataset::open(dataset)?;
    match dataset.scenario() {
        Some(scenario) => {
            Ok(manifest.check_scenario(checkpoint, &ScenarioIdentity::of(scenario, dataset.view_count()))?)
        }
        None => Ok(()),
    }
}

fn decision_line(frame: &FrameRecord, graph: &GraphConfig, drives: u32, terminal: &Terminal) -> String {
    let action = match frame.action {
        Some(ActionCode::Advance) => terminal.alarm("advance", false),
        _ => terminal.alarm("HALT   ", true),
    };
    let place = if frame.drive >= 0 {
        format!(
            "drive {:>3}/{drives}  t{} frame {:>2}/{}  view {:>3}  {:<8}",
            frame.drive + 1,
            frame.timestamp,
            frame.frame_in_drive % graph.camera.frames_per_timestamp as i32 + 1,
            graph.camera.frames_per_timestamp,
            frame.view,
            frame.observability.map_or("unknown", Observability::name)
        )
    } else {
        format!("frame {:>6}", frame.frame_id)
    };
    format!("{place}  hazard {:.2}  {action}  {:>6.1} ms", frame.hazard_probability, frame.latency_ns as f64 / 1e6)
}

fn summary(report: &Value) -> String {
    let latency = &report["latency_ms"]["camera_to_action"];
    let ms = |key: &str| latency[key].as_f64().map_or("-".to_owned(), |v| format!("{v:.1}"));
    format!(
        "{} frames, {} decisions, {} actions, {} skipped, {} restarts; camera to action: p50 {} ms, p99 {} ms, max {} ms",
        report["frames"],
        report["decisions"],
        report["actions"],
        report["skipped"],
        report["restarts"],
        ms("p50"),
        ms("p99"),
        ms("max")
    )
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    let context = || format!("cannot write {}", path.display());
    if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).with_context(context)?;
    }
    std::fs::write(path, text).with_context(context)
}
