//! Closed-loop drives with real processes: the results, their repetition, and who sees the truth.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_tests::{Finished, Process, program, project_root, shipped_checkpoint};
use rustix::process::Signal;
use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// Starts a drive in a folder, with a run name of this test.
fn drive(folder: &Path, run: &str, scenario: &str, rest: &[&str]) -> Process {
    let mut command = Command::new(program("carff"));
    let run = format!("{run}-{}", std::process::id());
    command.current_dir(folder).args(["drive", scenario, "--run", &run, "--checkpoint"]).arg(shipped_checkpoint());
    Process::start(command.args(rest))
}

fn crossing() -> String {
    project_root().join("configs/scenarios/approaching-intersection.toml").display().to_string()
}

fn finished(drive: Process, folder: &Path, file: &str) -> (Finished, Value) {
    let finished = drive.end();
    finished.assert_success();
    let text = std::fs::read_to_string(folder.join(file)).unwrap();
    (finished, serde_json::from_str(&text).unwrap())
}

/// In lock-step, every episode is the same in another run next to other load, to the last bit, and does not depend on the
/// episodes before it.
#[test]
fn drives_repeat() {
    let folder = tempfile::tempdir().unwrap();
    let words = |first, episodes, file| ["--first", first, "--episodes", episodes, "--seed", "3", "--json", file];
    let both = drive(folder.path(), "both", &crossing(), &words("6", "2", "both.json"));
    let second = drive(folder.path(), "second", &crossing(), &words("7", "1", "second.json"));
    let (_, both) = finished(both, folder.path(), "both.json");
    let (_, second) = finished(second, folder.path(), "second.json");
    assert_eq!(both["drives"].as_array().unwrap().len(), 2);
    assert_eq!(both["drives"][1], second["drives"][0]);
    assert_eq!((&both["episodes"], &both["missed_frames"], &both["rule"]), (&2.into(), &0.into(), &"look".into()));
    let ends = ["arrived", "collisions", "stuck"].map(|key| both[key].as_u64().unwrap());
    assert_eq!(ends.iter().sum::<u64>(), 2);
    // The grids of every frame are compared with the truth, at both steps.
    for of in [&both, &second] {
        for step in ["1", "2"] {
            let found = &of["occupancy"][step];
            assert_eq!(found["grids"], of["frames"], "{found:#}");
            let error = found["reliability"]["expected_calibration_error"].as_f64().unwrap();
            assert!((0.0..=1.0).contains(&error) && found["reliability"]["trials"].as_u64() > Some(0), "{found:#}");
        }
    }
}

/// A recording of a closed-loop drive is decided again as it was, bit for bit: it has the ego's motion, on which the
/// approach rests.
#[test]
fn a_drive_is_decided_again_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let run = format!("again-{}", std::process::id());
    let carff = |words: &[&str]| {
        let mut command = Command::new(program("carff"));
        Process::start(command.current_dir(folder.path()).args(words).args(["--run", &run]))
    };
    let mut driving = drive(folder.path(), "again", &crossing(), &["--episodes", "2", "--seed", "3"]);
    driving.wait_for("the stages", |text| text.contains("[renderer] INFO ready"));
    carff(&["record", "-o", "run.mcap"]).end().assert_success();
    driving.end().assert_success();
    let again = carff(&["replay", "run.mcap", "--verify"]).end();
    again.assert_success();
    assert!(again.text.contains("all equal, bit for bit"), "{}", again.text);
}

/// An ego that never stops is as fast as its speed limit; one that never drives on is stuck and is not hit; the planner
/// that knows the truth does not collide in the same episodes.
#[test]
fn rules_move_the_ego() {
    let folder = tempfile::tempdir().unwrap();
    let drive_by = |rule: &str, episodes: &str| {
        let words = ["--episodes", episodes, "--seed", "3", "--rule", rule, "--json", "drive.json"];
        finished(drive(folder.path(), rule, &crossing(), &words), folder.path(), "drive.json").1
    };
    let advance = drive_by("always-advance", "6");
    assert_eq!((&advance["stuck"], &advance["halted_s"]["mean"]), (&0.into(), &0.0.into()));
    let fast_s = advance["time_to_goal_s"]["p50"].as_f64().unwrap();
    assert!((18.4 / 5.0 - 0.1..18.4 / 5.0 + 0.1).contains(&fast_s), "{fast_s}");
    let oracle = drive_by("oracle", "6");
    assert_eq!((&oracle["collisions"], &oracle["arrived"]), (&0.into(), &6.into()));
    let halt = drive_by("always-halt", "1");
    assert_eq!((&halt["stuck"], &halt["collisions"]), (&1.into(), &0.into()));
}

