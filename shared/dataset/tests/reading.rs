//! Tests of reading and writing datasets: accepted values, derived values, and the message of each error.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::path::Path;

use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_dataset::{
    Candidate, Dataset, DatasetReport, DatasetWriter, Equivalence, FrameRecord, Image, ImageComparison, NamedBox,
    Observability, PoseRole, PoseSplit, ScenarioInfo, SheetOptions, StateInfo, contact_sheet,
};
use serde_json::{Value, json};

const IDENTITY: [[f64; 4]; 4] =
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]];

/// Returns two branches x two time steps x two views of 8x8 pixels, with all keys.
fn whole() -> Value {
    let mut frames = Vec::new();
    for branch in 0..2 {
        for timestamp in 0..2 {
            for view in 0..2 {
                frames.push(json!({
                    "file_path": format!("images/b{branch}_t{timestamp}_v{view}.png"),
                    "transform_matrix": IDENTITY,
                    "scene_id": branch * 2 + timestamp, "branch": branch, "timestamp": timestamp, "view_id": view,
                    "observability": if view == 0 { "full" } else { "none" },
                    "visible_fraction": 0.5, "actor_px": 20, "view_kind": "orbit", "somebody_elses_key": [1, 2],
                }));
            }
        }
    }
    let place = json!({"name": "actor", "role": "actor", "center": [0, 0, 1], "half_size": [2, 1, 1], "yaw": 0.5,
        "dynamic": true});
    json!({
        "w": 8, "h": 8, "fl_x": 7.0, "fl_y": 7.0, "cx": 4.0, "cy": 4.0,
        "frames": frames,
        "scenario": {
            "name": "small", "bounds": [[-1, -1, 0], [1, 1, 2]], "branches": ["with", "without"], "timestamps": 2,
            "bev_view": 0,
            "states": [
                {"scene_id": 0, "branch": 0, "timestamp": 0, "boxes": [place]},
                {"scene_id": 1, "boxes": [place]},
                {"branch": 1, "timestamp": 0},
                {"scene_id": 3, "boxes": []},
            ],
            "candidates": [place], "static_boxes": [],
            "hazard_branches": [0], "hazard_from_timestamp": 1, "actions": {"hazard": "stop", "clear": "go"},
        },
    })
}

/// Writes the transforms file, and an image for each frame inside the folder.
fn put(dir: &Path, name: &str, set: &Value) {
    std::fs::write(dir.join(name), set.to_string()).unwrap();
    for (i, frame) in set["frames"].as_array().into_iter().flatten().enumerate() {
        if let Some(path) = frame["file_path"].as_str().filter(|p| !p.contains("..") && !p.starts_with('/')) {
            let path = dir.join(path);
            let path = if path.extension().is_none() { path.with_extension("png") } else { path };
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            Image::filled(8, 8, [i as u8 * 20, 0, 0]).save_png(&path).unwrap();
        }
    }
}

fn open(set: &Value) -> Result<Dataset, String> {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), "transforms.json", set);
    Dataset::open(dir.path()).map_err(|e| e.to_string().replace(&dir.path().display().to_string(), "SET"))
}

/// Every key of the format is read into its field.
#[test]
fn whole_set() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), "transforms.json", &whole());
    let dataset = Dataset::open(dir.path()).unwrap();
    assert_eq!((dataset.frames().len(), dataset.view_count(), dataset.state_count()), (8, 2, 4));
    let frame = &dataset.frames()[5];
    assert_eq!((frame.state, frame.branch, frame.timestamp, frame.view), (Some(2), Some(1), Some(0), Some(1)));
    assert_eq!(frame.observability, Some(Observability::None));
    assert_eq!((frame.visible_fraction, frame.actor_px), (Some(0.5), Some(20)));
    assert_eq!(frame.view_kind.as_deref(), Some("orbit"));
    assert_eq!(frame.camera.position_m(), [0.0, 0.0, 5.0]);
    assert_eq!(dataset.frame_index(2, 1), Some(5));
    let scenario = dataset.scenario().unwrap();
    assert_eq!((scenario.name.as_str(), scenario.bev_view, scenario.timestamps), ("small", Some(0), 2));
    assert_eq!((&scenario.hazard_branches[..], scenario.hazard_from_timestamp), (&[0][..], 1));
    assert_eq!([(0, 0), (0, 1), (1, 1)].map(|(b, t)| scenario.is_hazard_at(b, t)), [false, true, false]);
    assert_eq!((scenario.hazard_action.as_str(), scenario.clear_action.as_str()), ("stop", "go"));
    assert!(scenario.is_hazard(0) && !scenario.is_hazard(1));
    assert_eq!(scenario.states[1].boxes[0].oriented_box.yaw, 0.5);
    assert!(scenario.states[1].boxes[0].dynamic && scenario.states[2].boxes.is_empty());
    assert_eq!(scenario.candidates[0].timestamp, None);
    assert_eq!(dataset.load_image(3).unwrap(), Image::filled(8, 8, [60, 0, 0]));
    assert_eq!(dataset.load_all_images().unwrap().len(), 8);
}

