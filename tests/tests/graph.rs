//! Tests of whole graphs: the shipped programs on the shipped checkpoint, launched as a user launches them.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_dataset::Image;
use carff_messages::Stage;
use carff_tests::{
    PATIENT, Process, TestGraph, WATCHDOG, copy_checkpoint, decisions, eventually, program, project_root, scenario_set,
    shipped_checkpoint,
};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::os::unix::net::UnixDatagram;

/// The shipped graph file drives the shipped checkpoint: the exit code is 0, the report has every promised key, and
/// neither a process nor a file in shared memory is left.
#[test]
fn the_shipped_graph_drives() {
    let (set, checkpoint) = (scenario_set(), shipped_checkpoint());
    let graph = TestGraph::new(&set, &checkpoint, "");
    let shipped = project_root().join("configs/graphs/approaching-intersection.toml");
    let (set, checkpoint) = (set.to_str().unwrap(), checkpoint.to_str().unwrap());
    // Slowly, so that also a busy machine decides on both drives.
    let slowly = ["--set", "run.frame_rate_hz=3"];
    let args = ["--drives", "2", "--dataset", set, "--checkpoint", checkpoint, "--report", "report.json", "--tables"];
    let args = [&args[..], &slowly].concat();
    let finished = Process::start(&mut graph.launch(&shipped, &args)).end();
    finished.assert_success();
    graph.assert_nothing_left();

    let report = graph.report();
    let number = |value: &Value, what: &str| {
        value.as_f64().unwrap_or_else(|| panic!("{what} is {value}, not a number:\n{report:#}"))
    };
    // Two drives of three time steps with six frames each.
    assert!((1.0..=36.0).contains(&number(&report["frames"], "frames")), "{report:#}");
    assert!(number(&report["actions"], "actions") > 0.0);
    assert!(number(&report["skipped"], "skipped") >= 0.0);
    assert!(number(&report["restarts"], "restarts") == 0.0, "{}", finished.text);
    for part in ["camera_to_action", "encoder", "forecaster", "prober", "renderer"] {
        for quantile in ["p50", "p99", "max"] {
            assert!(report["latency_ms"][part].get(quantile).is_some(), "latency_ms.{part}.{quantile}:\n{report:#}");
        }
    }
    for stage in Stage::ALL {
        assert!(number(&report["memory_mb"][stage.name()], stage.name()) > 0.0);
    }
    for table in ["drives", "all_views", "unseen_views"] {
        for rule in ["underconfident", "overconfident", "paper", "calibrated"] {
            for samples in ["2", "10", "35"] {
                for kind in ["hazard", "clear"] {
                    let cell = &report["planning"][table][rule][samples][kind];
                    let what = format!("planning.{table}.{rule}.{samples}.{kind}");
                    let (success, trials) = (number(&cell["success"], &what), number(&cell["trials"], &what));
                    assert!(success <= trials, "{what}: {cell}");
                    // These two rules do not depend on the models.
                    match (rule, kind) {
                        ("underconfident", "hazard") | ("overconfident", "clear") => {
                            assert!(success == trials, "{what}");
                        }
                        ("underconfident", "clear") | ("overconfident", "hazard") => assert!(success == 0.0, "{what}"),
                        _ => {}
                    }
                }
            }
        }
    }
    let live = &report["planning"]["live"];
    for rule in ["underconfident", "overconfident", "paper", "calibrated"] {
        let agreement = &live["rules"][rule];
        assert!(number(&agreement["compared"], rule) > 0.0, "{live:#}");
        assert_eq!(agreement["agrees_with_library"], agreement["compared"], "{rule}: {live:#}");
    }
    let trials = |kind: &str| number(&report["planning"]["all_views"]["calibrated"]["10"][kind]["trials"], kind);
    assert!(trials("hazard") + trials("clear") >= 300.0, "{report:#}");
}

/// A run computes the tables of the rules only on request. A signal while it computes them ends it with exit code 130; the
/// run's own report, JSON and filmstrip are then written.
#[test]
fn tables_are_computed_on_request() {
    let drive = |more: &[&str]| {
        let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT);
        let args = [&["--drives", "1", "--report", "report.json"], more].concat();
        let launcher = Process::start(&mut graph.launch(&graph.file(), &args));
        (graph, launcher)
    };
    let (graph, launcher) = drive(&[]);
    launcher.end().assert_success();
    let report = graph.report();
    assert!(report["decisions"].as_u64() > Some(0) && report.get("planning").is_none(), "{report:#}");

    for kind in [Signal::INT, Signal::TERM, Signal::HUP] {
        let (graph, mut launcher) = drive(&["--tables"]);
        launcher.wait_for("own report", |text| text.contains("filmstrip: "));
        launcher.signal(kind);
        let finished = launcher.end();
        assert_eq!(finished.status.code(), Some(130), "{kind:?}: {}", finished.text);
        let report = graph.report();
        assert!(report["decisions"].as_u64() > Some(0) && report.get("planning").is_none(), "{report:#}");
        for written in ["report.txt", "report.png"] {
            assert!(graph.path(written).metadata().unwrap().len() > 0, "{written}");
        }
        graph.assert_nothing_left();
    }
}

