//! Probes, recordings and replays on whole graphs, as a user attaches them from another terminal.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_observe::{AnyReceiver, TopicId, attach};
use carff_tests::{Finished, Process, TestGraph, eventually, program, scenario_set, shipped_checkpoint};
use carff_transport::OpenError;
use rustix::process::Signal;
use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// Settings under which the pace of the machine changes no decision, and drives go on until somebody stops them.
const PATIENT: &str = "[camera]\nrepeat = true\n[controller]\nrate_hz = 4.0\ndeadline_ms = 60000\n[launcher]\n\
                       start_timeout_ms = 600000\nstop_timeout_ms = 30000\n";

fn running() -> (TestGraph, Process) {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT);
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| text.contains("hazard "));
    (graph, launcher)
}

fn carff(graph: &TestGraph, words: &[&str], rest: &[&str]) -> Process {
    let mut command = Command::new(program("carff"));
    command.current_dir(graph.file().parent().unwrap()).args(words).args(["--run", graph.run().name()]).args(rest);
    Process::start(&mut command)
}

#[track_caller]
fn probe(graph: &TestGraph, words: &[&str], rest: &[&str]) -> String {
    let words: Vec<&str> = std::iter::once("probe").chain(words.iter().copied()).collect();
    let finished = carff(graph, &words, rest).end();
    finished.assert_success();
    finished.text
}

fn stop(graph: &TestGraph, launcher: Process) {
    launcher.signal(Signal::INT);
    let finished = launcher.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    graph.assert_nothing_left();
}

/// Every probe shows what runs, without a config; the graph's decisions go on, and nothing is left at the end.
#[test]
fn probes_show_what_runs() {
    let (graph, launcher) = running();

    let topics: Value = serde_json::from_str(&probe(&graph, &["list"], &["--json", "--seconds", "2"])).unwrap();
    let topic = |name: &str| topics.as_array().unwrap().iter().find(|t| t["topic"] == name).unwrap().clone();
    assert_eq!(topic("encoder/posterior")["publishers"], serde_json::json!(["encoder"]));
    assert_eq!(topic("prober/belief")["type"], "carff.Belief.v1");
    let listeners = topic("prober/belief")["subscribers"].to_string();
    assert!(listeners.contains("controller") && listeners.contains("forecaster"), "{listeners}");
    assert!(topic("controller/action")["rate_hz"].as_f64().unwrap() > 0.0, "{topics:#}");
    let drawn = probe(&graph, &["graph"], &["--format", "mermaid"]);
    assert!(drawn.contains("p_prober --> t_prober_belief"), "{drawn}");

    let text = probe(&graph, &["echo", "belief"], &["--json", "--count", "3"]);
    let beliefs: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(beliefs.len(), 3);
    assert!(beliefs.iter().all(|b| b["header"]["run_id"].as_str().is_some_and(|id| id.len() == 16)), "{text}");
    let rate = probe(&graph, &["hz", "camera/frame"], &["--seconds", "3"]);
    assert!(rate.contains(" Hz ") && rate.contains("between messages, ms"), "{rate}");
    let bandwidth = probe(&graph, &["bw", "frame"], &["--seconds", "3"]);
    assert!(bandwidth.contains("size, bytes"), "{bandwidth}");
    let delay = probe(&graph, &["delay", "action"], &["--seconds", "3"]);
    assert!(delay.contains("age on arrival, ms"), "{delay}");
    probe(&graph, &["image", "camera/frame"], &["-o", "pictures", "--count", "2"]);
    let pictures: Vec<_> = std::fs::read_dir(graph.path("pictures")).unwrap().map(|e| e.unwrap().path()).collect();
    assert_eq!(pictures.len(), 2);
    assert!(carff_dataset::Image::load_png(&pictures[0]).is_ok());
    let belief = probe(&graph, &["belief"], &["--count", "1"]);
    assert!(belief.contains("step 1 of 2") && belief.contains("unknown"), "{belief}");
    let trace = probe(&graph, &["trace", "next"], &["--perfetto", "trace.json"]);
    let stages = ["camera", "encoder", "forecaster", "prober", "controller"];
    assert!(stages.iter().all(|stage| trace.lines().any(|line| line.starts_with(stage))), "{trace}");
    let events: Value = serde_json::from_str(&std::fs::read_to_string(graph.path("trace.json")).unwrap()).unwrap();
    assert!(events["traceEvents"].as_array().is_some_and(|e| e.iter().any(|e| e["cat"] == "encoder")), "{events}");
    let top = probe(&graph, &["top", "--once"], &[]);
    assert!(stages.iter().all(|stage| top.contains(stage)) && top.contains(graph.run().name()), "{top}");
    let status = carff(&graph, &["metrics", "--once"], &[]).end();
    status.assert_success();
    let status: Value = serde_json::from_str(&status.text).unwrap();
    assert!(status["stages"]["prober"]["messages"].as_u64().is_some_and(|n| n > 0), "{status:#}");

    let unknown = carff(&graph, &["probe", "echo", "beleif"], &[]).end();
    assert!(unknown.text.contains("did you mean `prober/belief`"), "{}", unknown.text);
    stop(&graph, launcher);
}