/// The book's example is a complete dataset: it is read without warnings, and each state has its boxes.
#[test]
fn the_books_example_is_a_set() {
    let page = include_str!("../../../docs/book/src/dataset-format.md");
    let example = page.split("```json").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let set: Value = serde_json::from_str(example).unwrap();
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    for frame in set["frames"].as_array().unwrap() {
        Image::filled(128, 128, [7; 3]).save_png(&dir.path().join(frame["file_path"].as_str().unwrap())).unwrap();
    }
    std::fs::write(dir.path().join("transforms.json"), example).unwrap();
    let set = Dataset::open(dir.path()).unwrap();
    let states = &set.scenario().unwrap().states;
    assert_eq!(states.iter().map(|s| s.boxes.len()).collect::<Vec<_>>(), [1, 1, 0, 0]);
    assert!((set.state_count(), set.view_count()) == (4, 1) && set.warnings().is_empty());
}

/// The format of the CARFF authors is read: only `scene_id`, and `view_index` or `time_index` in place of `view_id`.
#[test]
fn authors_form() {
    for key in ["view_index", "time_index"] {
        let mut set = whole();
        for frame in set["frames"].as_array_mut().unwrap() {
            let frame = frame.as_object_mut().unwrap();
            let view = frame.remove("view_id").unwrap();
            frame.insert(key.to_owned(), view);
            frame.remove("branch");
            frame.remove("timestamp");
        }
        let dataset = open(&set).unwrap();
        let frame = &dataset.frames()[7];
        assert_eq!((frame.state, frame.branch, frame.timestamp, frame.view), (Some(3), Some(1), Some(1), Some(1)));
    }
}

/// Observability is derived for a dataset without it, with a warning: `none` if all branches look the same, `partial`
/// if some do, `full` if none does. Values in the dataset are kept.
#[test]
fn images_tell_observability() {
    let dir = tempfile::tempdir().unwrap();
    let mut set = whole();
    set["scenario"]["branches"] = json!(["with", "without", "late"]);
    set["scenario"]["states"] = json!([]);
    let mut frames = Vec::new();
    // Three views of each branch: one distinguishes all branches, one only the last from the others, one none.
    for branch in 0..3_u8 {
        for (view, level) in [20 * branch, 20 * (branch / 2), 0].into_iter().enumerate() {
            for timestamp in 0..2_u8 {
                let path = format!("images/b{branch}_t{timestamp}_v{view}.png");
                frames.push(json!({"file_path": path, "transform_matrix": IDENTITY,
                    "scene_id": branch * 2 + timestamp, "view_index": view}));
                std::fs::create_dir_all(dir.path().join("images")).unwrap();
                Image::filled(8, 8, [level, 100 * timestamp, 0]).save_png(&dir.path().join(path)).unwrap();
            }
        }
    }
    set["frames"] = json!(frames);
    let read = |set: &Value| {
        std::fs::write(dir.path().join("transforms.json"), set.to_string()).unwrap();
        Dataset::open(dir.path()).unwrap()
    };
    let dataset = read(&set);
    for frame in dataset.frames() {
        let wanted = match (frame.view, frame.branch) {
            (Some(0), _) | (Some(1), Some(2)) => Observability::Full,
            (Some(1), _) => Observability::Partial,
            _ => Observability::None,
        };
        assert_eq!(frame.observability, Some(wanted), "{frame:?}");
    }
    assert!(dataset.warnings().iter().any(|w| w.contains("it is derived from the images")), "{:?}", dataset.warnings());

    set["frames"][0]["observability"] = json!("partial");
    let dataset = read(&set);
    assert_eq!(dataset.frames()[0].observability, Some(Observability::Partial));
    assert!(dataset.frames()[1..].iter().all(|f| f.observability.is_none()) && dataset.warnings().is_empty());
}

