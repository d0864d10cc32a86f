//! Tests of `carff doctor` and of exit codes, as scripts use them.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

fn carff(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_carff-launch")).args(args).output().unwrap()
}

/// The JSON is complete, its counts match its findings, and the exit code is 1 exactly if a finding is an error.
#[test]
fn findings_as_json() {
    let folder = tempfile::tempdir().unwrap();
    let wrong = folder.path().join("wrong.toml");
    std::fs::write(&wrong, "[run]\nname = \"x\"\nhorizn = 2\n").unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/graphs/approaching-intersection.toml");
    for (graph, expected) in [(&wrong, "did you mean `horizon`?"), (&shipped, "approaching-intersection")] {
        let output = carff(&["doctor", "--json", graph.to_str().unwrap()]);
        let json: Value = serde_json::from_slice(&output.stdout).unwrap();
        let findings = json["findings"].as_array().unwrap();
        let count = |level: &str| findings.iter().filter(|f| f["level"] == level).count() as u64;
        assert_eq!(json["errors"], count("error"), "{json:#}");
        assert_eq!(json["warnings"], count("warning"), "{json:#}");
        assert_eq!(output.status.code(), Some(i32::from(count("error") > 0)), "{json:#}");
        let origin = &json["origin"];
        assert!(["version", "commit", "host", "started"].iter().all(|key| origin[key].is_string()), "{json:#}");
        assert_eq!(origin["checkpoint_sha256"].as_str().map(str::len), (graph == &shipped).then_some(64), "{json:#}");
        let about_graph = |f: &&Value| f["area"] == "graph" && f["found"].as_str().unwrap().contains(expected);
        assert!(findings.iter().any(|f| about_graph(&f)), "{json:#}");
    }
}

/// Without a terminal there are no colours; wrong arguments exit with 2, errors with 1, help with 0.
#[test]
fn exit_codes() {
    let plain = carff(&["doctor"]);
    assert!(!plain.stdout.contains(&0x1b) && plain.stdout.starts_with(b"Machine"), "{plain:?}");
    assert_eq!(carff(&["doctr"]).status.code(), Some(2));
    assert!(String::from_utf8_lossy(&carff(&["doctr"]).stderr).contains("doctor"));
    assert_eq!(carff(&["launch", "no-such-file.toml"]).status.code(), Some(1));
    let help = carff(&["--help"]);
    assert_eq!(help.status.code(), Some(0));
    assert!(String::from_utf8_lossy(&help.stdout).contains("Exit codes:"));
}

/// A build without `carff-lab` accepts its commands' arguments, and names the missing program and the remedy. The
/// encoder is exported without it.
#[test]
fn a_missing_lab_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("carff-launch");
    std::fs::copy(env!("CARGO_BIN_EXE_carff-launch"), &program).unwrap();
    let run = |args: &[&str]| Command::new(&program).args(args).output().unwrap();
    for args in [&["train", "x.toml"][..], &["eval", "x", "--out", "y"], &["schema", "training"]] {
        let output = run(args);
        let error = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), error.lines().count()), (Some(1), 1), "{error}");
        assert!(error.contains("carff-lab") && error.contains("make build"), "{error}");
    }
    assert_eq!(run(&["train", "--no-such-option"]).status.code(), Some(2));
    let checkpoint = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/checkpoints/toy");
    let out = folder.path().join("encoder.onnx");
    let exported = run(&["checkpoint", "onnx", checkpoint.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert!(exported.status.success() && out.is_file(), "{}", String::from_utf8_lossy(&exported.stderr));
}
