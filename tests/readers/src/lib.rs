//! All readers of files and messages with a common function: any bytes are accepted or refused with a message, and
//! accepted input satisfies the reader's guarantees. Fuzzing (tests/fuzz) and the tests with kept and mutated inputs
//! use them.

mod raw;
mod valid;

use carff_base::geometry::PinholeCamera;
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::Manifest;
use carff_config::{FaultKind, GraphConfig, SoakConfig};
use carff_dataset::{CameraCalibration, Dataset, Image, ImportOptions, Rectifier, import};
use carff_field::FieldConfig;
use carff_messages::forms::AnyMessage;
use carff_messages::{
    Action, Belief, Forecast, FrameMeta, Health, ImageMeta, MAX_IMAGE_BYTES, Message, Posterior, ViewMeta,
};
use carff_observe::RunRecord;
use carff_recording::{ImageReader, Reader as RecordingReader, RecordingAbout, RecordingError, Writer};
use carff_scenes::Scenario;
use carff_training::TrainingConfig;
use carff_transport::TopicId;
use raw::patch;
use std::fs;
use std::path::{Path, PathBuf};

/// Result of an input: accepted, or the message with which it was refused.
pub type Verdict = Result<(), String>;

/// A reader of files or messages.
#[derive(Clone, Copy, Debug)]
pub struct Reader {
    /// Name of the reader, and of its folder of kept inputs.
    pub name: &'static str,
    read: fn(&[u8], &Path) -> Verdict,
    examples: fn(&Path) -> Vec<Vec<u8>>,
}

/// All readers.
pub const READERS: [Reader; 15] = [
    Reader { name: "messages", read: messages, examples: |_| (0..7).map(|kind| vec![kind]).collect() },
    Reader { name: "graph", read: graph, examples: |_| shipped("configs/graphs", "toml") },
    Reader { name: "scenario", read: scenario, examples: |_| shipped("configs/scenarios", "toml") },
    Reader { name: "soak", read: soak, examples: |_| shipped("configs/soak", "toml") },
    Reader { name: "training", read: training, examples: |_| shipped("configs/training", "toml") },
    Reader { name: "dataset", read: dataset, examples: |_| vec![SET.into()] },
    Reader { name: "import", read: plain_set, examples: |_| vec![PLAIN_SET.into()] },
    Reader { name: "png", read: png, examples: images },
    Reader { name: "planning", read: planning, examples: |_| vec![shipped_file(PLANNING)] },
    Reader { name: "manifest", read: manifest, examples: |_| vec![shipped_file(MANIFEST)] },
    Reader { name: "weights", read: weights, examples: small_weights },
    Reader { name: "recording", read: recording, examples: small_recording },
    Reader { name: "bag", read: bag, examples: |_| shipped("shared/recording/testdata", "mcap") },
    Reader { name: "calibration", read: calibration, examples: |_| vec![CAMERA_INFO.into()] },
    Reader { name: "run-record", read: run_record, examples: |_| vec![small_record()] },
];

impl Reader {
    /// Reads `bytes` with this reader. `folder` is private to this call, for files that the reader needs.
    ///
    /// # Panics
    ///
    /// A guarantee is violated: the reader panics, accepts invalid input, or refuses without a message.
    pub fn read(&self, bytes: &[u8], folder: &Path) -> Verdict {
        let verdict = (self.read)(bytes, folder);
        if let Err(words) = &verdict {
            assert!(!words.trim().is_empty(), "{} refuses without a message", self.name);
        }
        verdict
    }

    /// Returns inputs that it must accept. `folder` is private to this call.
    pub fn examples(&self, folder: &Path) -> Vec<Vec<u8>> {
        (self.examples)(folder)
    }

    /// Returns the folder of kept inputs: inputs that once broke a reader, and small ones of each kind.
    pub fn kept(&self) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(self.name)
    }
}

const PLANNING: &str = "configs/checkpoints/approaching-intersection/planning.json";
const MANIFEST: &str = "configs/checkpoints/approaching-intersection/manifest.json";

