//! Test of a user's own stage, `examples/speed-gate`, next to the shipped programs.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::Message;
use carff_observe::attach;
use carff_tests::{
    PATIENT_AND_ENDLESS, Process, TestGraph, decisions, eventually, program, scenario_set, shipped_checkpoint,
};
use carff_transport::topics;
use rustix::process::Signal;
use serde_json::Value;
use speed_gate::{FREE_M_S, SPEED_LIMIT, SpeedLimit};
use std::process::Command;

/// Every probe takes the stage's topic, whose message type it does not know, with and without the first part of its
/// name.
fn probes_take_what_list_shows(graph: &TestGraph) {
    let probe = |words: &[&str]| {
        let run = ["--run", graph.run().name()];
        let finished = Process::start(Command::new(program("carff")).arg("probe").args(words).args(run)).end();
        finished.assert_success();
        finished.text
    };
    let list: Value = serde_json::from_str(&probe(&["list", "--json", "--seconds", "2"])).unwrap();
    let own = list.as_array().unwrap().iter().find(|t| t["topic"] == SPEED_LIMIT.name).unwrap();
    assert!(own["type"] == "speed-gate.SpeedLimit.v1" && own["publishers"][0] == "speed-gate", "{own}");
    assert!(own["rate_hz"].as_f64().unwrap() > 0.0, "{own}");
    for (words, shown) in [
        (["hz", SPEED_LIMIT.name, "--count", "4"], "Hz"),
        (["bw", SPEED_LIMIT.name, "--count", "4"], "per second"),
        (["delay", "limit", "--count", "4"], "age on arrival"),
        (["echo", "limit", "--count", "2"], "frame_id"),
    ] {
        let text = probe(&words);
        assert!(text.contains(shown) && !text.contains("dropped"), "{words:?}: {text}");
        assert_eq!(words[0] == "echo", text.contains("does not know `speed-gate.SpeedLimit.v1`"), "{text}");
    }
}

/// The stage joins the shipped graph only by its name and publishes its own valid messages, each about the frame of an
/// action. It leaves on request and the graph continues; another one ends by itself when the graph ends. Nothing is
/// left.
#[test]
fn a_stage_of_its_own_joins_and_leaves() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| decisions(text) >= 1);
    let gate = || {
        let mut gate = Process::start(Command::new(program("speed-gate")).arg(graph.run().name()));
        gate.wait_for("a report that it has joined", |text| text.contains("joined run"));
        gate
    };

    let first = gate();
    {
        let seen = attach(Some(graph.run().name()), "test").unwrap();
        let mut limits = seen.node.receiver(&SPEED_LIMIT).unwrap();
        let mut actions = seen.node.receiver(&topics::ACTION).unwrap();
        let (mut found, mut frames): (Vec<SpeedLimit>, Vec<u64>) = (Vec::new(), Vec::new());
        let enough = eventually(|| {
            while let Some(action) = actions.next().unwrap() {
                frames.push(action.header.frame_id);
            }
            while let Some(limit) = limits.next().unwrap() {
                found.push(*limit);
            }
            found.len() >= 20
        });
        assert!(enough, "{} limits\n{}\n{}", found.len(), first.text(), launcher.text());
        assert_eq!(seen.node.counters().invalid(), 0);
        for limit in &found {
            assert_eq!(limit.validate(), Ok(()));
            assert!((0.0..=FREE_M_S).contains(&limit.limit_m_s), "{limit:?}");
        }
        assert!(found.windows(2).all(|pair| pair[0].header.sequence + 1 == pair[1].header.sequence), "{found:?}");
        let both = found.iter().filter(|l| frames.contains(&l.header.frame_id)).count();
        assert!(both > 0, "no limit is based on the frame of a received action: {found:?}");
    }
    probes_take_what_list_shows(&graph);
    first.signal(Signal::TERM);
    let finished = first.end();
    finished.assert_success();
    assert!(finished.text.contains("left run"), "{}", finished.text);
    let before = decisions(&launcher.text());
    launcher.wait_for("further decisions", |text| decisions(text) >= before + 3);

    let second = gate();
    launcher.signal(Signal::INT);
    let ended = launcher.end();
    assert_eq!(ended.status.code(), Some(130), "{}", ended.text);
    second.end().assert_success();
    graph.assert_nothing_left();
}
