//! Tests of the encoder stage without a usable ONNX Runtime.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_transport::{Run, remove_run_leftovers};
use std::path::Path;
use std::process::Command;

/// Without the library, with a file that is none, and with another library, the stage ends with one sentence that names
/// the file and the remedy.
#[test]
fn a_missing_or_wrong_library_is_one_error() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("text.so");
    std::fs::write(&text, "not a library").unwrap();
    let graph = root.join("configs/graphs/approaching-intersection.toml");
    let name = format!("no-library-{}", std::process::id());
    let run = Run::new(&name, 1).unwrap();
    for library in [Path::new("/nowhere/libonnxruntime.so"), &text, Path::new("libm.so.6")] {
        let mut stage = Command::new(env!("CARGO_BIN_EXE_carff-encoder"));
        stage.env("ORT_DYLIB_PATH", library).arg("--graph").arg(&graph).args(["--run", &name, "--run-id", "1"]);
        let output = stage.output().unwrap();
        remove_run_leftovers(&run).unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        let last = error.lines().last().unwrap();
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(last.starts_with("ERROR ONNX Runtime: ") && last.contains(&*library.to_string_lossy()), "{error}");
        assert!(last.contains("make onnxruntime") && last.contains("stages.encoder.backend = \"tch\""), "{error}");
    }
}