/// A dataset of two states of one branch from one pose.
const SET: &str = r#"{
  "w": 2, "h": 2, "fl_x": 2.0, "fl_y": 2.0, "cx": 1.0, "cy": 1.0,
  "scenario": {
    "name": "small", "bounds": [[-1, -1, 0], [1, 1, 2]], "branches": ["a"], "timestamps": 2, "bev_view": 0,
    "hazard_branches": [0], "actions": {"hazard": "halt", "clear": "advance"},
    "states": [
      {"scene_id": 0, "boxes": [
        {"name": "actor", "role": "actor", "center": [0, 0, 1], "half_size": [2, 1, 1], "yaw": 0.5, "dynamic": true}
      ]},
      {"scene_id": 1}
    ]
  },
  "frames": [
    {"file_path": "a.png", "scene_id": 0, "branch": 0, "timestamp": 0, "view_id": 0, "observability": "full",
     "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]},
    {"file_path": "a.png", "scene_id": 1, "branch": 0, "timestamp": 1, "view_id": 0, "observability": "none",
     "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]}
  ]
}"#;

/// A dataset without a scenario, of two poses.
const PLAIN_SET: &str = r#"{
  "camera_angle_x": 0.9,
  "frames": [
    {"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]},
    {"file_path": "a.png", "transform_matrix": [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]]}
  ]
}"#;

/// A calibration as ROS's calibrators write it.
const CAMERA_INFO: &str = "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\ncamera_matrix:\n  rows: 3\n  \
    cols: 3\n  data: [438.7, 0.0, 305.5, 0.0, 437.3, 243.7, 0.0, 0.0, 1.0]\ndistortion_coefficients:\n  \
    data: [-0.36, 0.11, 0.001, 0.0005, 0.0]\n";

