//! Tests of whole graphs of real processes with trivial stages: a normal run, a stage that dies, and a launcher that is
//! interrupted or killed.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::{
    Action, ActionCode, Belief, DatasetView, Forecast, ForecastSource, FrameMeta, Gaussian, Header, Intrinsics,
    Posterior, Reason, Rule, Stage,
};
use carff_runtime::{StageArgs, StageContext};
use carff_transport::{Run, Woken, living_processes, monotonic_now_ns, topics};
use clap::Parser;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

const HORIZON: u32 = 2;
const SIDE: u32 = 16;

/// Acts as a stage if the launcher of a test starts this program as one; otherwise does nothing.
#[test]
fn fake_stage() {
    let (Ok(role), Ok(args)) = (std::env::var("CARFF_FAKE"), std::env::var("CARFF_ARGS")) else { return };
    let args = StageArgs::try_parse_from(std::iter::once("stage").chain(args.split_whitespace())).unwrap();
    let (stage, fault) = role.split_once(':').unwrap();
    let fault = fault.to_owned();
    let code = match stage {
        "camera" => carff_runtime::run_with(Stage::Camera, args, camera),
        "encoder" => carff_runtime::run_with(Stage::Encoder, args, |stage| encoder(stage, &fault)),
        "forecaster" => carff_runtime::run_with(Stage::Forecaster, args, forecaster),
        "prober" => carff_runtime::run_with(Stage::Prober, args, prober),
        "renderer" => carff_runtime::run_with(Stage::Renderer, args, idle),
        "controller" => carff_runtime::run_with(Stage::Controller, args, controller),
        other => panic!("unknown stage {other}"),
    };
    std::process::exit(i32::from(code != ExitCode::SUCCESS));
}

fn camera(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut frames = stage.image_output(&topics::FRAME, (SIDE * SIDE * 3) as usize)?;
    stage.ready();
    for frame_id in 0..stage.args.frames.unwrap_or(u64::MAX) {
        if stage.wait_until(&[], monotonic_now_ns() + 20_000_000)? == Woken::Stopped {
            return Ok(());
        }
        let meta = FrameMeta {
            header: Header::of_frame(frame_id, monotonic_now_ns(), 1),
            width_px: SIDE,
            height_px: SIDE,
            intrinsics: Intrinsics { fl_x_px: 8.0, fl_y_px: 8.0, cx_px: 8.0, cy_px: 8.0 },
            world_from_camera: [0.0; 16],
            dataset_view: DatasetView::UNKNOWN,
            take_start: 0,
        };
        let mut loan = frames.loan((SIDE * SIDE * 3) as usize)?;
        loan.bytes_mut().fill(frame_id as u8);
        frames.send_image(loan, meta)?;
    }
    stage.wait_until(&[], monotonic_now_ns() + 300_000_000)?;
    Ok(())
}

/// Faults: `none`; `start` fails before it is ready; `once` dies during its first life only; `always` dies in each
/// life.
fn encoder(stage: &mut StageContext, fault: &str) -> anyhow::Result<()> {
    anyhow::ensure!(fault != "start", "the weights are not where they should be");
    let mut frames = stage.input(&topics::FRAME)?;
    let mut posteriors = stage.output(&topics::POSTERIOR)?;
    let mark = stage.args.graph.with_extension("died");
    stage.ready();
    let mut count = 0;
    while stage.wait(&[&frames])? {
        let Some(frame) = frames.newest()? else { continue };
        count += 1;
        if fault == "always" && count == 2 || fault == "once" && count == 5 && !mark.exists() {
            std::fs::write(&mark, "")?;
            std::process::abort();
        }
        let mut gaussian = Gaussian::standard();
        gaussian.mean[0] = f32::from(frame.bytes()[0]);
        let header = frame.header;
        let stage_latency_ns = stage.worked(&header, monotonic_now_ns());
        posteriors.send(Posterior { header, gaussian, take_start: frame.take_start, stage_latency_ns })?;
    }
    Ok(())
}

