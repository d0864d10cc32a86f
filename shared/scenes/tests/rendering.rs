//! Tests of scenarios and their images: determinism, geometry, occlusion, and error messages.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Dataset, Observability, drives::DriveKind};
use carff_scenes::{Detail, Extras, Scenario, ScenarioError};

/// A scenario with one block, half of which a wall hides from the camera at -Y. The sun is opposite the camera, so
/// shadows fall towards it.
const SMALL: &str = r##"
name = "small"
bounds_m = [[-3.0, -3.0, 0.0], [3.0, 3.0, 2.0]]
timestamps = 2
branches = ["with", "without"]
hazard_branches = ["with"]
bev_view = 0

[image]
width_px = 96
height_px = 80
fov_deg = 60.0

[sun]
azimuth_deg = 90.0
elevation_deg = 80.0

[[road]]
from = [-20.0, 0.0]
to = [20.0, 0.0]
width_m = 6.0

[[marking]]
from = [-20.0, 0.0]
to = [20.0, 0.0]
width_m = 0.3
dash_m = 1.0
gap_m = 1.0

[[building]]
name = "wall"
min = [-8.0, -4.0]
max = [0.0, -3.6]
height_m = 6.0
walls = "plaster"
colour = "#a0a0a0"

[[vehicle]]
name = "block"
role = "actor"
kind = "block"
colour = "#ff0000"
size_m = [2.0, 1.0, 1.0]
dynamic = true

[[vehicle.course]]
branches = ["with"]
poses = [[0.0, 0.0, 0.0], [-3.0, 0.0, 0.0]]

[[overhead]]
view_kind = "bev"
count = 3
center = [0.0, 0.0]
height_m = 12.0
spread_m = 2.0
"##;

fn small() -> Scenario {
    Scenario::parse("small.toml".as_ref(), SMALL).unwrap()
}

/// Returns a distant camera at -Y with a long lens, so that the projection of the wall's edge at x = 0 is almost
/// parallel.
fn front() -> PinholeCamera {
    PinholeCamera::look_at([0.0, -60.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0], 256, 128, 8.0)
}

fn in_pool<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// One thread, three threads and a second rendering give the same bytes.
#[test]
fn same_bytes_whatever_the_threads() {
    let scenario = small();
    let camera = scenario.cameras()[1].camera;
    let render = || scenario.render(0, 0, &camera, Detail::default()).unwrap();
    let one = in_pool(1, render);
    let three = in_pool(3, render);
    assert_eq!(one, three);
    assert_eq!(one, render());
}

/// Depth is the distance along the ray: on the ground, seen straight from above, it is height / cosine; on the block's
/// top it is less by the block's height.
#[test]
fn depth_agrees_with_the_planes() {
    let scenario = small();
    let camera = scenario.cameras()[0].camera;
    let rendering = scenario.render(0, 0, &camera, Detail::Image).unwrap();
    let block = scenario.object_of("block").unwrap();
    let (mut ground, mut top) = (0, 0);
    for y in 0..80_usize {
        for x in 0..96_usize {
            let cosine = -f64::from(camera.ray(x as f64 + 0.5, y as f64 + 0.5).direction[2]);
            let depth = f64::from(rendering.depth_m[y * 96 + x]);
            let object = rendering.object_id[y * 96 + x];
            if object == 1 {
                assert!((depth - 12.0 / cosine).abs() < 1e-3, "({x}, {y}): {depth}");
                ground += 1;
            } else if object == block && (depth - 11.0 / cosine).abs() < 1e-3 {
                top += 1;
            }
        }
    }
    // 2 m x 1 m at 11 m through a focal length of 83.1 px: 15.1 x 7.6 px.
    assert!(ground > 5000 && (98..=128).contains(&top), "{ground} {top}");
    assert!(rendering.actor.is_none());
}

