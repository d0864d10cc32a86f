//! Tests of what the surroundings do to a run: cleaners of temporary files, other namespaces, limits, other libraries.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::Stage;
use carff_observe::{LockError, RunLock, RunRecord};
use carff_tests::{
    PATIENT_AND_ENDLESS, Process, TestGraph, eventually, program, scenario_set, shipped_checkpoint, skipped,
};
use rustix::process::{Pid, Signal, kill_process};
use std::path::Path;
use std::process::{Command, Stdio};

fn running() -> (TestGraph, Process) {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("decision", |text| text.contains("hazard "));
    (graph, launcher)
}

fn carff(graph: &TestGraph, words: &[&str]) -> Process {
    let mut command = Command::new(program("carff"));
    Process::start(command.args(words).args(["--run", graph.run().name()]))
}

/// A cleaner may remove the files of a run, or some of them: the launcher and a probe that has joined report it,
/// `doctor` finds it and does not advise to remove the living run's memory, a second launch is refused, and a stage that
/// dies ends the run with the cause.
#[test]
fn a_cleaner_that_removes_the_files() {
    a_cleaner_removes(|folder, record| {
        std::fs::remove_dir_all(folder).unwrap();
        std::fs::remove_file(record).unwrap();
    });
}

/// As above, when only the record is old enough.
#[test]
fn a_cleaner_that_removes_the_record() {
    a_cleaner_removes(|_, record| std::fs::remove_file(record).unwrap());
}

/// As above, when the folders of the run remain.
#[test]
fn a_cleaner_that_leaves_folders() {
    a_cleaner_removes(|folder, _| remove_files(folder));
}

/// Removes all files of a folder, not its folders.
fn remove_files(folder: &Path) {
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        if entry.path().is_dir() {
            remove_files(&entry.path());
        } else {
            std::fs::remove_file(entry.path()).unwrap();
        }
    }
}

fn a_cleaner_removes(remove: impl Fn(&Path, &Path)) {
    let (graph, mut launcher) = running();
    let mut probe = carff(&graph, &["probe", "echo", "action"]);
    probe.wait_for("an action", |text| !text.is_empty());
    let record = RunRecord::path(graph.run().dir(), graph.run().name());
    remove(&graph.run().folder(), &record);

    launcher.wait_for("the loss", |text| text.contains("are gone") && text.contains("tmpfiles.d"));
    let seen = probe.end();
    assert_eq!(seen.status.code(), Some(1), "{}", seen.text);
    assert!(seen.text.contains("are gone although it runs"), "{}", seen.text);
    let doctor = Process::start(Command::new(program("carff")).arg("doctor")).end();
    assert_eq!(doctor.status.code(), Some(1), "{}", doctor.text);
    assert!(doctor.text.contains("lost folder") && !doctor.text.contains("orphans"), "{}", doctor.text);
    assert!(!doctor.text.contains(&graph.run().shared_memory_prefix()), "{}", doctor.text);
    let second = graph.launch_to_end(&[]);
    assert_eq!(second.status.code(), Some(1), "{}", second.text);
    let refused = second.text.contains("are still alive: stop them") || second.text.contains("is already running");
    assert!(refused, "{}", second.text);

    let encoder = graph.stage_pid(Stage::Encoder).unwrap();
    kill_process(Pid::from_raw(encoder as i32).unwrap(), Signal::KILL).unwrap();
    let finished = launcher.end();
    assert_eq!(finished.status.code(), Some(1), "{}", finished.text);
    assert!(finished.text.contains("error: stage `encoder` is lost: killed by signal 9"), "{}", finished.text);
    let _ = std::fs::remove_file(record);
    graph.assert_nothing_left();
}

/// A record counts by its lock: one without a lock is stale even if a process of its id lives, as after the restart of
/// a container; a run in another namespace of processes is a run, and `doctor` calls none of its processes orphans.
#[test]
fn records_count_by_their_lock() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let path = RunRecord::path(graph.run().dir(), graph.run().name());
    let record = RunRecord {
        pid: 1,
        run_id: 1,
        graph: "g".into(),
        dataset: "d".into(),
        checkpoint: "c".into(),
        started_unix_s: 0,
    };
    let lock = RunLock::take(graph.run().dir(), graph.run().name(), &record, "--run").unwrap();
    drop(lock);
    std::fs::write(&path, record.to_bytes().unwrap()).unwrap();
    carff(&graph, &["probe", "list"]).end().assert_one_error(&[graph.run().name()]);

    // Inside its own namespace of processes the launcher has another id than here.
    let inner = graph.launch(&graph.file(), &[]);
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-current-user", "--pid", "--fork", "--kill-child", "--mount-proc"]);
    command.arg(inner.get_program()).args(inner.get_args()).current_dir(inner.get_current_dir().unwrap());
    if !Command::new("unshare")
        .args(["--user", "--map-current-user", "--pid", "--fork", "--mount-proc", "true"])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|s| s.success())
    {
        eprintln!("this system does not let users unshare processes: not tested here");
        std::fs::remove_file(path).unwrap();
        return;
    }
    let mut launcher = Process::start(&mut command);
    launcher.wait_for("decision", |text| text.contains("hazard "));
    let doctor = Process::start(Command::new(program("carff")).arg("doctor")).end();
    let line = doctor.text.lines().find(|line| line.contains(graph.run().name())).unwrap();
    assert!(line.contains("runs: launcher"), "{}", doctor.text);
    assert!(matches!(
        RunLock::take(graph.run().dir(), graph.run().name(), &record, "--run"),
        Err(LockError::Held { .. })
    ));
    drop(launcher);
    assert!(eventually(|| graph.run().mapping_processes().is_empty()));
    let _ = std::fs::remove_file(path);
}