/// A `NeRF` dataset without a scenario is read: an angle as focal length, sizes from the images, names without
/// extension, three files read as one, and a frame's own intrinsics before those at top level.
#[test]
fn plain_set_in_three_files() {
    let dir = tempfile::tempdir().unwrap();
    for (part, angle) in [("train", 0.9), ("val", 0.8), ("test", 0.7)] {
        let frames = json!([
            {"file_path": format!("./{part}/r_0"), "transform_matrix": IDENTITY},
            {"file_path": format!("./{part}/r_1"), "transform_matrix": IDENTITY, "fl_x": 9.0, "cx": 3.0},
        ]);
        put(dir.path(), &format!("transforms_{part}.json"), &json!({"camera_angle_x": angle, "frames": frames}));
    }
    let dataset = Dataset::open(dir.path()).unwrap();
    assert_eq!((dataset.frames().len(), dataset.view_count(), dataset.state_count()), (6, 0, 1));
    assert!(dataset.scenario().is_none());
    let camera = dataset.frames()[2].camera;
    assert!((camera.fl_x_px - 4.0 / (0.4_f64).tan()).abs() < 1e-9);
    assert_eq!((camera.fl_y_px, camera.cx_px, camera.width_px), (camera.fl_x_px, 4.0, 8));
    let camera = dataset.frames()[3].camera;
    assert_eq!((camera.fl_x_px, camera.fl_y_px, camera.cx_px, camera.cy_px), (9.0, 9.0, 3.0, 4.0));
    assert_eq!(dataset.load_all_images().unwrap().len(), 6);
}

/// A scenario in three files is read: views that restart at 0 are renumbered, and frames without a view get one per
/// pose. Sizes may differ, from 64 to 512 pixels.
#[test]
fn scenario_in_three_files() {
    for named in [true, false] {
        let dir = tempfile::tempdir().unwrap();
        let mut scenario = whole()["scenario"].clone();
        scenario["bev_view"] = json!(1);
        let mut x = 0.0;
        for (part, side, views) in [("train", 64, 3), ("val", 200, 1), ("test", 512, 2)] {
            let mut frames = Vec::new();
            for view in 0..views {
                x += 1.0;
                let mut pose = IDENTITY;
                pose[0][3] = x;
                for state in 0..4 {
                    let name = format!("{part}/v{view}_s{state}.png");
                    std::fs::create_dir_all(dir.path().join(part)).unwrap();
                    Image::filled(side, side, [10, 20, 30]).save_png(&dir.path().join(&name)).unwrap();
                    let mut frame = json!({"file_path": name, "transform_matrix": pose, "scene_id": state});
                    if named {
                        frame["view_index"] = json!(view);
                    }
                    frames.push(frame);
                }
            }
            let mut set = json!({"camera_angle_x": 0.9, "frames": frames});
            if part == "train" {
                set["scenario"] = scenario.clone();
            }
            std::fs::write(dir.path().join(format!("transforms_{part}.json")), set.to_string()).unwrap();
        }
        let dataset = Dataset::open(dir.path()).unwrap();
        assert_eq!((dataset.view_count(), dataset.frames().len()), (6, 24), "named: {named}");
        for (i, frame) in dataset.frames().iter().enumerate() {
            assert_eq!((frame.view, frame.state), (Some(i / 4), Some(i % 4)));
            assert!((frame.camera.position_m()[0] - (i / 4 + 1) as f64).abs() < 1e-9);
        }
        let sizes: Vec<u32> = dataset.load_all_images().unwrap().iter().step_by(4).map(|i| i.width_px).collect();
        assert_eq!(sizes, [64, 64, 64, 200, 512, 512]);
    }
}

/// Branch and timestamp identify states without a scenario.
#[test]
fn states_without_scenario() {
    let mut set = whole();
    set.as_object_mut().unwrap().remove("scenario");
    for frame in set["frames"].as_array_mut().unwrap() {
        frame.as_object_mut().unwrap().remove("scene_id");
    }
    let dataset = open(&set).unwrap();
    assert_eq!(dataset.state_count(), 4);
    assert_eq!(dataset.frames()[6].state, Some(3));
}

type Change = Box<dyn FnOnce(&mut Value)>;

/// Applies a change and returns the error message.
fn mistake(change: impl FnOnce(&mut Value)) -> String {
    let mut set = whole();
    change(&mut set);
    open(&set).unwrap_err()
}

