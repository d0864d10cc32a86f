//! Test of the commands that wait for a run.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_tests::{PATIENT_AND_ENDLESS, Process, TestGraph, eventually, program, scenario_set, shipped_checkpoint};
use rustix::process::Signal;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::Command;

fn metrics(address: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(b"GET /metrics HTTP/1.1\r\n\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

fn recordings(graph: &TestGraph) -> Vec<PathBuf> {
    let files = std::fs::read_dir(graph.path(".")).unwrap().map(|entry| entry.unwrap().path());
    files.filter(|path| path.extension().is_some_and(|e| e == "mcap")).collect()
}

/// Metrics and recorder start before any run. They join a run, outlive it and join the next one, which they do not
/// hinder. The metrics report if a run is alive, and each run has a recording.
#[test]
fn observers_wait_for_runs() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let waiting = |words: &[&str]| {
        let mut command = Command::new(program("carff"));
        command.current_dir(graph.path(".")).args(words).args(["--wait", "--run", graph.run().name()]);
        Process::start(&mut command)
    };
    let mut exporter = waiting(&["metrics", "--listen", "127.0.0.1:0"]);
    let recorder = waiting(&["record", "belief", "-o", "drive.mcap"]);
    exporter.wait_for("address", |text| text.contains("/status"));
    let address = exporter.text().split(['/', ' ']).nth(2).unwrap().to_owned();
    let up = |value: u8| {
        let line = format!("carff_up{{run=\"{}\"}} {value}", graph.run().name());
        eventually(|| metrics(&address).lines().any(|l| l.starts_with(&line)))
    };
    for run in 1..=2 {
        assert!(up(0), "{}", metrics(&address));
        let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
        launcher.wait_for("decision", |text| text.contains("hazard "));
        assert!(up(1), "{}\n{}", metrics(&address), launcher.text());
        assert!(eventually(|| recordings(&graph).len() == run), "{}", recorder.text());
        launcher.signal(Signal::INT);
        let ended = launcher.end();
        assert_eq!(ended.status.code(), Some(130), "{}", ended.text);
        assert!(eventually(|| recorder.text().matches(" has ended").count() == run), "{}", recorder.text());
    }
    for process in [exporter, recorder] {
        process.signal(Signal::INT);
        let ended = process.end();
        assert_eq!(ended.status.code(), Some(130), "{}", ended.text);
    }
    for file in recordings(&graph) {
        let mut export = Command::new(program("carff"));
        let ended = Process::start(export.arg("export").arg(&file).arg("--csv").arg(graph.path("csv"))).end();
        ended.assert_success();
        assert!(ended.text.contains("prober-belief.csv"), "{}", ended.text);
    }
    graph.assert_nothing_left();
}