fn project() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn shipped_file(path: &str) -> Vec<u8> {
    fs::read(project().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

fn shipped(folder: &str, extension: &str) -> Vec<Vec<u8>> {
    let entries = fs::read_dir(project().join(folder)).unwrap_or_else(|e| panic!("{folder}: {e}"));
    let mut paths: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
    paths.retain(|p| p.extension().is_some_and(|e| e == extension));
    paths.sort();
    paths.iter().map(|p| fs::read(p).unwrap_or_else(|e| panic!("{}: {e}", p.display()))).collect()
}

fn put(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    path
}

fn text(bytes: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(bytes).map_err(|e| e.to_string())
}

fn words(error: impl std::error::Error) -> String {
    error.to_string()
}

/// The first byte selects a valid message; the others overwrite its bytes.
fn messages(bytes: &[u8], _: &Path) -> Verdict {
    let (kind, patches) = bytes.split_first().unwrap_or((&0, &[]));
    macro_rules! validated {
        ($message:expr, $kind:ty, $holds:expr) => {{
            let mut message: $kind = $message;
            patch!(message, patches);
            let verdict = message.validate().map_err(words);
            let holds: fn(&$kind) -> bool = $holds;
            assert!(verdict.is_err() || holds(&message), "accepted: {message:?}");
            verdict
        }};
    }
    match kind % 7 {
        0 => validated!(valid::posterior(), Posterior, |m| m.gaussian.mean.iter().all(|v| v.is_finite())),
        1 => validated!(valid::forecast(), Forecast, |m| m.samples().iter().flatten().all(|v| v.is_finite())),
        2 => validated!(valid::belief(), Belief, |m| {
            m.samples().iter().all(|s| (0.0..=1.0).contains(&s.hazard_likelihood))
        }),
        3 => validated!(valid::action(), Action, |m| m.code().is_ok() && m.reason().is_ok()),
        4 => validated!(valid::health(), Health, |m| m.stage().is_ok() && m.state().is_ok()),
        5 => validated!(valid::frame(), FrameMeta, |m| (1..=MAX_IMAGE_BYTES).contains(&m.image_bytes())),
        _ => validated!(valid::view(), ViewMeta, |m| (1..=MAX_IMAGE_BYTES).contains(&m.image_bytes())),
    }
}

fn graph(bytes: &[u8], _: &Path) -> Verdict {
    let graph = GraphConfig::parse(text(bytes)?, Path::new("graph.toml")).map_err(|e| {
        assert!(e.to_string().starts_with("graph.toml:"), "{e}");
        words(e)
    })?;
    assert!((1..=64).contains(&graph.run.samples) && graph.run.frame_rate_hz.is_finite(), "{graph:?}");
    let _ = graph.warnings();
    Ok(())
}

fn scenario(bytes: &[u8], _: &Path) -> Verdict {
    let scenario = Scenario::parse(Path::new("scenario.toml"), text(bytes)?).map_err(|e| {
        assert!(e.to_string().contains("scenario.toml"), "{e}");
        words(e)
    })?;
    let info = scenario.info();
    assert!(info.state_count() > 0 && info.hazard_branches.iter().all(|b| *b < info.branches.len()), "{info:?}");
    Ok(())
}

fn soak(bytes: &[u8], _: &Path) -> Verdict {
    let soak = SoakConfig::parse(text(bytes)?, Path::new("soak.toml")).map_err(|e| {
        assert!(e.to_string().starts_with("soak.toml:"), "{e}");
        words(e)
    })?;
    let weight: u64 = FaultKind::ALL.iter().map(|kind| u64::from(soak.faults.of(*kind))).sum();
    assert!(weight > 0 && soak.pace.min_pause_ms <= soak.pace.max_pause_ms, "{soak:?}");
    assert!(soak.contract.p99_drift_percent.is_finite(), "{soak:?}");
    Ok(())
}

fn training(bytes: &[u8], folder: &Path) -> Verdict {
    let path = put(folder, "training.toml", bytes);
    let config = TrainingConfig::load(&path).map_err(|e| {
        assert!(e.to_string().contains("training.toml"), "{e}");
        words(e)
    })?;
    assert!(config.validate().is_ok());
    Ok(())
}

fn dataset(bytes: &[u8], folder: &Path) -> Verdict {
    small_image(folder);
    put(folder, "transforms.json", bytes);
    let set = Dataset::open(folder).map_err(words)?;
    for i in 0..set.frames().len().min(4) {
        let _ = set.load_image(i);
    }
    for (state, view) in (0..set.state_count().min(64)).zip(0..set.view_count().min(64)) {
        assert!(set.frame_index(state, view).is_none_or(|i| i < set.frames().len()));
    }
    Ok(())
}

fn plain_set(bytes: &[u8], folder: &Path) -> Verdict {
    let (from, out) = (folder.join("from"), folder.join("out"));
    fs::create_dir_all(&from).unwrap_or_else(|e| panic!("{}: {e}", from.display()));
    // The folder exists if an earlier input was accepted.
    let _ = fs::remove_dir_all(&out);
    small_image(&from);
    put(&from, "transforms.json", bytes);
    import(&from, &out, &ImportOptions::default()).map_err(words)?;
    Dataset::open(&out).unwrap_or_else(|e| panic!("an imported dataset is refused: {e}"));
    Ok(())
}

fn small_image(folder: &Path) {
    let path = folder.join("a.png");
    if !path.is_file() {
        Image::filled(2, 2, [9; 3]).save_png(&path).unwrap_or_else(|e| panic!("{e}"));
    }
}

/// Camera images of another tool. A bag without images is accepted as an example of a readable file.
fn bag(bytes: &[u8], folder: &Path) -> Verdict {
    let path = folder.join("bag.mcap");
    fs::write(&path, bytes).map_err(|e| e.to_string())?;
    let mut reader = match ImageReader::open(&path, None) {
        Err(RecordingError::NoImages { .. } | RecordingError::SeveralImages { .. }) => return Ok(()),
        opened => opened.map_err(|e| e.to_string())?,
    };
    reader.calibration().map_err(|e| e.to_string())?;
    while reader.next().map_err(|e| e.to_string())?.is_some() {
        #[allow(clippy::redundant_closure_for_method_calls, reason = "the method is of one lifetime")]
        let [w, h] = reader.with_image(|image| image.size_px()).map_err(|e| e.to_string())?;
        let last = reader.with_image(|raw| raw.pixel(w as usize - 1, h as usize - 1));
        assert!(w > 0 && h > 0 && last.is_ok());
    }
    Ok(())
}

/// Accepted calibrations give a map, or an error, for a small trained camera.
fn calibration(bytes: &[u8], folder: &Path) -> Verdict {
    let path = folder.join("camera.yaml");
    fs::write(&path, bytes).map_err(|e| e.to_string())?;
    let calibration = CameraCalibration::load(&path).map_err(|e| e.to_string())?;
    let trained = PinholeCamera::look_at([0.0; 3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 8, 8, 30.0);
    Rectifier::new(&calibration, &trained).map(drop).map_err(|e| e.to_string())
}

fn png(bytes: &[u8], folder: &Path) -> Verdict {
    let path = put(folder, "image.png", bytes);
    let image = Image::load(&path).map_err(|e| {
        assert!(e.to_string().contains("image.png"), "{e}");
        words(e)
    })?;
    assert_eq!(image.rgb.len(), image.width_px as usize * image.height_px as usize * 3);
    Ok(())
}

fn images(folder: &Path) -> Vec<Vec<u8>> {
    small_image(folder);
    vec![fs::read(folder.join("a.png")).unwrap_or_else(|e| panic!("{e}"))]
}

fn planning(bytes: &[u8], folder: &Path) -> Verdict {
    put(folder, "planning.json", bytes);
    let planning = CheckpointPlanning::load(folder).map_err(|e| {
        assert!(e.to_string().contains("planning.json"), "{e}");
        words(e)
    })?;
    assert!((0.0..=1.0).contains(&planning.hazard_threshold), "{planning:?}");
    Ok(())
}

fn manifest(bytes: &[u8], folder: &Path) -> Verdict {
    put(folder, "manifest.json", bytes);
    let manifest = Manifest::load(folder).map_err(|e| {
        assert!(e.to_string().contains("manifest.json"), "{e}");
        words(e)
    })?;
    if manifest.probing.is_some() {
        carff_checkpoint::load_probing(folder, &manifest).map(drop).map_err(words)?;
    }
    Ok(())
}

/// Returns the configuration of a small field, which can be read quickly.
fn small_field() -> FieldConfig {
    FieldConfig {
        levels: 2,
        features_per_level: 2,
        log2_table_size: 8,
        base_resolution: 2,
        max_resolution: 4,
        hidden_width: 8,
        geometry_features: 3,
        direction_degree: 1,
        background_width: 4,
        occupancy_resolution: 8,
        ..FieldConfig::default()
    }
}

fn small_manifest() -> Manifest {
    let dir = project().join("configs/checkpoints/approaching-intersection");
    let shipped = Manifest::load(&dir).unwrap_or_else(|e| panic!("{e}"));
    Manifest { field: Some(small_field()), ..shipped }
}

fn weights(bytes: &[u8], folder: &Path) -> Verdict {
    static MANIFEST: std::sync::LazyLock<Manifest> = std::sync::LazyLock::new(small_manifest);
    put(folder, carff_checkpoint::files::FIELD, bytes);
    carff_checkpoint::load_field(folder, &MANIFEST).map(drop).map_err(words)
}

fn small_weights(folder: &Path) -> Vec<Vec<u8>> {
    let field = carff_field::Field::new(small_field(), 0).unwrap_or_else(|e| panic!("{e}"));
    carff_checkpoint::save_field(folder, &field).unwrap_or_else(|e| panic!("{e}"));
    vec![fs::read(folder.join(carff_checkpoint::files::FIELD)).unwrap_or_else(|e| panic!("{e}"))]
}

fn recording(bytes: &[u8], folder: &Path) -> Verdict {
    let path = put(folder, "run.mcap", bytes);
    let mut reader = RecordingReader::open(&path).map_err(|e| {
        assert!(e.to_string().contains("run.mcap"), "{e}");
        words(e)
    })?;
    // An error does not end it: the next message may be valid. A file has fewer messages than bytes.
    let mut first_error = Ok(());
    for _ in 0..=bytes.len() {
        match reader.next() {
            Ok(Some(entry)) => drop(entry.message.as_message().to_json().map_err(words)?),
            Ok(None) => return first_error,
            Err(error) => first_error = first_error.and(Err(words(error))),
        }
    }
    panic!("more messages than bytes")
}

fn small_recording(folder: &Path) -> Vec<Vec<u8>> {
    let path = folder.join("run.mcap");
    let write = || {
        let about = RecordingAbout { run: "r".into(), run_id: 5, ..RecordingAbout::default() };
        let mut writer = Writer::create(&path, &about, &[])?;
        let posterior = valid::posterior();
        writer.write(TopicId::POSTERIOR, AnyMessage::new(&posterior, &[]))?;
        let (frame, belief) = (valid::frame(), valid::belief());
        writer.write(TopicId::FRAME, AnyMessage::new(&frame, &vec![7; frame.image_bytes()]))?;
        writer.write(TopicId::BELIEF, AnyMessage::new(&belief, &[]))?;
        writer.finish()
    };
    write().unwrap_or_else(|e| panic!("{e}"));
    vec![fs::read(&path).unwrap_or_else(|e| panic!("{e}"))]
}

fn run_record(bytes: &[u8], _: &Path) -> Verdict {
    RunRecord::from_bytes(bytes).map(drop).ok_or_else(|| "no record".into())
}

fn small_record() -> Vec<u8> {
    let record = RunRecord {
        pid: 7,
        run_id: 9,
        graph: "graph.toml".into(),
        dataset: "data".into(),
        checkpoint: "checkpoint".into(),
        started_unix_s: 1 << 31,
    };
    record.to_bytes().unwrap_or_else(|e| panic!("{e}"))
}
