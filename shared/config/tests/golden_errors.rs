//! Exact messages for wrong graph files: file, line, key, and the allowed values.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_config::{ConfigError, GraphConfig, RestartPolicy, ViewChoice, is_stream};
use carff_messages::Stage;
use std::path::Path;

const HEAD: &str = "[run]\nname = \"x\"\ndataset = \"d\"\ncheckpoint = \"c\"\n";

fn error(text: &str) -> String {
    GraphConfig::parse(text, Path::new("graph.toml")).unwrap_err().to_string()
}

/// Each wrong file has exactly this message.
#[test]
fn wrong_files_have_golden_messages() {
    let cases = [
        (
            format!("{HEAD}horizn = 2\n"),
            "graph.toml:5: `run.horizn`: unknown field `horizn`, expected one of `name`, `seed`, `dataset`, `scenario`, \
             `checkpoint`, `horizon`, `samples`, `sampling`, `feedback`, `memory`, `frame_rate_hz`, `busy_polling`; did you mean `horizon`?",
        ),
        (
            format!("{HEAD}[camera]\nsource = \"free-drives\"\n"),
            "graph.toml:6: `camera.source` is \"free-drives\"; allowed: `free-drives` with a `run.scenario` to render",
        ),
        (
            format!("{HEAD}[camera]\nsource = \"mcap\"\n"),
            "graph.toml:6: `camera.source` is \"mcap\"; allowed: `mcap` with `camera.file`, the recording",
        ),
        (
            format!("{HEAD}[camera]\nsource = \"rtsp\"\n"),
            "graph.toml:6: `camera.source` is \"rtsp\"; allowed: `rtsp` with `camera.url`, the camera's address",
        ),
        (
            format!("{HEAD}[camera]\nsource = \"external\"\ncalibration = \"c.yaml\"\n"),
            "graph.toml:7: `camera.calibration` is set; allowed: no calibration for `drives` and `free-drives`, which \
             need none, and `external`, whose process rectifies its images itself",
        ),
        (
            format!(
                "{HEAD}[camera]\nsource = \"folder\"\n[camera.calibration]\nwidth_px = 10\nheight_px = 10\n\
                     fl_x_px = 0.0\nfl_y_px = 5.0\ncx_px = 5.0\ncy_px = 5.0\n"
            ),
            "graph.toml:10: `camera.calibration.fl_x_px` is 0; allowed: a focal length is finite and above 0",
        ),
        (
            format!("{HEAD}[camera]\nsource = \"folder\"\n[camera.calibration]\nwidth = 10\n"),
            "graph.toml:8: `camera.calibration.width`: unknown field `width`, expected one of `width_px`, `height_px`, \
             `fl_x_px`, `fl_y_px`, `cx_px`, `cy_px`, `model`, `distortion`; did you mean `width_px`?",
        ),
        (
            format!("{HEAD}[camera]\nworld_from_camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]\n"),
            "graph.toml:6: `camera.world_from_camera` is [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, \
             0.0], [0.0, 0.0, 0.0, 2.0]]; allowed: four rows of four numbers: a rotation and a translation over the \
             row 0 0 0 1",
        ),
        (format!("{HEAD}horizon = 9\n"), "graph.toml:5: `run.horizon` is 9; allowed: 1 to 8"),
        (
            format!("{HEAD}horizon = \"two\"\n"),
            "graph.toml:5: `run.horizon`: invalid type: string \"two\", expected u32",
        ),
        (
            format!("{HEAD}sampling = \"random\"\n"),
            "graph.toml:5: `run.sampling`: unknown variant `random`, expected `stratified` or `independent`",
        ),
        (
            format!("{HEAD}\n[controller]\n\nrule = \"calibrated\"\nthreshold = 1.5\n"),
            "graph.toml:9: `controller.threshold` is 1.5; allowed: 0 to 1",
        ),
        (format!("{HEAD}[camera.noise]\nsigma = nan\n"), "graph.toml:6: `camera.noise.sigma` is NaN; allowed: 0 to 64"),
        (
            format!("{HEAD}[stages.prober]\nrestart = {{ on-failure = {{ backoff_ms = 1, max_restarts = 0 }} }}\n"),
            "graph.toml:6: `stages.prober.restart.on-failure.max_restarts` is 0; allowed: 1 to 1000",
        ),
        (
            format!("{HEAD}[overload]\norder = [\"samples\", \"samples\"]\n"),
            "graph.toml:6: `overload.order` is [Samples, Samples]; allowed: `resolution`, `samples`, `horizon`, each at \
             most once",
        ),
        (
            format!("{HEAD}[stages.prober]\nfifo_priority = 100\n"),
            "graph.toml:6: `stages.prober.fifo_priority` is 100; allowed: 1 to 99",
        ),
        (
            format!("{HEAD}[stages.forecaster]\nbackend = \"tch\"\n"),
            "graph.toml:6: `stages.forecaster.backend` is tch; allowed: only `stages.encoder` has a backend",
        ),
        (
            format!("{HEAD}[stages.encoder]\nbackend = \"tensorrt\"\n"),
            "graph.toml:6: `stages.encoder.backend`: unknown variant `tensorrt`, expected `onnx` or `tch`",
        ),
        (
            "[run]\nname = \"two words\"\ndataset = \"d\"\ncheckpoint = \"c\"\n".to_owned(),
            "graph.toml:2: `run.name` is \"two words\"; allowed: 1 to 24 characters out of a-z, A-Z, 0-9, `-` and `_`",
        ),
        ("[run]\nname = \"x\"\ncheckpoint = \"c\"\n".to_owned(), "graph.toml:1: `run`: missing field `dataset`"),
        (
            format!("{HEAD}[cameras]\n"),
            "graph.toml:5: `cameras`: unknown field `cameras`, expected one of `run`, `stages`, `camera`, `checks`, `renderer`, \
             `controller`, `launcher`, `overload`; did you mean `camera`?",
        ),
        (
            format!("{HEAD}[renderer]\nviews = []\n"),
            "graph.toml:6: `renderer.views` is []; allowed: at least one entry",
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(error(&text), expected, "for\n{text}");
    }
}

/// A key of an earlier version is refused with its current name, wherever it was.
#[test]
fn keys_of_earlier_versions_name_the_present_ones() {
    for (table, was, now) in [
        ("[threads]\ntotal = 4\n", "threads.total", "launcher.thread_budget"),
        ("[threads]\nprober = 2\n", "threads.prober", "stages.prober.threads"),
        ("[log]\nformat = \"json\"\n", "log.format", "launcher.log_format"),
        ("[log]\ncamera = \"warn\"\n", "log.camera", "stages.camera.log"),
        ("[encoder]\ndeadline_ms = 9\n", "encoder.deadline_ms", "stages.encoder.deadline_ms"),
        ("[renderer]\nnice = 5\n", "renderer.nice", "stages.renderer.nice"),
        ("[realtime.prober]\ncpus = [0]\n", "realtime.prober.cpus", "stages.prober.cpus"),
        ("[launcher.restart]\nencoder = \"never\"\n", "launcher.restart.encoder", "stages.encoder.restart"),
    ] {
        assert_eq!(error(&format!("{HEAD}{table}")), format!("graph.toml:6: `{was}` is now called `{now}`"));
    }
}

/// The schema for editors has every range that reading checks.
#[test]
fn the_schema_holds_the_ranges() {
    let schema = schemars::schema_for!(GraphConfig).to_value();
    let run = &schema["$defs"]["RunConfig"]["properties"];
    assert_eq!((run["samples"]["minimum"].as_f64(), run["samples"]["maximum"].as_f64()), (Some(1.0), Some(64.0)));
    let stage = &schema["$defs"]["StageConfig"]["properties"];
    assert_eq!(stage["nice"]["minimum"].as_f64(), Some(-20.0));
    assert_eq!(stage["cpus"]["items"]["maximum"].as_f64(), Some(1023.0));
}

/// A file that is not TOML is an error with its line.
#[test]
fn broken_toml_names_the_line() {
    let message = error("[run]\nname = \"x\ndataset = 3\n");
    assert!(message.starts_with("graph.toml:2: "), "{message}");
}

/// A missing file is an error with its name and the system's reason.
#[test]
fn a_missing_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("none.toml");
    let error = GraphConfig::load(&path).unwrap_err();
    assert!(matches!(error, ConfigError::Read { .. }));
    assert!(error.to_string().contains("none.toml"), "{error}");
}