/// A block whose left half is behind a wall is half visible, in both branches: if it is absent, its place counts. From
/// above it is fully visible.
#[test]
fn half_hidden_is_one_half() {
    let scenario = small();
    let options = Detail::default();
    let with = scenario.render(0, 0, &front(), options).unwrap().actor.unwrap();
    let without = scenario.render(1, 0, &front(), options).unwrap().actor.unwrap();
    assert_eq!(with, without);
    assert!((with.visible_fraction - 0.5).abs() < 0.03, "{with:?}");
    assert_eq!(with.observability, Observability::Partial);
    let above = scenario.render(1, 0, &scenario.cameras()[0].camera, options).unwrap().actor.unwrap();
    assert_eq!((above.visible_fraction, above.observability), (1.0, Observability::Full));
}

/// Parts outside the image count as not visible: a camera that cuts the block's place in two sees half of it.
#[test]
fn outside_the_image_is_not_visible() {
    let scenario = small();
    // From +Y, without a wall in between; rotated by half its field of view, so that x = 0 is the image's edge.
    let turn = 10.0_f64.to_radians();
    let camera =
        PinholeCamera::look_at([0.0, 40.0, 0.5], [40.0 * turn.tan(), 0.0, 0.5], [0.0, 0.0, 1.0], 256, 128, 20.0);
    let actor = scenario.render(0, 0, &camera, Detail::default()).unwrap().actor.unwrap();
    assert!((actor.visible_fraction - 0.5).abs() < 0.05, "{actor:?}");
}

/// Behind the wall the actor leaves no trace: the images with and without it are the same bytes, and the view is
/// `none`. From the other side the images differ.
#[test]
fn hidden_pairs_are_equal() {
    let scenario = small();
    let options = Detail::default();
    let with = scenario.render(0, 1, &front(), options).unwrap();
    let without = scenario.render(1, 1, &front(), options).unwrap();
    assert_eq!(with.image, without.image);
    assert_eq!(with.actor.unwrap().observability, Observability::None);
    assert_eq!(with.actor, without.actor);
    let behind = PinholeCamera::look_at([-3.0, 9.0, 2.0], [-3.0, 0.0, 0.5], [0.0, 0.0, 1.0], 96, 80, 60.0);
    let with = scenario.render(0, 1, &behind, options).unwrap();
    let without = scenario.render(1, 1, &behind, options).unwrap();
    assert_ne!(with.image, without.image);
}

/// A hidden actor with a visible shadow is not `none`, because the shadow reveals it. With a low sun behind it, the
/// shadow reaches past the end of the wall.
#[test]
fn a_visible_shadow_is_partial() {
    let low_sun = SMALL
        .replace("azimuth_deg = 90.0", "azimuth_deg = 165.0")
        .replace("elevation_deg = 80.0", "elevation_deg = 12.0");
    let scenario = Scenario::parse("small.toml".as_ref(), &low_sun).unwrap();
    let camera = PinholeCamera::look_at([0.0, -20.0, 2.5], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0], 96, 80, 40.0);
    let with = scenario.render(0, 1, &camera, Detail::default()).unwrap();
    let without = scenario.render(1, 1, &camera, Detail::default()).unwrap();
    assert_eq!(with.actor.unwrap().actor_px, 0);
    assert_ne!(with.image, without.image);
    assert_eq!(with.actor.unwrap().observability, Observability::Partial);
    assert_eq!(without.actor.unwrap().observability, Observability::Partial);
}

/// Objects have the right colours: the block is red, the marking is brighter than the asphalt, the sky is blue.
#[test]
fn colours_are_plausible() {
    let scenario = small();
    let rendering = scenario.render(0, 0, &scenario.cameras()[0].camera, Detail::default()).unwrap();
    let [r, g, b] = rendering.image.pixel(48, 40).unwrap();
    assert!(r > 120 && g < 80 && b < 80, "{r} {g} {b}");
    let brightest = (0..96).map(|x| rendering.image.pixel(x, 40).unwrap()[1]).max().unwrap();
    let asphalt = rendering.image.pixel(60, 48).unwrap()[1];
    assert!(brightest > asphalt + 60, "{brightest} {asphalt}");
    let up = PinholeCamera::look_at([0.0, 0.0, 2.0], [1.0, 0.0, 2.6], [0.0, 0.0, 1.0], 16, 16, 30.0);
    let sky = scenario.render(1, 0, &up, Detail::default()).unwrap();
    assert!(sky.object_id.iter().all(|id| *id == 0) && sky.depth_m.iter().all(|d| d.is_infinite()));
    let [r, _, b] = sky.image.pixel(8, 8).unwrap();
    assert!(b > r + 20);
}

