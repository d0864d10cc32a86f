//! Tests of the run's log for other tools, and of commands far from the project's folder or without input.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::Stage;
use carff_tests::{
    PATIENT_AND_ENDLESS, Process, TestGraph, decisions, eventually, program, scenario_set, shipped_checkpoint,
};
use foxglove::Decode as _;
use foxglove::messages::Log;
use foxglove::messages::log::Level;
use rustix::process::{Pid, Signal, kill_process};
use std::process::Command;

fn carff(graph: &TestGraph, words: &[&str]) -> Process {
    Process::start(Command::new(program("carff")).current_dir(graph.path("")).args(words))
}

/// A recording has the lines of stages and launcher as `foxglove.Log`, each with its time, source and level. A replay
/// by single steps without any input is an error.
#[test]
fn a_recording_has_the_log() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let run = graph.run().name();
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 1);
    let recorder = carff(&graph, &["record", "--run", run, "-o", "run.mcap"]);
    assert!(eventually(|| graph.path("run.mcap").exists()), "{}", recorder.text());
    let before = decisions(&launcher.text());
    launcher.wait_for("a decision that is recorded", |text| decisions(text) >= before + 3);
    let renderer = graph.stage_pid(Stage::Renderer).unwrap();
    kill_process(Pid::from_raw(renderer as i32).unwrap(), Signal::KILL).unwrap();
    launcher.wait_for("the renderer again", |text| text.matches("[renderer] INFO ready").count() >= 2);
    let before = decisions(&launcher.text());
    launcher.wait_for("a later decision", |text| decisions(text) >= before + 3);
    launcher.signal(Signal::INT);
    launcher.end();
    recorder.end().assert_success();

    let bytes = std::fs::read(graph.path("run.mcap")).unwrap();
    let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    let log = messages.iter().filter(|message| message.channel.topic == "log");
    let log: Vec<(Log, u64)> = log.map(|m| (Log::decode(&m.data[..]).unwrap(), m.log_time)).collect();
    let line = |source: &str, text: &str| log.iter().find(|(log, _)| log.name == source && log.message.contains(text));
    let (ready, at_ns) = line("renderer", "ready threads=").unwrap_or_else(|| panic!("{log:?}"));
    let (died, died_ns) = line("launcher", "stage renderer died").unwrap_or_else(|| panic!("{log:?}"));
    assert_eq!((ready.level, died.level), (Level::Info.into(), Level::Warning.into()));
    assert!(died_ns < at_ns, "{died:?} {ready:?}");
    let (first, last) = (messages.iter().map(|m| m.log_time).min(), messages.iter().map(|m| m.log_time).max());
    assert!((first.unwrap()..=last.unwrap()).contains(at_ns));

    carff(&graph, &["replay", "run.mcap", "--step"]).end().assert_one_error(&["standard input ended", "--rate"]);
    graph.assert_nothing_left();
}

/// A scenario is found by its name from any folder, and a misspelt one is named.
#[test]
fn scenarios_are_found_by_name_from_any_folder() {
    let folder = tempfile::tempdir().unwrap();
    let render = |name: &str, out: &str| {
        let mut command = Command::new(program("carff"));
        Process::start(command.current_dir(folder.path()).args(["dataset", "render", name, "--out", out])).end()
    };
    render("two-lane-merg", "set").assert_one_error(&[
        "no scenario two-lane-merg",
        "did you mean",
        "two-lane-merge.toml",
    ]);
    // Found: the output is refused, and nothing is rendered.
    std::fs::write(folder.path().join("taken"), "text").unwrap();
    render("two-lane-merge", "taken").assert_one_error(&["two-lane-merge.toml", "taken"]);
}

/// A reader that closes the pipe (`| head`) ends a long output without an error.
#[test]
fn a_closed_pipe_is_no_error() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let log = graph.run().dir().join(format!("{}.log", graph.run().name()));
    // More than a pipe holds.
    std::fs::write(&log, "a line of a log\n".repeat(100_000)).unwrap();
    let script =
        format!("'{}' logs {} | head -n 1; exit ${{PIPESTATUS[0]}}", program("carff").display(), graph.run().name());
    let read = Process::start(Command::new("bash").args(["-c", &script])).end();
    std::fs::remove_file(&log).unwrap();
    assert_eq!((read.status.code(), read.text.trim()), (Some(141), "a line of a log"), "{}", read.text);
}
