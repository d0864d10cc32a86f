//! Tests of real cameras: another process that publishes frames, and recordings of other tools.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_dataset::Image;
use carff_messages::{
    DatasetView, FrameMeta, Header, HealthState, Intrinsics, Reason, SCHEMA_VERSION, Stage, ViewMeta,
};
use carff_observe::attach;
use carff_tests::{
    Process, TestGraph, decisions, eventually, image_set, program, project_root, scenario_set, shipped_checkpoint,
};
use carff_transport::{ImagePayload, Node, Topic, monotonic_now_ns, topics};
use rustix::process::Signal;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Settings under which a busy machine still decides, and a lost camera is noticed.
const SETTINGS: &str = "frame_rate_hz = 5.0\n[controller]\nrate_hz = 4.0\ndeadline_ms = 5000\n[launcher]\n\
                        start_timeout_ms = 600000\nstop_timeout_ms = 30000\n[camera]\n";

fn external() -> String {
    format!("{SETTINGS}source = \"external\"\n")
}

fn camera(graph: &TestGraph) -> Process {
    let mut command = Command::new(program("external-camera"));
    Process::start(command.arg(scenario_set()).args([graph.run().name(), "5"]))
}

fn info(graph: &TestGraph) -> Value {
    let mut command = Command::new(program("carff"));
    let finished = Process::start(command.args(["run", "info", graph.run().name(), "--json"])).end();
    finished.assert_success();
    serde_json::from_str(&finished.text).unwrap()
}

/// A graph without a camera of its own names who is expected. A camera joins by the run's name, its frames are decided
/// on; it is killed, the safe action follows, and its successor continues the numbers of its frames. Nothing is left.
#[test]
fn another_process_is_the_camera() {
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &external());
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &[]));
    launcher.wait_for("invitation", |text| text.contains("waiting for another process to publish `camera/frame`"));
    assert!(launcher.text().contains(&format!("carff run info {}", graph.run().name())));

    let info = info(&graph);
    assert_eq!(info["transport"]["prefix"], graph.run().shared_memory_prefix());
    assert_eq!(info["camera"]["source"], "external");
    assert_eq!(info["camera"]["trained"]["width_px"], 128);
    let frame = info["topics"].as_array().unwrap().iter().find(|topic| topic["name"] == "camera/frame").unwrap();
    let frame = &frame["user_header"];
    assert_eq!((&frame["type_name"], &frame["size_bytes"]), (&"carff.FrameMeta.v2".into(), &264.into()));
    assert_eq!(
        (&frame["fields"][4]["name"], &frame["fields"][4]["offset_bytes"]),
        (&"world_from_camera".into(), &96.into())
    );

    let first = camera(&graph);
    launcher.wait_for("decisions on its frames", |text| decisions(text) >= 2);
    assert!(launcher.text().contains("camera: frames from external-camera (process"), "{}", launcher.text());
    let seen = attach(Some(graph.run().name()), "test").unwrap();
    let mut frames = seen.node.receiver(&topics::FRAME).unwrap();
    let mut actions = seen.node.receiver(&topics::ACTION).unwrap();
    let mut healths = seen.node.receiver(topics::health(Stage::Camera)).unwrap();
    let mut last = 0;
    assert!(eventually(|| {
        while let Some(frame) = frames.next().unwrap() {
            last = last.max(frame.header.frame_id);
        }
        last > 0
    }));
    first.signal(Signal::KILL);
    first.end();
    while let Some(frame) = frames.next().unwrap() {
        last = last.max(frame.header.frame_id);
    }
    launcher.wait_for("report of the silence", |text| text.contains("the safe action applies until frames come"));
    let safe = eventually(|| actions.newest().unwrap().is_some_and(|a| a.reason() == Ok(Reason::StaleBelief)));
    assert!(safe, "{}", launcher.text());
    let stale = eventually(|| healths.newest().unwrap().is_some_and(|h| h.state() == Ok(HealthState::Stale)));
    assert!(stale, "{}", launcher.text());

    let second = camera(&graph);
    let mut next = None;
    assert!(eventually(|| {
        next = next.or(frames.next().unwrap().map(|frame| frame.header.frame_id));
        next.is_some()
    }));
    assert_eq!(next, Some(last + 1), "{}", second.text());
    launcher.wait_for("return", |text| text.matches("camera: frames from external-camera").count() == 2);
    drop((frames, actions, healths, seen));
    launcher.signal(Signal::INT);
    let finished = launcher.end();
    assert_eq!(finished.status.code(), Some(130), "{}", finished.text);
    let left = second.end();
    assert!(left.text.contains("left run"), "{}", left.text);
    graph.assert_nothing_left();
}