/// A rendered dataset is read back with the scenario's states, candidates and cameras; depth and masks match the
/// images. A stopped run leaves no dataset.
#[test]
fn rendered_sets_are_read() {
    let scenario = small();
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let stopped = scenario.render_dataset(&out, Extras::None, |done, total| {
        assert!(done <= total && total == 12);
        ControlFlow::Break(())
    });
    assert!(matches!(stopped, Err(ScenarioError::Stopped)));
    assert!(Dataset::open(&out).is_err());

    scenario.render_dataset(&out, Extras::DepthAndMasks, |_, _| ControlFlow::Continue(())).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.scenario(), Some(scenario.info()));
    assert_eq!((dataset.frames().len(), dataset.view_count()), (12, 3));
    let info = scenario.info();
    assert_eq!(info.states[0].boxes[0].oriented_box.center, [0.0, 0.0, 0.5]);
    assert!(info.states[2].boxes.is_empty());
    assert_eq!(info.candidates.iter().map(|c| c.timestamp).collect::<Vec<_>>(), [Some(0), Some(1)]);
    assert_eq!(info.static_boxes[0].name, "wall");
    let frame = &dataset.frames()[4];
    assert_eq!((frame.branch, frame.timestamp, frame.view), (Some(0), Some(1), Some(1)));
    let rendering = scenario.render(0, 1, &scenario.cameras()[1].camera, Detail::default()).unwrap();
    assert_eq!(dataset.load_image(4).unwrap(), rendering.image);
    assert_eq!(frame.actor_px, Some(rendering.actor.unwrap().actor_px));
    let text = std::fs::read_to_string(out.join("transforms.json")).unwrap();
    assert!(text.contains("\"depth_file_path\":\"depth/b0_t1_v001.png\"") && text.contains("\"role\":\"actor\""));
    let mask = carff_dataset::Image::load(&out.join("masks/b0_t1_v001.png")).unwrap();
    let block = scenario.object_of("block").unwrap();
    let expected = rendering.object_id.iter().filter(|id| **id == block).count();
    assert!(expected > 0 && mask.rgb.chunks(3).filter(|p| p[0] == 255).count() == expected);
}