/// The shipped graph loads without a warning, and its values match its comments.
#[test]
fn the_shipped_graph_is_valid() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/graphs/approaching-intersection.toml");
    let graph = GraphConfig::load(&path).unwrap();
    assert_eq!(graph.warnings(), Vec::<String>::new());
    assert_eq!((graph.run.samples, graph.run.horizon, graph.camera.drives), (10, 2, 60));
    assert_eq!(graph.renderer.views, [ViewChoice::BirdsEye, ViewChoice::Free]);
    assert_eq!(
        graph.stage(Stage::Camera).restart,
        RestartPolicy::OnFailure { backoff_ms: 100, max_restarts: 5, within_s: 60 }
    );
    assert!(graph.scenario_path().unwrap().is_file());
    // Paths fall back to the project's root from any working directory.
    assert!(graph.resolve(Path::new("configs/graphs")).is_dir());
}

/// A graph that comes from a pipe has its relative paths from the current folder, not from that of the descriptor.
#[test]
fn paths_of_a_pipe() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let text = std::fs::read_to_string(root.join("configs/graphs/toy.toml")).unwrap();
    for path in ["/dev/fd/63", "/dev/stdin", "/proc/self/fd/0", "configs/graphs/x.toml"] {
        let graph = GraphConfig::parse(&text, Path::new(path)).unwrap();
        assert_eq!(graph.resolve(Path::new("data/none")), root.join("data/none"), "{path}");
        assert!(graph.scenario_path().unwrap().is_file(), "{path}");
    }
    assert!(is_stream(Path::new("/dev/stdin")) && is_stream(Path::new("/dev/null")));
    for file in [root.join("Cargo.toml"), root.to_owned(), "/dev/shm/graph.toml".into(), "none.toml".into()] {
        assert!(!is_stream(&file), "{}", file.display());
    }
}

/// Every shipped graph loads without a warning, and its scenario exists.
#[test]
fn every_shipped_graph_is_valid() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/graphs");
    let mut names = std::collections::BTreeSet::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let graph = GraphConfig::load(&path).unwrap();
        assert_eq!(graph.warnings(), Vec::<String>::new(), "{}", path.display());
        assert!(graph.scenario_path().unwrap().is_file(), "{}", path.display());
        assert!(names.insert(graph.run.name.clone()), "{}: two graphs have this name", path.display());
    }
    assert!(names.len() >= 6, "{names:?}");
}

/// Unusual but allowed settings cause warnings.
#[test]
fn odd_settings_are_warned_of() {
    let text =
        format!("{HEAD}[launcher]\nthread_budget = 4\n[stages.encoder]\nthreads = 2\n[controller]\ndeadline_ms = 90\n");
    let warnings = GraphConfig::parse(&text, Path::new("graph.toml")).unwrap().warnings();
    assert_eq!(warnings.len(), 2, "{warnings:?}");
    assert!(warnings[0].contains("threads") && warnings[1].contains("controller.deadline_ms"), "{warnings:?}");
}