/// Probes that come, go and are killed leave the graph running and nothing behind; when all slots of a topic are taken,
/// the next probe is told so, and one that goes makes room.
#[test]
fn probes_come_and_go() {
    let (graph, mut launcher) = running();
    for _ in 0..10 {
        let probe = carff(&graph, &["probe", "echo", "frame"], &["--json"]);
        assert!(eventually(|| !probe.text().is_empty()), "{}", launcher.text());
        probe.signal(Signal::KILL);
        assert!(!probe.end().status.success());
    }
    probe(&graph, &["echo", "frame"], &["--count", "1"]);
    let decisions = |text: &str| text.lines().filter(|l| l.contains("hazard ")).count();
    let before = decisions(&launcher.text());
    launcher.wait_for("further decisions", |text| decisions(text) > before);

    let here = attach(Some(graph.run().name()), "crowd").unwrap();
    let mut crowd = Vec::new();
    let full = loop {
        match AnyReceiver::open(&here.node, TopicId::Frame) {
            Ok(receiver) => crowd.push(receiver),
            Err(error) => break error,
        }
        assert!(crowd.len() < 20);
    };
    assert!(matches!(full, OpenError::TooMany { .. }), "{full}");
    let told = carff(&graph, &["probe", "echo", "frame"], &["--count", "1"]).end();
    told.assert_one_error(&["camera/frame", "taken"]);
    crowd.pop();
    probe(&graph, &["echo", "frame"], &["--count", "1"]);
    drop((crowd, here));
    stop(&graph, launcher);
}

fn replay(graph: &TestGraph, words: &[&str]) -> Finished {
    carff(graph, &[&["replay", "run.mcap"], words].concat(), &[]).end()
}

fn frames_in(path: &Path) -> usize {
    std::fs::read_to_string(path).map_or(0, |text| text.lines().count().saturating_sub(1))
}

/// A recording goes through the same graph again with the same beliefs and decisions, bit for bit; through a graph that
/// draws fewer samples it does not, and the first difference is told. What other tools are given can be exported.
#[test]
fn a_recording_is_decided_again_as_it_was() {
    let (graph, launcher) = running();
    let text = std::fs::read_to_string(graph.file()).unwrap();
    carff(&graph, &["record"], &["-o", "run.mcap", "--seconds", "5"]).end().assert_success();
    stop(&graph, launcher);

    let same = replay(&graph, &["--verify"]);
    same.assert_success();
    assert!(same.text.contains("all the same, bit for bit"), "{}", same.text);
    graph.assert_nothing_left();

    std::fs::write(graph.path("other.toml"), text.replacen("[run]\n", "[run]\nsamples = 4\n", 1)).unwrap();
    let other = replay(&graph, &["--verify", "--graph", "other.toml"]);
    assert_eq!(other.status.code(), Some(1), "{}", other.text);
    let told = other.text.contains("first difference: frame ") && other.text.contains("10 entries in the recording, 4");
    assert!(told, "{}", other.text);
    graph.assert_nothing_left();

    // From the middle of the way: beliefs as recorded, decided upon again.
    let only = replay(&graph, &["--only", "belief", "--to", "1.5"]);
    only.assert_success();
    assert!(only.text.contains("hazard ") || only.text.contains("replaying"), "{}", only.text);
    graph.assert_nothing_left();

    let export = ["export", "run.mcap", "--png", "png", "--csv", "csv", "--trace", "t.json"];
    let mut command = Command::new(program("carff"));
    command.current_dir(graph.file().parent().unwrap()).args(export);
    Process::start(&mut command).end().assert_success();
    let frames = frames_in(&graph.path("csv/camera-frame.csv"));
    assert!(frames > 0);
    let pictures = std::fs::read_dir(graph.path("png")).unwrap().flatten();
    assert_eq!(pictures.filter(|e| e.file_name().to_string_lossy().starts_with("frame-")).count(), frames);
}

/// A recorder that is killed leaves what it had written; a second recording of the same name is refused.
#[test]
fn a_killed_recorder_leaves_its_recording() {
    let (graph, launcher) = running();
    let recorder = carff(&graph, &["record"], &["-o", "run.mcap"]);
    let export = || {
        let mut command = Command::new(program("carff"));
        command.current_dir(graph.file().parent().unwrap()).args(["export", "run.mcap", "--csv", "csv"]);
        let finished = Process::start(&mut command).end();
        finished.status.success() && frames_in(&graph.path("csv/controller-action.csv")) > 0
    };
    // Readable while it is written.
    assert!(eventually(export), "{}", recorder.text());
    recorder.signal(Signal::KILL);
    recorder.end();
    assert!(export());
    carff(&graph, &["record"], &["-o", "run.mcap"]).end().assert_one_error(&["run.mcap", "exists"]);
    stop(&graph, launcher);
}