fn forecaster(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut posteriors = stage.input(&topics::POSTERIOR)?;
    let mut beliefs = stage.input(&topics::BELIEF)?;
    let mut forecasts = stage.output(&topics::FORECAST)?;
    stage.ready();
    while stage.wait(&[&posteriors, &beliefs])? {
        let observed = posteriors.newest()?.map(|p| (p.header.at_step(1), ForecastSource::Observed));
        let probed = beliefs.newest()?.filter(|b| !b.is_final());
        let probed = probed.map(|b| (b.header.at_step(b.header.step + 1), ForecastSource::Probed));
        for (header, source) in [observed, probed].into_iter().flatten() {
            let mut forecast = Forecast::empty(header, source, HORIZON);
            (forecast.component_count, forecast.sample_count, forecast.weights[0]) = (1, 1, 1.0);
            forecasts.send(forecast)?;
        }
    }
    Ok(())
}

fn prober(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut forecasts = stage.input(&topics::FORECAST)?;
    let mut beliefs = stage.output(&topics::BELIEF)?;
    stage.ready();
    while stage.wait(&[&forecasts])? {
        while let Some(forecast) = forecasts.next()? {
            let mut belief = Belief::empty(forecast.header, HORIZON);
            (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (1, 1, 1, 1);
            belief.component_weights[0] = 1.0;
            beliefs.send(belief)?;
        }
    }
    Ok(())
}

fn controller(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut beliefs = stage.input(&topics::BELIEF)?;
    let mut actions = stage.output(&topics::ACTION)?;
    stage.ready();
    while stage.wait(&[&beliefs])? {
        while let Some(belief) = beliefs.next()? {
            if !belief.is_final() {
                continue;
            }
            actions.send(Action {
                action: ActionCode::Advance.code(),
                sample_count: 1,
                confidence: 1.0,
                hazard_probability: 0.25,
                is_decision: 1,
                valid_until_ns: monotonic_now_ns(),
                based_on_frame: belief.header.frame_id,
                latency_ns: 1,
                ..Action::halt(belief.header, Reason::Belief, Rule::Calibrated)
            })?;
        }
    }
    Ok(())
}

fn idle(stage: &mut StageContext) -> anyhow::Result<()> {
    stage.ready();
    while stage.wait_until(&[], u64::MAX)? != Woken::Stopped {}
    Ok(())
}

/// A graph with its own name and folder.
struct Graph {
    folder: tempfile::TempDir,
    name: String,
}

impl Graph {
    fn new(fault: &str) -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("l{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let folder = tempfile::tempdir().unwrap();
        let test = std::env::current_exe().unwrap();
        for stage in Stage::ALL {
            let path = folder.path().join(format!("carff-{stage}"));
            let fault = if stage == Stage::Encoder { fault } else { "none" };
            let script = format!(
                "#!/bin/sh\nCARFF_FAKE={stage}:{fault} CARFF_ARGS=\"$*\" exec {} --exact launching::fake_stage --nocapture\n",
                test.display()
            );
            std::fs::write(&path, script).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        }
        let text = format!(
            "[run]\nname = \"{name}\"\ndataset = \"none\"\ncheckpoint = \"none\"\n[camera]\nsource = \"folder\"\n\
             [stages.encoder]\nrestart = {{ on-failure = {{ backoff_ms = 10, max_restarts = 2 }} }}\n"
        );
        std::fs::write(folder.path().join("graph.toml"), text).unwrap();
        Self { folder, name }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, frames: u64) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_carff-launch"));
        command
            .args(["launch", "--verbose"])
            .arg(self.path("graph.toml"))
            .args(["--frames", &frames.to_string(), "--stages"])
            .arg(self.folder.path())
            .arg("--report")
            .arg(self.path("report.json"))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    fn run(&self) -> Run {
        Run::new(&self.name, 0).unwrap()
    }

    fn assert_nothing_left(&self) {
        assert_eq!(self.run().shared_memory_files().unwrap(), Vec::<PathBuf>::new());
        assert!(!self.run().folder().exists());
        assert!(living_processes(&self.run()).unwrap().is_empty());
    }

    fn report(&self) -> Value {
        serde_json::from_str(&std::fs::read_to_string(self.path("report.json")).unwrap()).unwrap()
    }
}

impl Drop for Graph {
    fn drop(&mut self) {
        let _ = carff_transport::remove_run_leftovers(&self.run());
    }
}

fn text(output: &Output) -> String {
    format!("{}\n{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Returns a launcher that has printed its first decision.
/// Starts a run that takes every signal, also where the tests themselves run under `nohup`.
fn deciding(graph: &Graph) -> Child {
    let inner = graph.command(100_000);
    let mut command = Command::new("env");
    deciding_as(command.arg("--default-signal=HUP").arg(inner.get_program()).args(inner.get_args()))
}

fn deciding_as(command: &mut Command) -> Child {
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let stdout = child.stdout.take().unwrap();
    let mut lines = BufReader::new(stdout).lines().map_while(Result::ok);
    assert!(lines.any(|line| line.contains("hazard 0.25")), "no decision was printed");
    // Keep reading, so that the launcher never writes to a closed pipe.
    std::thread::spawn(move || lines.for_each(drop));
    child
}

fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_raw(child.id() as i32).unwrap(), signal).unwrap();
}

/// Returns true if the condition becomes true before the watchdog's limit.
fn eventually(mut condition: impl FnMut() -> bool) -> bool {
    let deadline_ns = monotonic_now_ns() + 30_000_000_000;
    while monotonic_now_ns() < deadline_ns {
        if condition() {
            return true;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    false
}

/// A run completes: each frame is recorded, decisions are printed and reported, nothing is left, and the exit code is
/// 0.
#[test]
fn a_run_ends_with_a_report_and_leaves_nothing() {
    let graph = Graph::new("none");
    let output = graph.command(20).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let report = graph.report();
    assert_eq!(report["frames"], 20, "{}", text(&output));
    assert_eq!(report["restarts"], 0);
    let decisions = report["decisions"].as_u64().unwrap();
    assert!((1..=20).contains(&decisions), "{report}");
    assert!(report["latency_ms"]["camera_to_action"]["p99"].as_f64().unwrap() > 0.0);
    assert!(report["memory_mb"]["encoder"].as_f64().unwrap() > 0.0, "{report}");
    assert_eq!(text(&output).matches("hazard 0.25").count() as u64, decisions);
    graph.assert_nothing_left();
}

/// Returns what a run of 60 frames shows in a terminal of 80 columns.
fn shown_in(graph: &Graph, terminal: &str) -> String {
    let inner = graph.command(60);
    let words = std::iter::once(inner.get_program()).chain(inner.get_args().filter(|arg| *arg != "--verbose"));
    let line = words.map(|word| format!("'{}'", word.to_str().unwrap())).collect::<Vec<_>>().join(" ");
    let mut command = Command::new("script");
    command.args(["-qec", &format!("stty cols 80 rows 24; exec {line}"), "/dev/null"]).env("TERM", terminal);
    let output = command.stdin(Stdio::null()).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// A terminal without any control sequence gets none: neither colours nor lines that are drawn again.
#[test]
fn a_dumb_terminal() {
    let graph = Graph::new("none");
    let shown = shown_in(&graph, "dumb");
    assert!(!shown.contains('\x1b') && shown.contains("frames"), "{shown}");
    graph.assert_nothing_left();
}

/// In a terminal of 80 columns, each status line fits, is drawn in place, and shows only whole values.
#[test]
fn a_narrow_terminal() {
    let graph = Graph::new("none");
    let shown = shown_in(&graph, "xterm");
    let plain = without_escapes(&shown);
    let statuses: Vec<&str> = plain.split(['\r', '\n']).filter(|line| line.contains("skipped 0, restarts 0")).collect();
    assert!(!statuses.is_empty(), "{shown:?}");
    assert!(statuses.iter().all(|line| line.trim_end().chars().count() <= 80), "{statuses:?}");
    assert!(!plain.lines().any(|line| line.trim_end().ends_with("all stages ok")), "a status scrolls by: {shown:?}");
}

/// Removes the control sequences of a terminal.
fn without_escapes(text: &str) -> String {
    let mut plain = String::new();
    let mut rest = text;
    while let Some(at) = rest.find('\x1b') {
        plain += &rest[..at];
        let end = rest[at + 2..].find(|c: char| c.is_ascii_alphabetic()).map_or(rest.len(), |end| at + 2 + end + 1);
        rest = &rest[end.min(rest.len())..];
    }
    plain + rest
}

/// A stage that dies during a run is restarted, the run completes, and the report counts the restart.
#[test]
fn a_dead_stage_is_started_again() {
    let graph = Graph::new("once");
    let output = graph.command(100).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let report = graph.report();
    assert_eq!(report["restarts_by_stage"]["encoder"], 1, "{}", text(&output));
    assert_eq!(report["frames"], 100, "{report}\n{}", text(&output));
    assert!(report["decisions"].as_u64().unwrap() > 5, "decisions continued after the restart: {report}");
    assert!(text(&output).contains("stage encoder died (killed by signal 6)"), "{}", text(&output));
    graph.assert_nothing_left();
}

/// A stage that keeps dying is lost: one clear sentence, exit code 1, nothing left.
#[test]
fn a_lost_stage_ends_the_run() {
    let graph = Graph::new("always");
    let output = graph.command(100_000).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("error: stage `encoder` is lost after 2 restarts:"), "{}", text(&output));
    graph.assert_nothing_left();
}

/// A stage that cannot start ends the launch with the stage's own error, without restarts.
#[test]
fn a_stage_that_cannot_start_says_why() {
    let graph = Graph::new("start");
    let output = graph.command(10).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let wanted = "error: stage `encoder` did not start: the weights are not where they should be";
    assert!(text(&output).contains(wanted), "{}", text(&output));
    graph.assert_nothing_left();
}

/// Ctrl-C, SIGTERM and the end of the terminal end all processes and leave nothing behind; the report of the frames so
/// far is written.
#[test]
fn an_interrupt_ends_everything() {
    for kind in [Signal::INT, Signal::TERM, Signal::HUP] {
        let graph = Graph::new("none");
        let mut child = deciding(&graph);
        assert!(!living_processes(&graph.run()).unwrap().is_empty());
        signal(&child, kind);
        assert_eq!(child.wait().unwrap().code(), Some(130), "{kind:?}");
        graph.assert_nothing_left();
        let report = graph.report();
        assert_eq!(report["interrupted"], true, "{report}");
        assert!(report["decisions"].as_u64().unwrap() > 0, "{report}");
    }
}

/// A benchmark of processes that is interrupted leaves neither folders nor files in shared memory.
#[test]
fn an_interrupted_benchmark_leaves_nothing() {
    let files = |dir: &Path| std::fs::read_dir(dir).into_iter().flatten().flatten().map(|e| e.path());
    for kind in [Signal::INT, Signal::TERM] {
        let folder = tempfile::Builder::new().prefix("b").tempdir_in("/tmp").unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_carff-launch"));
        command.args(["bench", "ipc", "--messages", "1000000"]).env("TMPDIR", folder.path());
        command.env_remove("XDG_RUNTIME_DIR").env_remove("RUNTIME_DIRECTORY").stdout(Stdio::null());
        let mut child = command.stderr(Stdio::null()).spawn().unwrap();
        // The run of the typed topics, in the folder of this user's runs.
        let run = || {
            let mut runs = files(folder.path()).flat_map(|dir| files(&dir).collect::<Vec<_>>());
            runs.find_map(|path| {
                let name = path.file_name()?.to_str()?.to_owned();
                name.starts_with("bench-").then(|| Run::within(path.parent()?, &name, 1).ok())?
            })
        };
        let shared = |run: &Run| {
            let bare = format!("carff-{}_", run.name());
            let is_bare = |path: &PathBuf| path.file_name().is_some_and(|n| n.to_string_lossy().starts_with(&bare));
            let bare = files(Path::new("/dev/shm")).filter(is_bare).count();
            [bare, run.shared_memory_files().unwrap().len()]
        };
        assert!(eventually(|| run().is_some_and(|run| shared(&run).iter().all(|&count| count > 0))));
        let run = run().unwrap();
        signal(&child, kind);
        assert_eq!(child.wait().unwrap().code(), Some(130), "{kind:?}");
        assert_eq!((shared(&run), run.folder().exists()), ([0, 0], false), "{kind:?}");
        let left: Vec<PathBuf> = files(folder.path()).filter(|path| path != run.dir()).collect();
        assert_eq!(left, Vec::<PathBuf>::new(), "{kind:?}");
    }
}

/// A launcher that is stopped (Ctrl-Z) while its stages continue counts what it could not read, so that the figures of the
/// report agree.
#[test]
fn a_stopped_launcher_counts_what_it_missed() {
    const FRAMES: u64 = 200;
    let graph = Graph::new("none");
    let mut child = deciding_as(&mut graph.command(FRAMES));
    signal(&child, Signal::STOP);
    // The camera has ended, and its stopped parent has not noticed.
    let children = format!("/proc/{0}/task/{0}/children", child.id());
    let has_ended = |pid: &str| std::fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|s| s.contains(") Z "));
    let any_ended = || std::fs::read_to_string(&children).unwrap().split_whitespace().any(has_ended);
    let ended = eventually(any_ended);
    signal(&child, Signal::CONT);
    assert!(ended, "the camera did not end");
    assert_eq!(child.wait().unwrap().code(), Some(0));
    let (report, text) = (graph.report(), std::fs::read_to_string(graph.path("report.txt")).unwrap());
    let count = |key: &str| report[key].as_u64().unwrap();
    assert_eq!(count("frames"), FRAMES, "{report}");
    assert!(count("decisions") + count("frames_not_recorded") <= FRAMES, "{report}");
    assert!(count("frames_not_recorded") + count("actions_not_recorded") > 0, "{report}");
    assert!(text.contains("not recorded, because the launcher was stopped or slow"), "{text}");
    graph.assert_nothing_left();
}

/// `nohup` keeps a run alive when its terminal ends.
#[test]
fn nohup_is_respected() {
    let graph = Graph::new("none");
    let decisions = graph.path("decisions.jsonl");
    let mut inner = graph.command(100_000);
    inner.arg("--decisions").arg(&decisions);
    let mut command = Command::new("nohup");
    command.arg(inner.get_program()).args(inner.get_args());
    let mut child = deciding_as(&mut command);
    signal(&child, Signal::HUP);
    let count = || std::fs::read_to_string(&decisions).unwrap().lines().count();
    let before = count();
    assert!(eventually(|| count() > before + 5), "decisions continue");
    signal(&child, Signal::TERM);
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(graph.report()["interrupted"].as_bool().unwrap());
}

/// A report or a file of decisions that cannot be written is refused before any stage starts, and so is a report whose
/// text would overwrite it.
#[test]
fn an_unwritable_report_is_refused_first() {
    let graph = Graph::new("start");
    let refused = |option: &str, path: &str, wanted: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_carff-launch"));
        command.arg("launch").arg(graph.path("graph.toml")).arg("--stages").arg(graph.folder.path());
        let output = command.args([option, path]).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        assert!(text(&output).contains(&format!("error: {wanted}")), "{}", text(&output));
        assert!(!text(&output).contains("did not start"), "{}", text(&output));
    };
    for option in ["--report", "--decisions"] {
        for path in ["/proc/nowhere/report.json", "/dev/null/report.json"] {
            refused(option, path, &format!("cannot write {path}"));
        }
    }
    refused("--report", "report.txt", "--report report.txt: this is the JSON file; its text");
    // Nor does the report overwrite the decisions, or one of them the graph file.
    let report = graph.path("report.json").display().to_string();
    for name in ["report.json", "report.txt", "report.png", "graph.toml"] {
        let decisions = graph.path(name).display().to_string();
        let mut command = graph.command(10);
        let output = command.args(["--decisions", &decisions]).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{}", text(&output));
        assert!(text(&output).contains(&format!("error: {decisions} would overwrite")), "{}", text(&output));
    }
    assert!(!Path::new(&report).exists());
}

/// Each decision is one line of the JSON file, with its source and without the truth; without `--verbose`, a source
/// without drives prints only changes of the action.
#[test]
fn decisions_become_json_lines() {
    let graph = Graph::new("none");
    let file = graph.path("decisions.jsonl");
    let output = graph.command(20).arg("--decisions").arg(&file).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let lines: Vec<Value> =
        std::fs::read_to_string(&file).unwrap().lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(lines.len() as u64, graph.report()["decisions"].as_u64().unwrap());
    let last = lines.last().unwrap();
    assert_eq!((&last["action"], &last["reason"]), (&"advance".into(), &"belief".into()), "{last}");
    assert_eq!((last["hazard"].as_f64(), last["source"].is_null()), (Some(0.25), true), "{last}");
    assert!(last["latency_ms"].as_f64().unwrap() > 0.0 && last["capture_time_ns"].as_u64().unwrap() > 0, "{last}");
    let keys: Vec<&str> = last.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(
        keys,
        ["action", "capture_time_ns", "drive", "frame", "hazard", "latency_ms", "reason", "source", "unknown"]
    );
}

/// A full standard output does not disturb the run, and its end reports the error.
#[test]
fn a_full_output_is_an_error_at_the_end() {
    let graph = Graph::new("none");
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = graph.command(20).stdout(full).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    assert!(text(&output).contains("No space left on device"), "{}", text(&output));
    assert!(!text(&output).contains("panicked"), "{}", text(&output));
    assert_eq!(graph.report()["frames"], 20);
    for command in [
        &["schema", "graph"][..],
        &["completions", "bash"],
        &["doctor"],
        &["--help"],
        &["--version"],
        &["help", "launch"],
        &["probe", "echo", "-h"],
    ] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_carff-launch")).args(command).stdout(full).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{command:?}: {}", text(&output));
        assert!(!text(&output).contains("panicked"), "{command:?}: {}", text(&output));
    }
}