/// A folder that cannot be written is passed over, and found by `doctor` if none is left.
#[test]
fn the_folder_of_runs_is_chosen() {
    let dir = tempfile::Builder::new().prefix("r").tempdir_in("/tmp").unwrap();
    let examine = |key: &str, value: &str| {
        let mut command = Command::new(program("carff"));
        command.arg("doctor").env_remove("XDG_RUNTIME_DIR").env_remove("RUNTIME_DIRECTORY").env_remove("TMPDIR");
        Process::start(command.env(key, value)).end().text
    };
    let path = dir.path().to_str().unwrap();
    for key in ["XDG_RUNTIME_DIR", "TMPDIR", "RUNTIME_DIRECTORY"] {
        assert!(examine(key, path).contains(path), "{key}: {}", examine(key, path));
    }
    assert!(
        !examine("TMPDIR", &"/var/tmp/long".repeat(9)).contains("/var/tmp/long"),
        "sockets would have too long a path"
    );

    // Inside, switch back to this user: the folder is named after the user.
    let uid = rustix::process::getuid().as_raw();
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--mount", "sh", "-c"]).arg(format!(
        "mount --bind /tmp /tmp && mount -o remount,ro,bind /tmp && echo mounted && exec unshare --user --map-user={uid} \"$0\" doctor"
    ));
    command.arg(program("carff")).env_remove("XDG_RUNTIME_DIR").env_remove("RUNTIME_DIRECTORY").env_remove("TMPDIR");
    let finished = Process::start(&mut command).end();
    if !finished.text.contains("mounted") {
        skipped("this system does not let users mount");
    } else if !Path::new("/run/carff").exists() {
        assert_eq!(finished.status.code(), Some(1), "{}", finished.text);
        assert!(finished.text.contains(&format!("/tmp/carff-{uid} cannot be written")), "{}", finished.text);
    }
}

/// A low limit of open files is raised or named.
#[test]
fn few_open_files() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), PATIENT_AND_ENDLESS);
    let launch = graph.launch(&graph.file(), &["--frames", "3"]);
    let limited = |limit: &str| {
        let mut command = Command::new("bash");
        command.args(["-c", &format!("ulimit {limit} && exec \"$0\" \"$@\"")]);
        command.arg(launch.get_program()).args(launch.get_args()).current_dir(launch.get_current_dir().unwrap());
        Process::start(&mut command).end()
    };
    limited("-n 64").assert_one_error(&["may open 64 files", "ulimit -n"]);
    limited("-Sn 64").assert_success();
    graph.assert_nothing_left();
}

/// A foreign libtorch in `LD_LIBRARY_PATH` is named, with the remedy, by commands that compute with it. Others start.
#[test]
fn a_foreign_libtorch_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("a.c");
    std::fs::write(&source, "int x;").unwrap();
    for name in ["libtorch_cpu", "libc10"] {
        let library = folder.path().join(format!("{name}.so"));
        let soname = format!("-Wl,-soname,{name}.so");
        let built = Command::new("cc").args(["-shared", "-fPIC", &soname, "-o"]).arg(library).arg(&source).status();
        assert!(built.unwrap().success());
    }
    let start = |args: &[&str]| {
        let mut command = Command::new(program("carff"));
        Process::start(command.args(args).env("LD_LIBRARY_PATH", folder.path())).end()
    };
    start(&["--help"]).assert_success();
    for args in [&["eval", "x", "--out", "y"][..], &["train", "x.toml"], &["bench", "encoder"]] {
        let finished = start(args);
        let library = folder.path().join("libtorch_cpu.so");
        finished.assert_one_error(&[library.to_str().unwrap(), "take its folder out of LD_LIBRARY_PATH"]);
    }
}
