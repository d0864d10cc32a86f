//! Test of `carff soak` on the shipped graph and checkpoint.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_tests::{Process, program, project_root, scenario_set, shipped_checkpoint};
use serde_json::Value;
use std::process::Command;

/// Number of faults. The test ends with the last one; its time depends on the machine.
const FAULTS: u64 = 12;

/// Runs a schedule of faults. No action may be wrong and nothing may be left over. Returns the result.
fn survived(schedule: &str, seed: &str) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("soak.json");
    let mut command = Command::new(program("carff"));
    command.arg("soak").arg(project_root().join("configs/soak").join(schedule));
    command.args(["--faults", &FAULTS.to_string(), "--minutes", "60", "--seed", seed, "--json"]).arg(&json);
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
    let result = survived("test.toml", "1");
    let not_tried = result["not_tried"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum::<u64>();
    assert_eq!(result["faults_total"].as_u64().unwrap() + not_tried, FAULTS, "{result:#}");
    for key in ["kills", "cycles", "worst_recovery_ms", "decisions_judged"] {
        assert!(result[key].is_number(), "{key}:\n{result:#}");
    }
    assert!(result["faults"].is_object() && result.get("rss_growth_percent_per_hour").is_some(), "{result:#}");
}

/// The contract holds under the faults of cameras: a lost device, stalls, other sizes, corrupt images, clock steps.
#[test]
fn the_graph_survives_its_camera() {
    let result = survived("camera.toml", "2");
    for kind in ["device_loss", "stall", "resolution", "corrupt"] {
        assert!(result["faults"][kind].as_u64() > Some(0), "{kind}: {result:#}");
    }
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