/// A publisher of another layout is refused, frames of another schema version are dropped and counted, and the graph
/// still waits for its camera. A limit of frames ends the run.
#[test]
fn foreign_frames_are_validated() {
    static OTHER: Topic<ImagePayload<ViewMeta>> = Topic::new("camera/frame", topics::IMAGES, 500);
    let graph = TestGraph::new(&scenario_set(), &shipped_checkpoint(), &external());
    let mut launcher = Process::start(&mut graph.launch(&graph.file(), &["--frames", "3"]));
    launcher.wait_for("invitation", |text| text.contains("waiting for another process"));
    {
        let seen = attach(Some(graph.run().name()), "foreign").unwrap();
        let refused = seen.node.image_publisher(&OTHER, 12).unwrap_err().to_string();
        assert!(refused.contains("another layout"), "{refused}");
        let mut frames = seen.node.image_publisher(&topics::FRAME, 4 * 4 * 3).unwrap();
        let mut meta = FrameMeta {
            header: Header { run_id: seen.live.run_id, ..Header::of_frame(0, monotonic_now_ns(), 0) },
            width_px: 4,
            height_px: 4,
            intrinsics: Intrinsics { fl_x_px: 4.0, fl_y_px: 4.0, cx_px: 2.0, cy_px: 2.0 },
            world_from_camera: [0.0; 16],
            dataset_view: DatasetView::UNKNOWN,
            take_start: 0,
        };
        meta.header.schema_version = SCHEMA_VERSION + 1;
        launcher.wait_for("report of the wrong frames", |text| {
            let loan = frames.loan(48).unwrap();
            frames.send_image_unchecked(loan, meta).unwrap();
            text.contains("dropped an invalid message") && text.contains("header.schema_version")
        });
        assert!(!launcher.text().contains("camera: frames from"), "{}", launcher.text());
    }
    let camera = camera(&graph);
    launcher.end().assert_success();
    camera.end();
    graph.assert_nothing_left();
}

/// A folder of test images, its dataset, and the settings of a camera.
struct Recorded {
    folder: tempfile::TempDir,
}

impl Recorded {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        image_set(folder.path());
        Self { folder }
    }

    /// Returns a graph on the dataset, whose trained field of view is 59.5 degrees, 8 x 8 pixels.
    fn graph(&self, camera: &str) -> TestGraph {
        let rest = format!("frame_rate_hz = 50.0\n[camera]\nlinger_ms = 100\n{camera}\n");
        TestGraph::new(self.folder.path(), Path::new("none"), &rest)
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }
}

fn bag(name: &str) -> String {
    project_root().join("shared/recording/testdata").join(name).display().to_string()
}

/// Size of a frame, and the colours of its first and last pixels.
type Seen = ([u32; 2], [u8; 3], [u8; 3]);

/// Returns the frames that a camera's process publishes, and its output.
fn frames(graph: &TestGraph) -> (Vec<Seen>, String) {
    let node = Node::open(graph.run(), "test").unwrap();
    let mut frames = node.receiver(&topics::FRAME).unwrap();
    let mut healths = node.receiver(topics::health(Stage::Camera)).unwrap();
    let camera = graph.stage(Stage::Camera);
    let mut seen = Vec::new();
    let done = eventually(|| {
        while let Some(frame) = frames.next().unwrap() {
            let [width, height] = [frame.width_px, frame.height_px];
            let pixel = |i: usize| [0, 1, 2].map(|c| frame.bytes()[i * 3 + c]);
            seen.push(([width, height], pixel(0), pixel((width * height) as usize - 1)));
        }
        healths.newest().unwrap().is_some_and(|h| matches!(h.state(), Ok(HealthState::Done | HealthState::Faulty)))
    });
    let finished = camera.end();
    assert!(done, "{}", finished.text);
    (seen, finished.text)
}

fn one_error(graph: &TestGraph, words: &[&str]) {
    let finished = graph.stage(Stage::Camera).end();
    assert_eq!(finished.status.code(), Some(1), "{}", finished.text);
    let errors: Vec<&str> = finished.text.lines().filter(|line| line.starts_with("ERROR")).collect();
    assert_eq!(errors.len(), 1, "{}", finished.text);
    for word in words {
        assert!(errors[0].contains(word), "`{word}` is missing in {}", errors[0]);
    }
    assert!(!finished.text.contains("panicked"), "{}", finished.text);
}