/// The ego merges into the others' lane on the route of this name, ahead of others or after them, and meets nobody. A
/// route that the scenario does not have is one error with the names of those that it has.
#[test]
fn routes_are_chosen_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let words = ["--route", "merge", "--episodes", "3", "--seed", "3", "--actors", "2", "--json", "merge.json"];
    let merge = finished(drive(folder.path(), "merge", &crossing(), &words), folder.path(), "merge.json").1;
    assert_eq!((&merge["route"], &merge["collisions"], &merge["arrived"]), (&"merge".into(), &0.into(), &3.into()));
    let unknown = drive(folder.path(), "unknown", &crossing(), &["--route", "mergge"]).end();
    unknown.assert_one_error(&["no `closed_loop` named `mergge`", "`cross`, `merge`", "did you mean"]);
}

/// Only observers see the truth: while the graph drives, no process subscribes to it, and the vehicle's motion is read by
/// the stages that need it.
#[test]
fn no_stage_sees_the_truth() {
    let folder = tempfile::tempdir().unwrap();
    let run = format!("blind-{}", std::process::id());
    let world = drive(folder.path(), "blind", &crossing(), &["--episodes", "1000", "--rule", "look", "--real-time"]);
    let topics = || {
        let words = ["probe", "list", "--run", &run, "--json", "--seconds", "2"];
        let output = Command::new(program("carff")).current_dir(folder.path()).args(words).output().unwrap();
        serde_json::from_slice::<Value>(&output.stdout).ok()
    };
    let names = |topics: &Value, topic: &str, of: &str| -> Vec<String> {
        let found = topics.as_array().unwrap().iter().find(|t| t["topic"] == topic);
        let list = found.and_then(|t| t[of].as_array()).cloned().unwrap_or_default();
        list.iter().filter_map(|name| name.as_str().map(str::to_owned)).collect()
    };
    let mut seen = Value::Null;
    assert!(
        carff_tests::eventually(|| {
            seen = topics().unwrap_or_default();
            seen.is_array() && !names(&seen, "world/truth", "publishers").is_empty()
        }),
        "{}",
        world.text()
    );
    assert_eq!(names(&seen, "world/truth", "publishers"), ["world"]);
    let observers = names(&seen, "world/truth", "subscribers");
    assert!(!observers.iter().any(|name| carff_messages::Stage::from_name(name).is_some()), "{observers:?}");
    let readers = names(&seen, "ego/motion", "subscribers");
    assert!(["controller", "prober"].iter().all(|stage| readers.iter().any(|name| name == stage)), "{readers:?}");
    world.signal(Signal::INT);
    let finished = world.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    assert!(finished.text.contains("episodes "), "{}", finished.text);
}

/// A scenario that cannot be driven through, and a checkpoint of another scenario, are one error each.
#[test]
fn what_cannot_be_driven_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let other = project_root().join("configs/scenarios/toy.toml").display().to_string();
    drive(folder.path(), "toy", &other, &[]).end().assert_one_error(&["toy.toml", "closed_loop"]);
    let text = std::fs::read_to_string(crossing()).unwrap().replace("branches = [\"actor\"", "branches = [\"lorry\"");
    let text = text.replace("[\"actor\", \"no-actor\"]", "[\"lorry\", \"no-actor\"]");
    let text = text.replace("hazard_branches = [\"actor\"]", "hazard_branches = [\"lorry\"]");
    let text = text.replace("branches = [\"actor\"]", "branches = [\"lorry\"]");
    std::fs::write(folder.path().join("renamed.toml"), text).unwrap();
    drive(folder.path(), "renamed", "renamed.toml", &[]).end().assert_one_error(&["checkpoint"]);
    drive(folder.path(), "none", &crossing(), &["--json", "."]).end().assert_one_error(&["directory"]);
}