/// Each kind of bad input has its message: file, place, key, the error, and the allowed values.
#[test]
fn golden_errors() {
    let f3 = "SET/transforms.json: frame 3 (images/b0_t1_v1.png): ";
    let at = |pointer: &'static str, value: Value| -> Change {
        Box::new(move |set| *set.pointer_mut(pointer).unwrap() = value)
    };
    let without = |pointer: &'static str, key: &'static str| -> Change {
        Box::new(move |set| {
            set.pointer_mut(pointer).unwrap().as_object_mut().unwrap().remove(key).unwrap();
        })
    };
    let mut sheared = IDENTITY;
    sheared[0][1] = 0.5;
    let cases: Vec<(Change, String)> = vec![
        (without("", "frames"), "SET/transforms.json: top level: key `frames`: is missing".into()),
        (at("/frames", json!([])), "SET/transforms.json: top level: key `frames`: is empty; at least one frame is needed".into()),
        (at("/frames", json!({})), "SET/transforms.json: top level: key `frames`: must be a list, found an object".into()),
        (
            at("/frames/3/file_path", json!("../../b.png")),
            "SET/transforms.json: frame 3 (../../b.png): key `file_path`: must be relative, and at most one folder above the dataset's: no leading `/` and one `..` at most".into(),
        ),
        (
            at("/frames/3/file_path", json!("a/../../../b.png")),
            "SET/transforms.json: frame 3 (a/../../../b.png): key `file_path`: must be relative, and at most one folder above the dataset's: no leading `/` and one `..` at most".into(),
        ),
        (
            at("/frames/3/file_path", json!("/etc/b.png")),
            "SET/transforms.json: frame 3 (/etc/b.png): key `file_path`: must be relative, and at most one folder above the dataset's: no leading `/` and one `..` at most".into(),
        ),
        (
            at("/frames/3/file_path", json!("C:/data/b.png")),
            "SET/transforms.json: frame 3 (C:/data/b.png): key `file_path`: must be relative, and at most one folder above the dataset's: no leading `/` and one `..` at most".into(),
        ),
        (
            without("/frames/3", "file_path"),
            "SET/transforms.json: frame 3: key `file_path`: is missing; it is the image's path relative to the dataset folder".into(),
        ),
        (without("/frames/3", "transform_matrix"), format!("{f3}key `transform_matrix`: is missing")),
        (
            at("/frames/3/transform_matrix/1", json!([0, 1, 0])),
            format!("{f3}key `transform_matrix`: must be 4 rows of 4 finite numbers"),
        ),
        (
            at("/frames/3/transform_matrix", json!(sheared)),
            format!("{f3}key `transform_matrix`: the rotation part of `transform_matrix` is not a rotation: its columns must be perpendicular, of length 1 and right-handed; a camera-to-world matrix is a rotation and a translation over the row 0 0 0 1"),
        ),
        (at("/fl_x", json!("wide")), "SET/transforms.json: top level: key `fl_x`: must be a finite number, found a text".into()),
        (without("", "w"), "SET/transforms.json: frame 0 (images/b0_t0_v0.png): key `w`: is missing while `h` is given".into()),
        (
            at("/w", json!(9000)),
            "SET/transforms.json: frame 0 (images/b0_t0_v0.png): key `w`: must be a whole number from 1 to 8192 pixels, found 9000".into(),
        ),
        (
            without("", "fl_x"),
            "SET/transforms.json: frame 0 (images/b0_t0_v0.png): key `fl_x`: is missing, and so is `camera_angle_x`; one of them is needed".into(),
        ),
        (at("/frames/3/scene_id", json!(4)), format!("{f3}key `scene_id`: must be a whole number from 0 to 3, found 4")),
        (
            at("/frames/3/scene_id", json!(2)),
            format!("{f3}key `scene_id`: is 2, but `branch` and `timestamp` make 1 (branch * 2 + timestamp)"),
        ),
        (at("/frames/3/timestamp", json!(-1)), format!("{f3}key `timestamp`: must be a whole number from 0 to 1, found -1")),
        (without("/frames/3", "view_id"), format!("{f3}key `view_id`: is missing; each frame of a scenario names its camera pose")),
        (
            at("/frames/3/view_id", json!(0)),
            format!("{f3}key `view_id`: view 0 of state 1 occurs before, in frame 2 (images/b0_t1_v0.png)"),
        ),
        (
            at("/frames/3/view_id", json!(2)),
            "SET/transforms.json: frames: key `view_id`: view 1 is missing in state 1 (branch `with`, timestamp 1); every view is needed in every state, except for `carff train` and `carff eval`".into(),
        ),
        (
            at("/frames/3/transform_matrix/2/3", json!(5.5)),
            format!("{f3}key `transform_matrix`: differs from that of the same view 1 in frame 1 (images/b0_t0_v1.png); a view is one fixed pose"),
        ),
        (
            at("/frames/3/observability", json!("some")),
            format!("{f3}key `observability`: must be `full`, `partial` or `none`, found `some`"),
        ),
        (at("/frames/3/visible_fraction", json!(1.5)), format!("{f3}key `visible_fraction`: must be from 0 to 1, found 1.5")),
        (without("/scenario", "timestamps"), "SET/transforms.json: scenario: key `timestamps`: must be a whole number from 1 to 4096".into()),
        (
            at("/scenario/bounds", json!([[0, 0, 0], [1, 0, 1]])),
            "SET/transforms.json: scenario: key `bounds`: the first corner must be below the second along every axis".into(),
        ),
        (at("/scenario/branches", json!(["a", "a"])), "SET/transforms.json: scenario: key `branches`: `a` is named twice".into()),
        (
            at("/scenario/hazard_branches", json!([2])),
            "SET/transforms.json: scenario: key `hazard_branches`: must be branch indices from 0 to 1, found 2".into(),
        ),
        (
            at("/scenario/hazard_from_timestamp", json!(2)),
            "SET/transforms.json: scenario: key `hazard_from_timestamp`: must be a whole number from 0 to 1, found 2".into(),
        ),
        (at("/scenario/bev_view", json!(2)), "SET/transforms.json: scenario: key `bev_view`: is 2, but the views are 0 to 1".into()),
        (
            at("/scenario/states/1/scene_id", json!(0)),
            "SET/transforms.json: scenario.states[1]: key `scene_id`: state 0 is given twice".into(),
        ),
        (
            at("/scenario/states/0/boxes/0/half_size", json!([1, 0, 1])),
            "SET/transforms.json: scenario.states[0].boxes[0]: key `half_size`: must be greater than zero along every axis, metres".into(),
        ),
        (
            without("/scenario/candidates/0", "center"),
            "SET/transforms.json: scenario.candidates[0]: key `center`: is missing".into(),
        ),
    ];
    for (change, expected) in cases {
        assert_eq!(mistake(change), expected);
    }
}