/// Settings of the command line reach the effective configuration, are checked as those of the file, and reach the
/// stages; a graph file can come from a pipe.
#[test]
fn settings_change_the_effective_configuration() {
    let graph = Graph::new("none");
    let launch = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_carff-launch"));
        text(&command.arg("launch").arg(graph.path("graph.toml")).args(args).output().unwrap())
    };
    let printed = launch(&["--print-config", "--set", "run.samples=35", "--set", "stages.encoder.log=\"debug\""]);
    assert!(printed.contains("samples = 35") && printed.contains("log = \"debug\""), "{printed}");
    for (setting, wanted) in [
        ("run.samples=100000", "`run.samples` is 100000; allowed:"),
        ("run.smaples=3", "unknown field `smaples`"),
        ("run.samples", "`run.samples` sets nothing"),
    ] {
        assert!(launch(&["--set", setting]).contains(wanted), "{}", launch(&["--set", setting]));
    }

    let piped = graph.command(20);
    let script = format!("exec \"$0\" launch <(cat {}) \"${{@:3}}\"", graph.path("graph.toml").display());
    let mut command = Command::new("bash");
    command.args(["-c", &script]).arg(piped.get_program()).args(piped.get_args().skip(1));
    let output = command.args(["--set", "run.samples=3"]).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert_eq!(graph.report()["frames"], 20);
    graph.assert_nothing_left();
}