/// Ctrl-C ends all processes of a working graph, with the shell's exit code for it, and leaves nothing behind.
#[test]
fn an_interrupt_leaves_nothing() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &format!("{PATIENT}[camera]\nrepeat = true\n"));
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 3);
    for stage in Stage::ALL {
        assert!(graph.stage_pid(stage).is_some(), "stage {stage} is not running");
    }
    assert!(!graph.run().shared_memory_files().unwrap().is_empty());
    launcher.signal(Signal::INT);
    let finished = launcher.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    graph.assert_nothing_left();
}

/// A signal ends each command in each phase with exit code 130, also while it computes with models. It takes no signal
/// before it has become the program of the command.
#[test]
fn a_signal_ends_every_command() {
    let (set, checkpoint) = (scenario_set(), shipped_checkpoint());
    let (set, checkpoint) = (set.to_str().unwrap(), checkpoint.to_str().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let out = |name: &str| folder.path().join(name).display().to_string();
    let (results, data) = (out("results"), out("data"));
    let scenario = project_root().join("configs/scenarios/two-lane-merge.toml");
    let commands = [
        &["eval", checkpoint, "--dataset", set, "--out", &results][..],
        &["dataset", "render", scenario.to_str().unwrap(), "--out", &data],
        &["bench", "field"],
        &["bench", "encoder"],
        // It waits for a run of its own: the runs of other tests end at any time, and the command with them.
        &["metrics", "--listen", "127.0.0.1:0", "--wait", "--run", "not-running"],
    ];
    for command in commands {
        for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
            // Also where the tests themselves run under `nohup`.
            let mut started = std::process::Command::new("env");
            started.args(["--default-signal=HUP", "--unset=ORT_DISABLE_TELEMETRY"]).arg(program("carff")).args(command);
            let process = Process::start(started.current_dir(project_root()));
            assert!(eventually(|| process.catches(signal)), "{command:?} takes no {signal:?}");
            process.signal(signal);
            let finished = process.end();
            assert_eq!(finished.status.code(), Some(130), "{command:?}, {signal:?}: {}", finished.text);
            assert!(!finished.text.contains("panicked"), "{command:?}: {}", finished.text);
        }
    }
}

/// With `launcher.log_format = "json"` every line of the log is an object with time, source, level and message,
/// including the launcher's own lines.
#[test]
fn logs_are_json_where_asked_for() {
    let more = format!("{PATIENT}log_format = \"json\"\n[camera]\nrepeat = true\n");
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &more);
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 1);
    launcher.signal(Signal::INT);
    let text = launcher.end().text;
    let lines: Vec<Value> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    assert!(!text.contains("[encoder] ") && !text.contains("[launcher] "), "{text}");
    let said = |source: &str, message: &str| {
        lines.iter().any(|line| {
            let holds = |key: &str, wanted: &str| line[key].as_str().is_some_and(|found| found.contains(wanted));
            holds("source", source) && holds("level", "INFO") && holds("message", message) && holds("time", "T")
        })
    };
    for stage in Stage::ALL {
        assert!(said(stage.name(), "ready"), "stage {stage}:\n{text}");
    }
    assert!(said("launcher", "interrupted"), "{text}");
}

/// A service manager is notified that the graph is ready (after all stages), that it is alive while it runs, and that
/// it stops.
#[test]
fn a_service_manager_is_told() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &format!("{PATIENT}[camera]\nrepeat = true\n"));
    let socket = UnixDatagram::bind(graph.path("notify")).unwrap();
    socket.set_read_timeout(Some(WATCHDOG)).unwrap();
    let hear = || {
        let mut bytes = [0; 256];
        let count = socket.recv(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes[..count]).trim().to_owned()
    };
    let mut command = graph.launch(&graph.file(), &[]);
    command.env("NOTIFY_SOCKET", graph.path("notify")).env("WATCHDOG_USEC", "200000").env_remove("WATCHDOG_PID");
    let launcher = Process::start(&mut command);
    let mut before_ready = Vec::new();
    loop {
        match hear().as_str() {
            "READY=1" => break,
            other => before_ready.push(other.to_owned()),
        }
    }
    assert!(before_ready.iter().all(|word| word == "WATCHDOG=1"), "{before_ready:?}");
    for stage in Stage::ALL {
        assert!(graph.stage_pid(stage).is_some(), "stage {stage} is not running");
    }
    for _ in 0..3 {
        assert_eq!(hear(), "WATCHDOG=1");
    }
    launcher.signal(Signal::INT);
    while hear() != "STOPPING=1" {}
    assert_eq!(launcher.end().status.code(), Some(130));
}