/// A missing folder, an empty folder, broken JSON (with its line), a missing image and an image of another size have
/// different messages.
#[test]
fn errors_of_files() {
    let dir = tempfile::tempdir().unwrap();
    let message = |dir: &Path| Dataset::open(dir).unwrap_err().to_string();
    assert!(
        message(&dir.path().join("nowhere"))
            .ends_with("nowhere: not a folder; a dataset is a folder with transforms.json and its images")
    );
    assert!(message(dir.path()).contains("contains none of transforms.json"));
    std::fs::write(dir.path().join("transforms.json"), "{\n  \"w\": 8,\n  oops\n}").unwrap();
    assert!(message(dir.path()).contains("transforms.json: not valid JSON") && message(dir.path()).contains("line 3"));
    put(dir.path(), "transforms.json", &whole());
    let image = dir.path().join("images/b0_t1_v1.png");
    Image::filled(9, 8, [0; 3]).save_png(&image).unwrap();
    let dataset = Dataset::open(dir.path()).unwrap();
    let error = dataset.load_all_images().unwrap_err().to_string();
    assert!(
        error.ends_with("images/b0_t1_v1.png: frame 3 is 9x8 pixels, but its intrinsics (keys `w` and `h`) are 8x8"),
        "{error}"
    );
    assert!(
        dataset.load_image(8).unwrap_err().to_string().contains("frame 8 does not exist; the dataset has 8 frames")
    );
    std::fs::remove_file(image).unwrap();
    let error = message(dir.path());
    assert!(error.contains("frame 3 (images/b0_t1_v1.png): key `file_path`: there is no file"), "{error}");
}

/// Lens distortion, in the file or in one frame, is undone, with a note on a run's camera.
#[test]
fn distortion_is_a_warning() {
    let mut set = whole();
    set["k1"] = json!(0.05);
    let dataset = open(&set).unwrap();
    assert!(dataset.warnings()[0].contains("lens distortion (key `k1`) is undone in 8 of 8 images"));
    let mut set = whole();
    set["frames"][2]["p2"] = json!(0.01);
    let dataset = open(&set).unwrap();
    assert!(dataset.warnings()[0].contains("lens distortion (key `p2`) is undone in 1 of 8 images"));
    assert!(open(&whole()).unwrap().warnings().is_empty());
}

fn written_scenario() -> ScenarioInfo {
    let named_box = NamedBox {
        name: "actor".into(),
        role: Some("actor".into()),
        oriented_box: OrientedBox { center: [1.0, 2.0, 3.0], half_size: [2.0, 1.0, 0.5], yaw: 0.25 },
        dynamic: true,
    };
    ScenarioInfo {
        name: "written".into(),
        bounds: [[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]],
        branches: vec!["a".into(), "b".into()],
        timestamps: 1,
        step_s: None,
        bev_view: Some(1),
        states: vec![
            StateInfo { branch: 0, timestamp: 0, boxes: vec![named_box.clone()] },
            StateInfo { branch: 1, timestamp: 0, boxes: vec![] },
        ],
        candidates: vec![Candidate { branch: None, timestamp: Some(0), named_box: named_box.clone() }],
        static_boxes: vec![NamedBox { role: None, dynamic: false, ..named_box }],
        hazard_branches: vec![0],
        hazard_from_timestamp: 0,
        hazard_action: "halt".into(),
        clear_action: "advance".into(),
    }
}