/// An interrupted rendering, even in the middle of a note, continues with the remaining cameras and ends with the same
/// files as an uninterrupted one. A rendering of another kind starts again.
#[test]
fn an_interrupted_rendering_goes_on() {
    let scenario = small();
    let dir = tempfile::tempdir().unwrap();
    let [straight, halting] = ["straight", "halting"].map(|name| dir.path().join(name));
    let rendered = |out: &Path, extras: Extras, last: usize| -> Result<usize, ScenarioError> {
        let calls = AtomicUsize::new(0);
        let result = scenario.render_dataset(out, extras, |done, _| {
            calls.fetch_add(1, Ordering::Relaxed);
            if done >= last { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        result.map(|()| calls.into_inner())
    };
    assert_eq!(rendered(&straight, Extras::None, usize::MAX).unwrap(), 12);
    // Three cameras of four images: ten images contain all images of one camera only.
    assert!(rendered(&halting, Extras::None, 10).is_err());
    let notes = halting.join("unfinished.jsonl");
    let whole = std::fs::read_to_string(&notes).unwrap();
    let finished = whole.lines().count() - 1;
    assert!(finished >= 1, "{whole}");
    std::fs::write(&notes, whole + "{\"view\":0,\"act").unwrap();
    assert_eq!(rendered(&halting, Extras::None, usize::MAX).unwrap(), 12 - 4 * finished);
    assert!(!notes.exists());
    let files = |out: &Path| {
        let images = std::fs::read_dir(out.join("images")).unwrap().map(|e| e.unwrap().path());
        let mut files: Vec<PathBuf> = images.chain([out.join("transforms.json")]).collect();
        files.sort();
        files.into_iter().map(|f| (f.file_name().unwrap().to_owned(), std::fs::read(f).unwrap())).collect::<Vec<_>>()
    };
    assert!(files(&straight) == files(&halting), "the datasets differ");

    assert!(rendered(&halting, Extras::None, 10).is_err());
    assert_eq!(rendered(&halting, Extras::DepthAndMasks, usize::MAX).unwrap(), 12);
}

/// Cameras and states that do not exist are errors.
#[test]
fn bad_requests() {
    let scenario = small();
    let mut camera = scenario.cameras()[0].camera;
    let error = scenario.render(2, 0, &camera, Detail::default()).unwrap_err().to_string();
    assert_eq!(error, "there is no branch 2 at timestamp 0; the scenario has 2 x 2");
    camera.fl_x_px = f64::NAN;
    let error = scenario.render(0, 0, &camera, Detail::default()).unwrap_err().to_string();
    assert_eq!(error, "the camera is not usable: `fl_x` must be finite");
}

/// Each error in a scenario file is reported with file, line and key.
#[test]
fn golden_errors() {
    for (from, to, expected) in [
        (
            "timestamps = 2",
            "timestamp = 2",
            &["small.toml: TOML parse error at line 4, column 1", "unknown field `timestamp`", "`timestamps`"][..],
        ),
        ("timestamps = 2", "timestamps = 0", &["line 4", "0 is out of range; a whole number from 1 to 64 is allowed"]),
        (
            "width_m = 6.0",
            "width_m = -6.0",
            &["line 21", "width_m = -6.0", "-6 is out of range; a length from 0.001 to 10000 is allowed"],
        ),
        ("width_m = 6.0", "width_m = nan", &["line 21", "out of range"]),
        ("\"#ff0000\"", "\"red\"", &["line 42", "`red` is not a colour; write `#rrggbb`"]),
        ("kind = \"block\"", "kind = \"tank\"", &["line 41", "unknown variant `tank`", "`pickup`"]),
        ("from = [-20.0, 0.0]", "from = [-20.0]", &["line 19", "invalid length 1"]),
        (
            "\nbranches = [\"with\"]\n",
            "\nbranches = [\"whit\"]\n",
            &["small.toml:47: key `branches`: there is no branch `whit`; there are `with`, `without`"],
        ),
        (
            "hazard_branches = [\"with\"]",
            "hazard_branches = [\"none\"]",
            &["small.toml:6: key `hazard_branches`: there is no branch `none`; there are `with`, `without`"],
        ),
        (
            ", [-3.0, 0.0, 0.0]]",
            "]",
            &["small.toml:48: key `poses`: 1 poses; one for each of the 2 timestamps is needed"],
        ),
        (
            "hazard_branches = [\"with\"]",
            "hazard_branches = [\"with\"]\nhazard_from_timestamp = 2",
            &["small.toml:7: key `hazard_from_timestamp`: is 2, but the time steps are 0 to 1"],
        ),
        ("bev_view = 0", "bev_view = 3", &["small.toml:7: key `bev_view`: is 3, but there are 3 cameras"]),
        (
            "min = [-8.0, -4.0]",
            "min = [8.0, -4.0]",
            &["small.toml:30: key `building`: `min` [8.0, -4.0] must be below `max` [0.0, -3.6] along both axes"],
        ),
        (
            "branches = [\"with\", \"without\"]",
            "branches = [\"with\", \"with\"]",
            &["small.toml:5: key `branches`: `with` is named twice"],
        ),
    ] {
        assert!(SMALL.contains(from), "{from}");
        let error = Scenario::parse("small.toml".as_ref(), &SMALL.replacen(from, to, 1)).unwrap_err().to_string();
        for part in expected {
            assert!(error.contains(part), "{to}: expected `{part}` in\n{error}");
        }
    }
    let error = Scenario::load("nowhere.toml".as_ref()).unwrap_err().to_string();
    assert!(error.starts_with("nowhere.toml: "), "{error}");
}

/// The shipped scenario matches the paper's dataset: two branches, three time steps, a hundred poses, and one
/// bird's-eye view straight down at 50 that sees every place of actor and ego. No camera is inside a box.
#[test]
fn the_shipped_scenario() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios/approaching-intersection.toml");
    let scenario = Scenario::load(&path).unwrap();
    let info = scenario.info();
    assert_eq!((info.branches.len(), info.timestamps, info.bev_view), (2, 3, Some(50)));
    assert_eq!(info.hazard_branches, [0]);
    assert_eq!(info.candidates.len(), 3);
    assert_eq!(scenario.cameras().len(), 100);
    let bev = scenario.cameras()[50].camera;
    assert!((bev.ray(64.0, 64.0).direction[2] + 1.0).abs() < 1e-6);
    for state in &info.states {
        for named in &state.boxes {
            for corner in 0..8 {
                let side = |axis: usize| if corner >> axis & 1 == 1 { 1.0 } else { -1.0 };
                let corner = named.oriented_box.point([side(0), side(1), side(2)]);
                let ([x, y], _) = bev.project(corner).unwrap();
                assert!((0.0..=128.0).contains(&x) && (0.0..=128.0).contains(&y), "{} {x} {y}", named.name);
            }
            for camera in scenario.cameras() {
                assert!(!named.oriented_box.contains(camera.camera.position_m()));
            }
        }
    }
    for camera in scenario.cameras() {
        assert!(info.static_boxes.iter().all(|b| !b.oriented_box.contains(camera.camera.position_m())));
    }
}

fn shipped(name: &str) -> Scenario {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios");
    Scenario::load(&folder.join(name).with_extension("toml")).unwrap()
}

/// Every shipped scenario has a training and a graph file of its name, a hundred poses outside all boxes, and a
/// bird's-eye view straight down that sees the centre of every moving box.
#[test]
fn every_shipped_scenario_is_whole() {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    let mut names = Vec::new();
    for entry in std::fs::read_dir(configs.join("scenarios")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let scenario = Scenario::load(&path).unwrap();
        let info = scenario.info();
        assert_eq!(info.name, name);
        for folder in ["training", "graphs"] {
            assert!(configs.join(folder).join(&name).with_extension("toml").is_file(), "{folder} of {name}");
        }
        assert_eq!(scenario.cameras().len(), 100, "{name}");
        let bev = scenario.cameras()[info.bev_view.unwrap()].camera;
        let (w, h) = (f64::from(bev.width_px), f64::from(bev.height_px));
        assert!((bev.ray(w / 2.0, h / 2.0).direction[2] + 1.0).abs() < 1e-6, "{name}");
        for named in info.states.iter().flat_map(|s| &s.boxes) {
            let ([x, y], _) = bev.project(named.oriented_box.center).unwrap();
            assert!((0.0..=w).contains(&x) && (0.0..=h).contains(&y), "{name}: {} at {x} {y}", named.name);
            let inside = |c: &carff_scenes::ScenarioCamera| named.oriented_box.contains(c.camera.position_m());
            assert!(!scenario.cameras().iter().any(inside), "{name}: {}", named.name);
        }
        for still in &info.static_boxes {
            let inside = |c: &carff_scenes::ScenarioCamera| still.oriented_box.contains(c.camera.position_m());
            assert!(!scenario.cameras().iter().any(inside), "{name}: {}", still.name);
        }
        names.push(name);
    }
    names.sort();
    let expected = [
        "approaching-intersection",
        "hand-reaching",
        "open-branch-intersection",
        "single-approaching-intersection",
        "toy",
        "two-lane-merge",
    ];
    assert_eq!(names, expected);
}

/// In the open-branch scenario the truck looks the same in three branches at the first two time steps, and stands
/// elsewhere in each of them afterwards. The hazard begins at the last time step.
#[test]
fn branches_open_after_the_look() {
    let scenario = shipped("open-branch-intersection");
    let info = scenario.info();
    let boxes = |branch: usize, timestamp: usize| &info.states[info.state(branch, timestamp).unwrap()].boxes;
    assert_eq!((info.branches.len(), &info.hazard_branches[..], info.hazard_from_timestamp), (4, &[0][..], 3));
    for timestamp in 0..4 {
        let equal = boxes(0, timestamp) == boxes(1, timestamp) && boxes(0, timestamp) == boxes(2, timestamp);
        assert_eq!(equal, timestamp < 2, "time step {timestamp}");
        assert_ne!(boxes(0, timestamp), boxes(3, timestamp));
    }
    let full = Some(Observability::Full);
    let kinds = |timestamp| [0, 1, 2, 3].map(|branch| info.trial_kind(branch, timestamp, full).map(DriveKind::name));
    assert_eq!(kinds(1), [Some("hazard"), None, None, Some("clear")]);
    assert_eq!(kinds(2), [None, Some("clear"), Some("clear"), Some("clear")]);
}

/// Each scenario has views of the first time step that show the actor fully, and views that hide it completely.
#[test]
fn every_shipped_scenario_has_seeing_and_blind_views() {
    for name in
        ["approaching-intersection", "hand-reaching", "single-approaching-intersection", "toy", "two-lane-merge"]
    {
        let scenario = shipped(name);
        let mut seen = Vec::new();
        for camera in scenario.cameras().iter().step_by(4) {
            let camera = camera.camera.resized(48, 48);
            seen.push(scenario.render(0, 0, &camera, Detail::default()).unwrap().actor.unwrap().observability);
        }
        for wanted in [Observability::Full, Observability::None] {
            assert!(seen.iter().filter(|o| **o == wanted).count() >= 3, "{name}: {wanted:?} among {seen:?}");
        }
    }
}

/// If a branch is undecided at the first time step, both branches are one state and one image there, and two
/// afterwards.
#[test]
fn undecided_first_timestamps_look_the_same() {
    for name in ["two-lane-merge", "toy", "hand-reaching"] {
        let scenario = shipped(name);
        let info = scenario.info();
        let last = info.timestamps - 1;
        let boxes = |branch: usize, timestamp: usize| &info.states[branch * info.timestamps + timestamp].boxes;
        assert_eq!(boxes(0, 0), boxes(1, 0), "{name}");
        assert_ne!(boxes(0, last), boxes(1, last), "{name}");
        let options = Detail::Image;
        let mut differing = 0;
        for camera in scenario.cameras().iter().step_by(10) {
            let camera = camera.camera.resized(48, 48);
            let image = |b: usize, t: usize| scenario.render(b, t, &camera, options).unwrap().image;
            assert_eq!(image(0, 0), image(1, 0), "{name}");
            differing += usize::from(image(0, last) != image(1, last));
        }
        assert!(differing >= 5, "{name}: {differing}");
    }
}

/// An object consists of its parts and those of its current variant, at the pose of its course. A follower shares the
/// actor's presence. An object without a course is a static box.
#[test]
fn objects_are_data() {
    let text = r##"
name = "objects"
bounds_m = [[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]
timestamps = 2
branches = ["there", "gone"]
image = { width_px = 64, height_px = 64, fov_deg = 40.0 }
ground_surface = "plain"
ground_colour = "#808080"
clearance_m = 0.05

[[object]]
name = "dice"
role = "actor"
dynamic = true

[[object.box]]
center = [0.0, 0.0, 0.1]
size_m = [0.2, 0.2, 0.2]
colour = "#000000"
faces = { colours = ["#ff0000", "#00ff00", "#0000ff", "#ffff00", "#ff00ff", "#ffffff"] }

[[object.capsule]]
variants = ["tall"]
from = [0.0, 0.0, 0.2]
to = [0.0, 0.0, 0.5]
radius_m = 0.05
colour = "#00ffff"

[[object.course]]
branches = ["there"]
poses = [[0.0, 0.0, 0.0, 0.0], [0.4, 0.0, 0.1, 90.0]]
variants = ["tall", "tall"]

[[object]]
name = "tail"
role = "tail"
follows = "dice"

[[object.ellipsoid]]
center = [-0.4, 0.0, 0.1]
size_m = [0.1, 0.1, 0.1]
colour = "#ff8800"

[[object.course]]
branches = ["there"]
poses = [[0.0, 0.0, 0.0, 0.0], [0.4, 0.0, 0.1, 90.0]]

[[object]]
name = "post"
role = "static"
at = [0.0, 0.6, 0.0, 0.0]

[[object.cylinder]]
from = [0.0, 0.0, 0.0]
to = [0.0, 0.0, 0.4]
radius_m = 0.03
colour = "#404040"

[[overhead]]
view_kind = "bev"
count = 1
center = [0.0, 0.0]
height_m = 3.0
spread_m = 0.0
"##;
    let scenario = Scenario::parse("objects.toml".as_ref(), text).unwrap();
    let info = scenario.info();
    let dice = &info.states[0].boxes[0].oriented_box;
    assert_eq!((dice.center, dice.half_size), ([0.0, 0.0, 0.275], [0.1, 0.1, 0.275]));
    let moved = &info.states[1].boxes[0].oriented_box;
    assert!((moved.center[0] - 0.4).abs() < 1e-6 && (moved.center[2] - 0.375).abs() < 1e-6);
    let tail = &info.states[1].boxes[1].oriented_box;
    assert!((tail.center[0] - 0.4).abs() < 1e-6 && (tail.center[1] + 0.4).abs() < 1e-6, "{tail:?}");
    assert!(info.states[2].boxes.is_empty());
    assert_eq!(info.static_boxes.iter().map(|b| b.name.as_str()).collect::<Vec<_>>(), ["post"]);

    // From -X the side -X is visible, green, with the capsule on top; 90 degrees to the left, the side +Y, blue.
    let camera = PinholeCamera::look_at([-3.0, 0.0, 0.3], [0.0, 0.0, 0.3], [0.0, 0.0, 1.0], 64, 64, 20.0);
    let image = |t: usize| scenario.render(0, t, &camera, Detail::default()).unwrap();
    let below = |image: &carff_dataset::Image, z: f64| image.pixel(32, (32.0 - (z - 0.3) * 60.5) as u32).unwrap();
    let before = image(0).image;
    let [r, g, b] = below(&before, 0.17);
    assert!(g > 60 && r < g / 2 && b < g / 2, "{r} {g} {b}");
    let [r, g, b] = below(&before, 0.45);
    assert!(g > 60 && b > 60 && r < g / 2, "{r} {g} {b}");
    let [r, g, b] = below(&image(1).image, 0.22);
    assert!(b > 60 && r < b / 2 && g < b / 2, "{r} {g} {b}");

    // A view that only sees the tail is not blind: the image without the actor lacks the tail too.
    let tail_alone = PinholeCamera::look_at([-0.4, 0.0, 1.0], [-0.4, 0.0, 0.0], [0.0, 1.0, 0.0], 64, 64, 15.0);
    let view = scenario.render(0, 0, &tail_alone, Detail::default()).unwrap();
    assert_eq!(view.actor.unwrap().actor_px, 0);
    assert_eq!(view.actor.unwrap().observability, Observability::Partial);

    for (from, to, expected) in [
        ("variants = [\"tall\", \"tall\"]", "variants = [\"tall\", \"wide\"]", "no part has the variant `wide`"),
        ("variants = [\"tall\", \"tall\"]", "variants = [\"tall\"]", "1 variants; one for each of the 2 timestamps"),
        ("follows = \"dice\"", "follows = \"post\"", "key `follows`: `post` is not another, dynamic"),
        ("name = \"post\"", "name = \"tail\"", "`tail` is named twice"),
        ("size_m = [0.1, 0.1, 0.1]", "size_m = [0.1, 0.0, 0.1]", "0.001 to 10000 is allowed"),
    ] {
        assert!(text.contains(from), "{from}");
        let error = Scenario::parse("o.toml".as_ref(), &text.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(error.contains(expected), "{to}: {error}");
    }
}