/// A ROS 2 bag of another implementation is published, rectified by its own calibration to the size and the field of
/// view of the dataset.
#[test]
fn a_bag_is_published() {
    let recorded = Recorded::new();
    for name in ["ros2-raw.mcap", "ros2-jpeg.mcap"] {
        let graph = recorded.graph(&format!("source = \"mcap\"\nfile = \"{}\"", bag(name)));
        let (seen, text) = frames(&graph);
        assert_eq!(seen.len(), 4, "{text}");
        for (i, (size, left, right)) in seen.into_iter().enumerate() {
            assert_eq!(size, [8, 8]);
            for (found, wanted) in [(left, [10 * i as u8, 100, 200]), (right, [10 * i as u8, 100, 0])] {
                assert!(found.iter().zip(wanted).all(|(f, w)| f.abs_diff(w) < 6), "{found:?} {wanted:?}");
            }
        }
    }
}

/// A film is published without a calibration, unchanged.
#[test]
fn a_film_is_published() {
    let recorded = Recorded::new();
    let film = project_root().join("services/camera/testdata/ball.mp4");
    let pace = "pace = \"frame-rate\"";
    let graph = recorded.graph(&format!("source = \"video\"\nfile = \"{}\"\n{pace}", film.display()));
    let (seen, text) = frames(&graph);
    assert!(seen.len() == 20 && seen.iter().all(|(size, ..)| *size == [64, 64]), "{} {text}", seen.len());
    assert!(text.contains("no `camera.calibration`"), "{text}");
}

/// Wrong recordings and calibrations end the camera with one error that names the remedy.
#[test]
fn unusable_sources_are_one_error() {
    let recorded = Recorded::new();
    let mcap = |file: &str, more: &str| recorded.graph(&format!("source = \"mcap\"\nfile = \"{file}\"\n{more}"));
    one_error(&mcap("no/such.mcap", ""), &["no/such.mcap", "No such file"]);
    one_error(&mcap(&bag("ros2-none.mcap"), ""), &["contains no images", "/chatter"]);
    one_error(&mcap(&bag("ros2-two.mcap"), ""), &["camera.topic"]);
    let yaml = |side: u32, fl: f64| {
        format!(
            "image_width: {side}\nimage_height: {side}\ndistortion_model: plumb_bob\ncamera_matrix:\n  data: [{fl}, 0, \
             {c}, 0, {fl}, {c}, 0, 0, 1]\ndistortion_coefficients:\n  data: [0, 0, 0, 0, 0]\n",
            c = f64::from(side) / 2.0 - 0.5
        )
    };
    let with = |name: &str, text: &str| {
        let path = recorded.write(name, text);
        mcap(&bag("ros2-raw.mcap"), &format!("calibration = \"{}\"", path.display()))
    };
    one_error(&with("size.yaml", &yaml(64, 50.0)), &["32x32", "64x64", "calibrate at the size"]);
    one_error(&with("narrow.yaml", &yaml(32, 40.0)), &["43.6 x 43.6", "59.5 x 59.5", "wider lens"]);
    one_error(&with("broken.yaml", "image_width: [\n"), &["broken.yaml", "camera_info"]);
    let missing = mcap(&bag("ros2-raw.mcap"), "calibration = \"no/such.yaml\"");
    one_error(&missing, &["no/such.yaml"]);
    let no_dataset = TestGraph::new(
        Path::new("none"),
        Path::new("none"),
        &format!("[camera]\nsource = \"mcap\"\nfile = \"{}\"\n", bag("ros2-raw.mcap")),
    );
    one_error(&no_dataset, &["a calibration needs the dataset", "none"]);
    let text = recorded.write("text.mp4", "no film at all");
    one_error(
        &recorded.graph(&format!("source = \"video\"\nfile = \"{}\"", text.display())),
        &["text.mp4", "not an MP4"],
    );
}

/// Images of a folder are rectified by the table of the graph file.
#[test]
fn a_folder_is_rectified() {
    let recorded = Recorded::new();
    let images = recorded.folder.path().join("raw");
    std::fs::create_dir(&images).unwrap();
    Image::filled(40, 40, [50, 60, 70]).save_png(&images.join("a.png")).unwrap();
    let graph = recorded.graph(&format!(
        "source = \"folder\"\nfolder = \"{}\"\nframes_per_timestamp = 3\n[camera.noise]\nsigma = 0.0\n\
         gain_sigma = 0.0\nchannel_gain_sigma = 0.0\nchannel_offset_sigma = 0.0\n[camera.calibration]\nwidth_px = 40\n\
         height_px = 40\nfl_x_px = 20.0\nfl_y_px = 20.0\ncx_px = 19.5\ncy_px = 19.5\nmodel = \"fisheye\"\n\
         distortion = [0.01]",
        images.display()
    ));
    let (seen, text) = frames(&graph);
    assert_eq!(seen, [([8, 8], [50, 60, 70], [50, 60, 70]); 3], "{text}");
}