/// Writes 2 branches x 1 time step x `views` views; `paint` makes the images.
fn write(dir: &Path, views: usize, paint: impl Fn(usize, usize) -> Image) {
    let writer = DatasetWriter::create(dir).unwrap();
    let mut records = Vec::new();
    for branch in 0..2 {
        for view in 0..views {
            let camera = PinholeCamera::look_at([1.0, view as f64, 4.0], [0.0; 3], [0.0, 0.0, 1.0], 8, 8, 60.0);
            let mut record = FrameRecord::new(format!("images/b{branch}_t0_v{view:03}.png"), camera);
            record.branch_and_timestamp = Some((branch, 0));
            record.view = Some(view);
            record.observability = Some(if view == 0 { Observability::None } else { Observability::Full });
            record.visible_fraction = Some(0.25);
            record.actor_px = Some(7);
            record.view_kind = Some(if view % 2 == 0 { "low" } else { "high" }.into());
            writer.write_image(&record.file_path, &paint(branch, view)).unwrap();
            records.push(record);
        }
    }
    writer.finish(&records, Some(&written_scenario())).unwrap();
}

/// The time step at which the hazard begins is read back.
#[test]
fn the_begin_of_the_hazard_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let writer = DatasetWriter::create(dir.path()).unwrap();
    let camera = PinholeCamera::look_at([1.0, 0.0, 4.0], [0.0; 3], [0.0, 0.0, 1.0], 8, 8, 60.0);
    writer.write_image("a.png", &Image::filled(8, 8, [9; 3])).unwrap();
    let record = |at| {
        let record = FrameRecord::new("a.png", camera);
        FrameRecord { branch_and_timestamp: Some(at), view: Some(0), ..record }
    };
    let records = [(0, 0), (0, 1), (1, 0), (1, 1)].map(record);
    let state = |branch, timestamp| StateInfo { branch, timestamp, boxes: vec![] };
    let states = vec![state(0, 0), state(0, 1), state(1, 0), state(1, 1)];
    let scenario =
        ScenarioInfo { timestamps: 2, hazard_from_timestamp: 1, bev_view: None, states, ..written_scenario() };
    writer.finish(&records, Some(&scenario)).unwrap();
    assert_eq!(Dataset::open(dir.path()).unwrap().scenario(), Some(&scenario));
}

/// A written dataset is read back: frames, cameras, scenario, images.
#[test]
fn written_sets_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    write(&set, 2, |branch, view| Image::filled(8, 8, [branch as u8, view as u8, 9]));
    let dataset = Dataset::open(&set).unwrap();
    assert_eq!(dataset.scenario(), Some(&written_scenario()));
    let frame = &dataset.frames()[3];
    assert_eq!((frame.state, frame.view, frame.actor_px), (Some(1), Some(1), Some(7)));
    assert_eq!(frame.visible_fraction, Some(0.25));
    let camera = PinholeCamera::look_at([1.0, 1.0, 4.0], [0.0; 3], [0.0, 0.0, 1.0], 8, 8, 60.0);
    assert_eq!(frame.camera, camera);
    assert_eq!(dataset.load_image(3).unwrap(), Image::filled(8, 8, [1, 1, 9]));
}

/// An interrupted run is not a dataset, and may be repeated; a folder with other files is refused and not changed.
#[test]
fn writing_is_all_or_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    write(&set, 2, |_, _| Image::filled(8, 8, [1; 3]));
    let writer = DatasetWriter::create(&set).unwrap();
    writer.write_image("images/x.png", &Image::filled(8, 8, [2; 3])).unwrap();
    drop(writer);
    assert!(Dataset::open(&set).unwrap_err().to_string().contains("contains none of transforms.json"));
    write(&set, 2, |_, _| Image::filled(8, 8, [3; 3]));
    assert!(!set.join("images/x.png").exists());
    assert_eq!(Dataset::open(&set).unwrap().frames().len(), 4);

    std::fs::write(dir.path().join("mine.txt"), "mine").unwrap();
    let error = DatasetWriter::create(dir.path()).unwrap_err().to_string();
    assert!(error.contains("not a dataset that this program wrote"), "{error}");
    assert!(DatasetWriter::create(&set).unwrap().write_image("../x.png", &Image::filled(8, 8, [2; 3])).is_err());
}

