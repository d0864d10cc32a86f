//! Test of `carff soak` on the shipped graph and checkpoint.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_tests::{Process, program, project_root, scenario_set, shipped_checkpoint};
use serde_json::Value;
use std::process::Command;

/// Number of faults. A test ends with the last one; its time depends on the machine.
const FAULTS: u64 = 12;
/// Kinds of faults of cameras whose occurrence is checked, and the number of faults in which the seed has all of them.
const CAMERA_KINDS: [&str; 13] = [
    "device_loss",
    "stall",
    "resolution",
    "corrupt",
    "black",
    "white",
    "frozen",
    "covered",
    "unfocused",
    "underexposed",
    "overexposed",
    "clock_stall",
    "clock_jump",
];
const CAMERA_FAULTS: u64 = 14;
const CAMERA_SEED: u64 = 24_832;

/// Runs a schedule of faults. No action may be wrong and nothing may be left over. Returns the result.
fn survived(schedule: &str, faults: u64, seed: u64) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("soak.json");
    let mut command = Command::new(program("carff"));
    command.arg("soak").arg(project_root().join("configs/soak").join(schedule));
    command
        .args(["--faults", &faults.to_string(), "--minutes", "60", "--seed", &seed.to_string(), "--json"])
        .arg(&json);
    command.arg("--dataset").arg(scenario_set()).arg("--checkpoint").arg(shipped_checkpoint());
    let finished = Process::start(command.current_dir(project_root())).end();
    let evidence = std::fs::read_to_string(folder.path().join("soak.evidence/launcher.log")).unwrap_or_default();
    assert!(finished.status.success(), "{}:\n{}\n{evidence}", finished.status, finished.text);
    let result: Value = serde_json::from_str(&std::fs::read_to_string(&json).unwrap()).unwrap();
    assert_eq!((&result["violations"], &result["leaked_files"]), (&0.into(), &0.into()), "{result:#}");
    result
}

/// The contract holds under a schedule of faults: no wrong action, every recovery, correct counters, nothing left over.
/// Each fault is counted, and the result has every promised key.
#[test]
fn the_graph_survives() {
    let result = survived("test.toml", FAULTS, 1);
    let not_tried = result["not_tried"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum::<u64>();
    assert_eq!(result["faults_total"].as_u64().unwrap() + not_tried, FAULTS, "{result:#}");
    for key in ["kills", "cycles", "worst_recovery_ms", "decisions_judged"] {
        assert!(result[key].is_number(), "{key}:\n{result:#}");
    }
    assert!(result["faults"].is_object() && result.get("rss_growth_percent_per_hour").is_some(), "{result:#}");
}

/// The contract holds under the faults of cameras: a lost device, stalls, other sizes, corrupt images, and each bad
/// condition that the encoder can name. The safe action comes within three checked images, with the condition as its
/// reason, and the graph decides again by itself.
#[test]
fn the_graph_survives_its_camera() {
    let result = survived("camera.toml", CAMERA_FAULTS, CAMERA_SEED);
    for kind in CAMERA_KINDS {
        assert!(result["faults"][kind].as_u64() > Some(0), "{kind}: {result:#}");
    }
    let answers = &result["worst_frames_to_safe_action_by_kind"];
    assert!(CAMERA_KINDS[4..].iter().all(|kind| answers[kind].as_u64() > Some(0)), "{result:#}");
}

/// A wrong soak file causes one error that names the file and the key.
#[test]
fn a_wrong_soak_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("wrong.toml");
    std::fs::write(&file, "graph = \"x.toml\"\n[faults]\nkil = 1\n").unwrap();
    let mut command = Command::new(program("carff"));
    Process::start(command.arg("soak").arg(&file)).end().assert_one_error(&["wrong.toml", "kil"]);
}
