//! Tests of the `carff` command with unusable input: one error with a remedy, exit code 1, nothing left.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_tests::{Process, TestGraph, image_set, program, skipped};
use std::path::Path;
use std::process::Command;

/// A wrong graph file causes an error with file, line, key and the allowed values.
#[test]
fn wrong_graph_files() {
    let graph = TestGraph::new(Path::new("none"), Path::new("none"), "");
    let cases = [
        ("horizn = 2", "wrong.toml:5: `run.horizn`: unknown field `horizn`, expected one of"),
        ("samples = 65", "wrong.toml:5: `run.samples` is 65; allowed: 1 to 64"),
        ("[camera]\nsource = \"webcam\"", "wrong.toml:6: `camera.source`: unknown variant `webcam`, expected"),
        (
            "[camera]\nsource = \"video\"",
            "wrong.toml:6: `camera.source` is \"video\"; allowed: `video` with `camera.file`",
        ),
        ("[controller]\nthreshold = nan", "wrong.toml:6: `controller.threshold` is NaN; allowed: 0 to 1"),
        ("[renderer]\nwidth_px = \"wide\"", "wrong.toml:6: `renderer.width_px`: invalid type"),
        ("seed = ", "wrong.toml:5: "),
    ];
    let head = std::fs::read_to_string(graph.file()).unwrap();
    for (line, wanted) in cases {
        std::fs::write(graph.path("wrong.toml"), format!("{}\n{line}\n", head.trim_end())).unwrap();
        Process::start(&mut graph.launch(&graph.path("wrong.toml"), &[])).end().assert_one_error(&[wanted]);
    }
    Process::start(&mut graph.launch(&graph.path("nowhere.toml"), &[]))
        .end()
        .assert_one_error(&["cannot read the graph file", "nowhere.toml"]);
    graph.assert_nothing_left();
}

/// A missing dataset, or a folder without one, is an error with its name and an alternative.
#[test]
fn missing_data_sets() {
    let graph = TestGraph::new(Path::new("nowhere"), Path::new("none"), "");
    graph.launch_to_end(&[]).assert_one_error(&["nowhere", "is missing", "--dataset"]);
    let empty = graph.path("empty");
    std::fs::create_dir(&empty).unwrap();
    graph.launch_to_end(&["--dataset", empty.to_str().unwrap()]).assert_one_error(&["empty", "contains no dataset"]);
    graph.assert_nothing_left();
}

/// A missing checkpoint ends the launch with the stage's own error, which names the training command.
#[test]
fn missing_checkpoint() {
    let set = tempfile::tempdir().unwrap();
    image_set(set.path());
    let graph = TestGraph::new(set.path(), &set.path().join("untrained"), "");
    graph.launch_to_end(&[]).assert_one_error(&["untrained", "carff train"]);
    graph.assert_nothing_left();
}

/// A checkpoint of another format version is refused with both versions.
#[test]
fn checkpoint_of_another_format() {
    let set = tempfile::tempdir().unwrap();
    image_set(set.path());
    let checkpoint = set.path().join("checkpoint");
    std::fs::create_dir(&checkpoint).unwrap();
    let planning = r#"{"format_version": 1, "split_seed": 1, "hazard_threshold": 0.25}"#;
    std::fs::write(checkpoint.join("planning.json"), planning).unwrap();
    std::fs::write(checkpoint.join("manifest.json"), r#"{"format_version": 99, "weights": "elsewhere"}"#).unwrap();
    let graph = TestGraph::new(set.path(), &checkpoint, "");
    let wanted = ["manifest.json", "`format_version` is 99, this program reads 1", "train the checkpoint again"];
    graph.launch_to_end(&[]).assert_one_error(&wanted);
    graph.assert_nothing_left();
}

/// A missing program of the graph is an error with its name and the build command.
#[test]
fn missing_program() {
    let set = tempfile::tempdir().unwrap();
    image_set(set.path());
    let graph = TestGraph::new(set.path(), &set.path().join("none"), "");
    let folder = set.path().to_str().unwrap().to_owned();
    graph.launch_to_end(&["--stages", &folder]).assert_one_error(&["cannot start", "carff-controller", "cargo build"]);
    graph.assert_nothing_left();
}

/// Errors of wrong datasets name the file, the frame and the key.
#[test]
fn dataset_check_names_the_place() {
    let set = tempfile::tempdir().unwrap();
    image_set(set.path());
    let check = || {
        let mut command = Command::new(program("carff"));
        Process::start(command.args(["dataset", "check"]).arg(set.path())).end()
    };
    check().assert_success();
    let file = set.path().join("transforms.json");
    let whole = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, whole.replacen("\"view_id\":3", "\"view_id\":\"three\"", 1)).unwrap();
    check().assert_one_error(&["transforms.json", "frame 3 (images/b0_t0_v3.png)", "`view_id`"]);
    std::fs::write(&file, &whole).unwrap();
    std::fs::write(set.path().join("images/b1_t0_v7.png"), "no image").unwrap();
    let lists_the_image = || {
        let finished = check();
        finished.assert_one_error(&["1 images or masks cannot be used"]);
        let broken = finished.text.lines().find(|line| line.starts_with("broken: ")).unwrap();
        assert!(broken.contains("b1_t0_v7.png"), "{broken}");
    };
    lists_the_image();
    std::fs::remove_file(set.path().join("images/b1_t0_v7.png")).unwrap();
    lists_the_image();
}

/// Shared memory that is too small, or not writable, is reported before any stage starts.
///
/// Both cases need a private mount; if the system does not let users mount, `carff-transport` still tests the check.
#[test]
fn shared_memory_full_or_not_writable() {
    let private = |mount: &str, rest: &str| {
        let mut command = Command::new("unshare");
        let uid = rustix::process::getuid().as_raw();
        command.args(["--user", "--map-root-user", "--mount", "sh", "-c"]);
        // Inside, switch back to this user: the run's folder is named after the user.
        command.arg(format!("mount -t tmpfs {mount} tmpfs /dev/shm && exec unshare --user --map-user={uid} {rest}"));
        command
    };
    if !Process::start(&mut private("", "true")).end().status.success() {
        skipped("this system does not let users mount");
        return;
    }
    let set = tempfile::tempdir().unwrap();
    image_set(set.path());
    let graph = TestGraph::new(set.path(), &set.path().join("none"), "");
    let launch = graph.launch(&graph.file(), &[]);
    let words = std::iter::once(launch.get_program()).chain(launch.get_args());
    let line = words.map(|w| format!("'{}'", w.to_str().unwrap())).collect::<Vec<_>>().join(" ");
    for (mount, wanted) in
        [("-o size=256k", ["/dev/shm", "bytes free", "--shm-size"]), ("-o ro", ["/dev/shm", "not writable", "mode"])]
    {
        Process::start(private(mount, &line).current_dir(set.path())).end().assert_one_error(&wanted);
    }
    graph.assert_nothing_left();
}

/// If no process reads standard output any more (`| head`), a command ends without a message, as is the convention in
/// shells.
#[test]
fn a_reader_that_has_seen_enough() {
    let set = tempfile::tempdir().unwrap();
    image_set(set.path());
    for args in [&["dataset", "check", set.path().to_str().unwrap()][..], &["schema", "graph"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = Command::new(program("carff")).args(args).stdout(writer).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!((output.status.code(), &*said), (Some(141), ""), "{args:?}");
    }
}
