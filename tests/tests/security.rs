//! Tests that another user of the machine can neither read the data of a run nor add any.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_tests::{Process, TestGraph, program, scenario_set, shipped_checkpoint};
use carff_transport::runtime_dir;
use rustix::process::Signal;
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A user without files; its number is the same on every Linux system.
const NOBODY: u32 = 65534;

fn all_below(folder: &Path, found: &mut Vec<PathBuf>) {
    found.push(folder.to_owned());
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        // Temporary files may have been removed by now.
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => all_below(&entry.path(), found),
            _ => found.push(entry.path()),
        }
    }
}

/// Returns the files that another user can read or write, as a shell of that user reports them.
fn what_nobody_can(files: &[PathBuf]) -> String {
    let script = "for f in \"$@\"; do head -c 1 \"$f\" > /dev/null 2>&1 && echo \"reads $f\"; \
                  [ -e \"$f\" ] && (: >> \"$f\") 2> /dev/null && echo \"writes $f\"; done; true";
    let mut command = Command::new("sh");
    command.args(["-c", script, "sh"]).args(files).uid(NOBODY).gid(NOBODY).current_dir("/");
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// All files of a running graph, in shared memory and elsewhere, are private to this user by owner and mode. If this
/// test may become another user, that user can open none of them, but can open public files.
#[test]
fn a_run_is_its_users_alone() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), "[camera]\nrepeat = true\n");
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| text.contains("hazard "));

    let mut files = graph.run().shared_memory_files().unwrap();
    assert!(files.len() > 10, "{files:?}");
    all_below(&graph.run().folder(), &mut files);
    files.extend([runtime_dir(), runtime_dir().join(format!("{}.run", graph.run().name()))]);
    let me = rustix::process::getuid().as_raw();
    for file in &files {
        let Ok(found) = std::fs::symlink_metadata(file) else { continue };
        assert_eq!(found.uid(), me, "{}", file.display());
        // Files in a folder that no other user can enter are safe with any mode; shared memory is accessible to all.
        let in_the_open = !file.starts_with(runtime_dir()) || *file == runtime_dir();
        assert!(!in_the_open || matches!(found.mode() & 0o077, 0), "{}: mode {:o}", file.display(), found.mode());
    }
    if rustix::process::getuid().is_root() {
        assert_eq!(what_nobody_can(&files), "");
        let open = tempfile::tempdir().unwrap();
        let for_all = open.path().join("for-all");
        std::fs::write(&for_all, "x").unwrap();
        for (path, mode) in [(open.path(), 0o755), (for_all.as_path(), 0o666)] {
            std::fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(mode)).unwrap();
        }
        let can = what_nobody_can(std::slice::from_ref(&for_all));
        assert!(can.contains("reads") && can.contains("writes"), "{can}");
    }
    launcher.signal(Signal::INT);
    assert_eq!(launcher.end().status.code(), Some(130));
    graph.assert_nothing_left();
}

/// A graph, the tables after it, and `carff doctor` keep no file in the user's home folder: ONNX Runtime reports nothing to
/// its maker.
#[test]
fn nothing_is_kept_in_the_home_folder() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), "");
    let home = tempfile::tempdir().unwrap();
    let at_home = |command: &mut Command| {
        command.env("HOME", home.path()).env_remove("XDG_CACHE_HOME").env_remove("ORT_DISABLE_TELEMETRY");
        Process::start(command).end()
    };
    at_home(&mut graph.launch(&graph.file(), &["--frames", "5"])).assert_success();
    let doctor = at_home(Command::new(program("carff")).args(["doctor", "--json"]));
    assert!(doctor.text.contains("ONNX Runtime"), "{}", doctor.text);
    // A stage that is started by hand; its arguments are the same as before.
    let stage = at_home(Command::new(program("carff-encoder")).args(["--graph", "missing.toml"]));
    assert!(stage.text.contains("missing.toml"), "{}", stage.text);
    let mut kept = Vec::new();
    all_below(home.path(), &mut kept);
    assert_eq!(kept, [home.path()]);
    graph.assert_nothing_left();
}