/// Each stage except the camera may be killed: the launcher restarts it, and decisions continue.
#[test]
fn killed_stages_are_started_again() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &format!("{PATIENT}[camera]\nrepeat = true\n"));
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 1);
    for stage in [Stage::Encoder, Stage::Forecaster, Stage::Prober, Stage::Renderer, Stage::Controller] {
        let killed = graph.stage_pid(stage).unwrap();
        kill_process(Pid::from_raw(killed as i32).unwrap(), Signal::KILL).unwrap();
        let died = format!("stage {stage} died");
        launcher.wait_for("a report of its death", |text| text.contains(&died));
        let lives = || graph.stage_pid(stage).is_some_and(|pid| pid != killed);
        assert!(eventually(lives), "stage {stage} was not restarted:\n{}", launcher.text());
        // Frames in progress may still be decided on without the dead stage; this many more cannot.
        let before = decisions(&launcher.text());
        launcher.wait_for("further decisions", |text| decisions(text) >= before + 10);
    }
    launcher.signal(Signal::INT);
    let finished = launcher.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    graph.assert_nothing_left();
}

/// A camera without restarts ends the run with one sentence when it dies.
#[test]
fn a_lost_camera_ends_the_run() {
    let graph = TestGraph::new(
        &scenario_set(),
        &shipped_checkpoint(),
        &format!("{PATIENT}[camera]\nrepeat = true\n[stages.camera]\nrestart = \"never\"\n"),
    );
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 1);
    let camera = graph.stage_pid(Stage::Camera).unwrap();
    kill_process(Pid::from_raw(camera as i32).unwrap(), Signal::KILL).unwrap();
    launcher.end().assert_one_error(&["stage `camera` is lost", "signal 9"]);
    graph.assert_nothing_left();
}

/// In a folder with a broken image and an image of another size, both are reported as errors of the camera, and the
/// graph decides on the other images.
#[test]
fn bad_images_are_left_out() {
    let images = tempfile::tempdir().unwrap();
    let path = |name: &str| images.path().join(name);
    for (name, grey) in [("a.png", 60), ("d.png", 120), ("e.png", 180)] {
        Image::filled(128, 128, [grey; 3]).save_png(&path(name)).unwrap();
    }
    std::fs::write(path("b.png"), "no image").unwrap();
    Image::filled(64, 64, [90; 3]).save_png(&path("c.png")).unwrap();
    let rest = format!(
        "frame_rate_hz = 2.0\n{PATIENT}[camera]\nsource = \"folder\"\nfolder = \"{}\"\nframes_per_timestamp = 2\n\
         linger_ms = 10000\n",
        images.path().display()
    );
    let graph = TestGraph::new(images.path(), &shipped_checkpoint(), &rest);
    let finished = graph.launch_to_end(&["--report", "report.json"]);
    finished.assert_success();
    let report = graph.report();
    assert_eq!(report["errors_by_stage"]["camera"], 2, "{}", finished.text);
    assert_eq!(report["frames"], 6, "{}", finished.text);
    assert!(decisions(&finished.text) >= 1, "{}", finished.text);
    assert!(finished.text.contains("b.png") && finished.text.contains("c.png"), "{}", finished.text);
    graph.assert_nothing_left();
}

/// A checkpoint of another scenario than the dataset's is refused before any decision; the error names the key that
/// differs and both values.
#[test]
fn a_checkpoint_of_another_scenario() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = folder.path().join("other");
    copy_checkpoint(&checkpoint, |manifest| manifest["scenario"]["name"] = "roundabout".into());
    let graph = TestGraph::new(&scenario_set(), &checkpoint, PATIENT);
    let finished = graph.launch_to_end(&[]);
    finished.assert_one_error(&["another scenario", "scenario.name", "roundabout", "approaching-intersection"]);
    assert_eq!(decisions(&finished.text), 0);
    graph.assert_nothing_left();
}

/// Weights that are cut off, or of another shape than the manifest's, are refused with the file's name.
#[test]
fn a_checkpoint_with_damaged_weights() {
    let folder = tempfile::tempdir().unwrap();
    let set = scenario_set();
    let cut = folder.path().join("cut");
    copy_checkpoint(&cut, |_| ());
    let field = cut.join("field.safetensors");
    let bytes = std::fs::read(&field).unwrap();
    std::fs::write(&field, &bytes[..bytes.len() / 2]).unwrap();
    let graph = TestGraph::new(&set, &cut, PATIENT);
    graph.launch_to_end(&[]).assert_one_error(&["did not start", "cut"]);
    graph.assert_nothing_left();

    let reshaped = folder.path().join("reshaped");
    copy_checkpoint(&reshaped, |manifest| {
        let hidden = manifest["encoder"]["hidden"].as_i64().unwrap();
        manifest["encoder"]["hidden"] = (hidden + 1).into();
    });
    let graph = TestGraph::new(&set, &reshaped, PATIENT);
    graph.launch_to_end(&[]).assert_one_error(&["did not start", "reshaped"]);
    graph.assert_nothing_left();
}