/// The report counts, pools errors, computes ceilings, and warns of a leak between hidden images only if there is one.
#[test]
fn report_and_leaks() {
    let dir = tempfile::tempdir().unwrap();
    for leak in [0_u8, 1] {
        let set = dir.path().join(format!("set{leak}"));
        // View 0 hides the actor: the branches differ by `leak` everywhere. View 1 shows it: they differ by 100.
        write(&set, 2, |branch, view| {
            let difference = if view == 0 { leak } else { 100 };
            Image::filled(8, 8, [50 + branch as u8 * difference; 3])
        });
        let dataset = Dataset::open(&set).unwrap();
        let images = dataset.load_all_images().unwrap();
        let equivalence = Equivalence::from_dataset(&dataset, &images);
        assert!(equivalence.same(0, 0, 1) && !equivalence.same(1, 0, 1));
        let report = DatasetReport::of(&dataset, &images);
        assert_eq!(report.counts[&(0, 0)], [1, 0, 1, 0]);
        assert_eq!(report.ceiling, Some(0.75));
        assert_eq!(report.ceiling_by_observability, [Some(1.0), None, Some(0.5)]);
        assert_eq!(report.hidden_pairs.len(), 1);
        assert_eq!(report.hidden_pairs[0].mean_difference, f64::from(leak));
        assert_eq!(report.warnings.len(), usize::from(leak));
        // The mean image of each pose is off by 50 in view 1 and by leak / 2 in view 0.
        let error = f64::midpoint(50.0_f64.powi(2), (f64::from(leak) / 2.0).powi(2));
        let expected = 10.0 * (255.0_f64.powi(2) / error).log10();
        assert!((report.pose_mean_psnr_db.unwrap() - expected).abs() < 1e-9);
        let text = report.to_string();
        assert!(text.contains("4 of 8x8 px") && text.contains("halt in a, else advance"), "{text}");
        assert_eq!(text.contains("warning:"), leak == 1, "{text}");
    }
}

/// The sheet has a row per state and a column per view, the bird's-eye view first, with borders by observability.
#[test]
fn sheet_layout() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path().join("set").as_path(), 5, |branch, view| Image::filled(8, 8, [branch as u8 * 100, view as u8, 0]));
    let dataset = Dataset::open(&dir.path().join("set")).unwrap();
    let images = dataset.load_all_images().unwrap();
    let sheet = contact_sheet(&dataset, &images, SheetOptions { columns: 3, max_rows: 9, gap_px: 2 });
    assert_eq!((sheet.rows.join("; "), sheet.pitch_px), ("a, t0; b, t0".to_owned(), [14, 14]));
    assert!(sheet.columns.len() == 3 && sheet.columns[0].starts_with("view 1"), "{:?}", sheet.columns);
    assert_eq!(sheet.frames.iter().map(|(colour, _)| *colour).collect::<Vec<_>>(), [[40, 160, 60], [205, 50, 45]]);
    let sheet = sheet.image;
    assert_eq!((sheet.width_px, sheet.height_px), (3 * 12 + 2 * 2, 2 * 12 + 2));
    assert_eq!(sheet.pixel(5, 5), Some([0, 1, 0]));
    assert_eq!(sheet.pixel(5, 14 + 5), Some([100, 1, 0]));
    assert_eq!(sheet.pixel(0, 0), Some([40, 160, 60]));
    assert_eq!(sheet.pixel(14, 0), Some([205, 50, 45]));
}

/// The split of a dataset keeps the bird's-eye view for training at every seed.
#[test]
fn split_of_a_set() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    write(&set, 20, |_, view| Image::filled(8, 8, [view as u8; 3]));
    let dataset = Dataset::open(&set).unwrap();
    for seed in 0..20 {
        let split = PoseSplit::for_dataset(&dataset, seed);
        assert_eq!(split.role(1), PoseRole::Rest);
        assert_eq!(split.views(PoseRole::Unseen).len(), 2);
        assert_eq!(split.views(PoseRole::Calibration).len(), 2);
        let kinds = split.views(PoseRole::Unseen).iter().map(|v| v % 2).sum::<usize>();
        assert_eq!(kinds, 1, "one of each kind");
    }
}

/// Datasets of outside engines are read completely, if they are available.
#[test]
fn outside_sets_if_at_hand() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    for (name, states) in [("blender-intersection", 6), ("blender-toy", 6), ("hand-reaching", 6)] {
        let dir = folder.join(name);
        if !dir.is_dir() {
            continue;
        }
        let dataset = Dataset::open(&dir).unwrap();
        assert_eq!((dataset.frames().len(), dataset.view_count(), dataset.state_count()), (600, 100, states));
        assert_eq!(dataset.load_image(599).unwrap().width_px, 128);
    }
}