/// A second launch of the same run is refused with the name of the first run; under another name it runs.
#[test]
fn a_second_launch_of_a_run_is_refused() {
    let graph = Graph::new("none");
    let mut first = deciding(&graph);
    let second = graph.command(10).output().unwrap();
    assert_eq!(second.status.code(), Some(1));
    let wanted = format!("run `{}` is already running (process {}", graph.name, first.id());
    assert!(text(&second).contains(&wanted), "{}", text(&second));

    let other = Graph { folder: tempfile::tempdir().unwrap(), name: format!("{}x", graph.name) };
    let beside = graph.command(10).args(["--run", &other.name]).output().unwrap();
    assert!(beside.status.success(), "{}", text(&beside));
    other.assert_nothing_left();
    signal(&first, Signal::TERM);
    first.wait().unwrap();
    graph.assert_nothing_left();
}

/// A living run is listed, its log is printed while it lives and after its end, and `stop` ends it as Ctrl-C does.
#[test]
fn a_run_is_listed_logged_and_stopped() {
    let graph = Graph::new("none");
    let mut launcher = deciding(&graph);
    let carff = |args: &[&str]| Command::new(env!("CARGO_BIN_EXE_carff-launch")).args(args).output().unwrap();
    let listed = || -> Option<Value> {
        let runs: Vec<Value> = serde_json::from_slice(&carff(&["ps", "--json"]).stdout).unwrap();
        runs.into_iter().find(|run| run["run"] == graph.name.as_str())
    };
    let run = listed().unwrap();
    assert_eq!(
        (&run["pid"], &run["graph"]),
        (&launcher.id().into(), &graph.path("graph.toml").to_str().unwrap().into())
    );
    let logged = || text(&carff(&["logs", &graph.name]));
    assert!(logged().contains("[encoder] INFO ready"), "{}", logged());
    let stopped = carff(&["stop", &graph.name]);
    assert!(stopped.status.success(), "{}", text(&stopped));
    assert_eq!((launcher.wait().unwrap().code(), listed()), (Some(130), None));
    assert!(logged().contains("[launcher] INFO interrupted"), "{}", logged());
    assert_eq!(carff(&["stop", &graph.name]).status.code(), Some(1));
    assert_eq!(graph.report()["interrupted"], true);
    graph.assert_nothing_left();
}

