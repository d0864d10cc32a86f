//! Tests of the Python package next to the shipped programs. They need a Python with iceoryx2 and `NumPy`.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::{Message, Stage};
use carff_observe::{RunLock, RunRecord, attach};
use carff_tests::{
    PATIENT, PATIENT_AND_ENDLESS, Process, TestGraph, decisions, eventually, project_root, scenario_set,
    shipped_checkpoint, skipped,
};
use carff_transport::{Node, runtime_dir, topics};
use rustix::process::Signal;
use speed_gate::{FREE_M_S, SPEED_LIMIT};
use std::process::Command;

/// Returns a command that runs a program below `python/`; none if this machine lacks what it needs.
fn python(program: &str) -> Option<Command> {
    let interpreter = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let probe = Command::new(&interpreter).args(["-c", "import iceoryx2, numpy"]).output();
    if !probe.is_ok_and(|output| output.status.success()) {
        skipped(&format!("`{interpreter}` lacks iceoryx2 or NumPy: {interpreter} -m pip install ./python"));
        return None;
    }
    let folder = project_root().join("python");
    let mut command = Command::new(interpreter);
    command.arg(folder.join(program)).env("PYTHONPATH", folder).env("PYTHONDONTWRITEBYTECODE", "1");
    Some(command)
}

/// Python reads every topic of a running graph, and is refused with another layout. A stage in Python publishes
/// messages that are valid in Rust, and ends with the graph.
#[test]
fn python_reads_a_graph_and_adds_a_stage() {
    let Some(mut check) = python("tests/attached.py") else { return };
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 1);
    let checked = Process::start(check.arg(graph.run().name())).end();
    checked.assert_success();
    assert!(checked.text.contains("ok"), "{}", checked.text);

    let mut stage = python("examples/stage.py").unwrap();
    let mut stage = Process::start(stage.args(["--run", graph.run().name()]));
    stage.wait_for("a report that it has joined", |text| text.contains("joined run"));
    {
        let seen = attach(Some(graph.run().name()), "test").unwrap();
        let mut limits = seen.node.receiver(&SPEED_LIMIT).unwrap();
        let mut found = Vec::new();
        let enough = eventually(|| {
            while let Some(limit) = limits.next().unwrap() {
                found.push(*limit);
            }
            found.len() >= 10
        });
        assert!(enough, "{}\n{}", stage.text(), launcher.text());
        assert_eq!(seen.node.counters().invalid(), 0);
        assert!(found.iter().all(|l| l.validate().is_ok() && (0.0..=FREE_M_S).contains(&l.limit_m_s)), "{found:?}");
        assert!(found.windows(2).all(|pair| pair[0].header.sequence + 1 == pair[1].header.sequence), "{found:?}");
    }
    launcher.signal(Signal::INT);
    launcher.end();
    let ended = stage.end();
    ended.assert_success();
    assert!(ended.text.contains("left run"), "{}", ended.text);
    graph.assert_nothing_left();
}

/// The frames of a camera in Python arrive unchanged, and the encoder computes posteriors from them.
#[test]
fn a_camera_in_python_is_encoded() {
    const FRAMES: usize = 12;
    const SIDE: usize = 128;
    let Some(mut camera) = python("examples/camera.py") else { return };
    // The images are of one colour, and not usable for a checked camera.
    let rest = format!("[checks]\ncamera = false\n{PATIENT}");
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &rest);
    let run = graph.run();
    let file = || graph.file().display().to_string();
    let record = RunRecord {
        pid: std::process::id(),
        run_id: run.id(),
        graph: file(),
        dataset: file(),
        checkpoint: file(),
        started_unix_s: 0,
    };
    let lock = RunLock::take(&runtime_dir(), run.name(), &record, "--run").unwrap();
    {
        let node = Node::open(run, "test").unwrap();
        let mut frames = node.receiver(&topics::FRAME).unwrap();
        let mut posteriors = node.receiver(&topics::POSTERIOR).unwrap();
        let mut health = node.receiver(topics::health(Stage::Encoder)).unwrap();
        let encoder = graph.stage(Stage::Encoder);
        assert!(eventually(|| health.next().unwrap().is_some_and(|h| h.state == 1)), "{}", encoder.text());
        let args = ["--run", run.name(), "--rate", "4", "--frames"];
        let camera = Process::start(camera.args(args).arg(FRAMES.to_string()));
        let (mut seen, mut encoded) = (0, Vec::new());
        let all = eventually(|| {
            while let Some(frame) = frames.next().unwrap() {
                assert_eq!((frame.header.frame_id, frame.image().dim()), (seen, (SIDE, SIDE, 3)));
                assert_eq!(frame.image()[[5, 9, 0]], 5);
                assert_eq!(frame.image()[[5, 9, 1]], 9);
                assert_eq!(u64::from(frame.image()[[5, 9, 2]]), 16 * seen % 256);
                seen += 1;
            }
            while let Some(posterior) = posteriors.next().unwrap() {
                encoded.push(posterior.header.frame_id);
            }
            seen == FRAMES as u64 && encoded.last() == Some(&(seen - 1))
        });
        assert!(all, "{seen} frames, {encoded:?}\n{}\n{}", camera.text(), encoder.text());
        assert_eq!(node.counters().invalid(), 0);
        camera.end().assert_success();
        encoder.signal(Signal::TERM);
        encoder.end();
    }
    drop(lock);
}