/// A degraded copy has the states and poses of the original, other bytes, and as truth which states look the same. Its
/// images only show that through their noise, and so do they show the observability of a copy without it.
#[test]
fn degraded_copies_keep_the_truth() {
    use carff_dataset::{Degradation, degrade, sensor::SensorNoise};
    let folder = tempfile::tempdir().unwrap();
    let writer = DatasetWriter::create(&folder.path().join("clean")).unwrap();
    let camera = PinholeCamera::look_at([0.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 64, 64, 60.0);
    let mut records = Vec::new();
    for (branch, view) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let path = format!("images/b{branch}_v{view}.png");
        // From pose 0 the branches look the same.
        let mut image = Image::filled(64, 64, [90; 3]);
        for (x, y) in (0..64_u8).flat_map(|y| (0..64).map(move |x| (x, y))) {
            let shown = view == 1 && branch == 1 && (20..40).contains(&x) && (30..44).contains(&y);
            let grey = if shown { 230 } else { 80 + x / 9 % 2 * 40 + y / 16 % 2 * 20 };
            image.paste(&Image::filled(1, 1, [grey; 3]), u32::from(x), u32::from(y));
        }
        writer.write_image(&path, &image).unwrap();
        let record = FrameRecord::new(path, camera);
        records.push(FrameRecord { branch_and_timestamp: Some((branch, 0)), view: Some(view), ..record });
    }
    let scenario = ScenarioInfo {
        name: "two".into(),
        branches: vec!["there".into(), "gone".into()],
        timestamps: 1,
        bounds: [[-1.0; 3], [1.0; 3]],
        step_s: None,
        bev_view: None,
        states: [0, 1].map(|branch| StateInfo { branch, timestamp: 0, boxes: Vec::new() }).to_vec(),
        candidates: Vec::new(),
        static_boxes: Vec::new(),
        hazard_branches: vec![0],
        hazard_from_timestamp: 0,
        hazard_action: "halt".into(),
        clear_action: "advance".into(),
    };
    writer.finish(&records, Some(&scenario)).unwrap();
    let clean = Dataset::open(&folder.path().join("clean")).unwrap();
    let noise = SensorNoise { sigma: 8.0, ..SensorNoise::OFF };
    let out = folder.path().join("degraded");
    let degradation = Degradation { noise, pose_jitter_px: 1.0, one_state: false, seed: 1 };
    let count = degrade(&clean, &out, &degradation).unwrap();
    let copy = Dataset::open(&out).unwrap();
    let images = copy.load_all_images().unwrap();
    assert_eq!((count, copy.frames().len()), (4, 4));
    let exact = |dataset: &Dataset, images: &[Image]| Equivalence::from_images(dataset, images, ImageComparison::Exact);
    let (truth, seen) = (Equivalence::from_dataset(&copy, &images), exact(&copy, &images));
    assert!(truth.same(0, 0, 1) && !truth.same(1, 0, 1));
    assert!(!seen.same(0, 0, 1) && !seen.same(1, 0, 1));
    let original = clean.load_all_images().unwrap();
    assert_eq!(Equivalence::comparison(&copy, &images), ImageComparison::ThroughNoise);
    assert_eq!(Equivalence::comparison(&clean, &original), ImageComparison::Exact);
    assert_eq!(exact(&clean, &original), truth);
    assert_ne!(images[0], clean.load_image(0).unwrap());

    let file = out.join("transforms.json");
    let mut json: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    for frame in json["frames"].as_array_mut().unwrap() {
        frame.as_object_mut().unwrap().retain(|key, _| key != "observability" && key != "alike_states");
    }
    std::fs::write(&file, json.to_string()).unwrap();
    let untold = Dataset::open(&out).unwrap();
    assert_eq!(Equivalence::from_dataset(&untold, &images), truth);
    let seen: Vec<_> = untold.frames().iter().map(|frame| frame.observability.unwrap()).collect();
    assert_eq!(seen, [Observability::None, Observability::None, Observability::Full, Observability::Full]);

    // With one state of each pose, the truth still names the states without an image; stages refuse such a dataset.
    let out = folder.path().join("partial");
    assert_eq!(degrade(&clean, &out, &Degradation { one_state: true, ..degradation }).unwrap(), 2);
    let error = Dataset::open(&out).unwrap_err().to_string();
    assert!(error.contains("is missing in state") && error.contains("`carff train`"), "{error}");
    let partial = Dataset::open_partial(&out).unwrap();
    let mut found: Vec<_> = partial.frames().iter().map(|frame| (frame.view.unwrap(), frame.state.unwrap())).collect();
    found.sort_unstable();
    assert!([[(0, 0), (1, 1)], [(0, 1), (1, 0)]].iter().any(|wanted| found == wanted), "{found:?}");
    assert_eq!(Equivalence::from_dataset(&partial, &partial.load_all_images().unwrap()), truth);
    let (survey, faults) = Dataset::survey(&out).unwrap();
    let survey = survey.unwrap();
    assert!(faults.is_empty() && survey.warnings().iter().any(|w| w.starts_with("2 of 2 views are missing")));
    let images = survey.load_all_images().unwrap();
    assert_eq!(carff_dataset::DatasetReport::of(&survey, &images).ceiling, Some(0.75));
}