/// If the launcher is killed, its stages end by themselves, and the next launch of that run works.
#[test]
fn a_killed_launcher_leaves_no_stage_and_no_obstacle() {
    let graph = Graph::new("none");
    let mut child = deciding(&graph);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(eventually(|| living_processes(&graph.run()).unwrap().is_empty()), "stages outlive their launcher");
    let output = graph.command(10).output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    graph.assert_nothing_left();
}

/// Missing and wrong graph files cause one clear sentence each.
#[test]
fn wrong_graph_files_are_named() {
    let graph = Graph::new("none");
    let launch = |path: &Path| {
        let output = Command::new(env!("CARGO_BIN_EXE_carff-launch")).arg("launch").arg(path).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        text(&output)
    };
    let missing = launch(&graph.path("none.toml"));
    assert!(missing.contains("cannot read the graph file") && missing.contains("none.toml"), "{missing}");
    std::fs::write(graph.path("wrong.toml"), "[run]\nname = \"x\"\nhorizn = 2\n").unwrap();
    let wrong = launch(&graph.path("wrong.toml"));
    assert!(wrong.contains("wrong.toml:3: `run.horizn`: unknown field `horizn`, expected one of"), "{wrong}");
    std::fs::write(
        graph.path("bare.toml"),
        format!("[run]\nname = \"{}\"\ndataset = \"nowhere\"\ncheckpoint = \"nowhere\"\n", graph.name),
    )
    .unwrap();
    let bare = launch(&graph.path("bare.toml"));
    assert!(bare.contains("is missing: pass --dataset"), "{bare}");
}
