//! Closed-loop drives: episodes, boxes and images, without processes.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_scenes::{ClosedLoop, Extras, Scenario};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

fn file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios/approaching-intersection.toml")
}

fn drives() -> ClosedLoop {
    on_route("cross")
}

fn on_route(name: &str) -> ClosedLoop {
    ClosedLoop::new(Scenario::load(&file()).unwrap(), Some(name)).unwrap()
}

/// An episode only depends on its number and the seed; starts and speeds are continuous and within their ranges, and no
/// vehicle ever meets the one ahead of it.
#[test]
fn episodes_are_drawn() {
    let drives = drives();
    let mut counts = [0; 4];
    let mut starts = Vec::new();
    for number in 0..60 {
        let episode = drives.episode(number, 5, None);
        assert_eq!(episode, drives.episode(number, 5, None));
        counts[episode.actor_count()] += 1;
        let (start, later) = (drives.actor_boxes(&episode, 0.0), drives.actor_boxes(&episode, 10.0));
        starts.extend(start.first().map(|b| b.center[0]));
        for (from, to) in start.iter().zip(&later) {
            assert!((30.0 - 1e-9..=50.0 + 1e-9).contains(&(to.center[0] - from.center[0])), "{from:?} {to:?}");
        }
        for boxes in [start, later] {
            assert!(boxes.windows(2).all(|pair| pair[0].gap_m(&pair[1]) >= 3.0 - 1e-9), "{boxes:?}");
        }
    }
    assert!(counts[..3].iter().all(|n| *n > 5) && counts[3] == 0, "{counts:?}");
    starts.sort_by(f64::total_cmp);
    starts.dedup();
    assert!(starts.len() > 30, "every start is a draw of its own");
    assert_ne!(drives.episode(0, 5, Some(2)), drives.episode(0, 6, Some(2)));
    assert_eq!(drives.episode(0, 5, Some(3)).actor_count(), 3);
}

/// The ego is in the way of others between the two ends of the conflict, and keeps its space to their lane outside.
#[test]
fn the_conflict_is_where_the_ways_meet() {
    let drives = drives();
    let [enter_m, leave_m] = drives.conflict_m();
    assert!(0.0 < enter_m && enter_m < leave_m && leave_m < drives.length_m() + 1e-9, "{enter_m} {leave_m}");
    let space_m = drives.config().space_m;
    // The lane of the others: 1.95 m wide about y = -1.9.
    let gap_m = |at_m: f64| -1.9 - 1.95 / 2.0 - (drives.ego_box(at_m).center[1] + 4.1 / 2.0);
    assert!((gap_m(enter_m) - space_m).abs() < 0.06, "{}", gap_m(enter_m));
}

/// A vehicle that merges is in the way of others up to the end of its route, and moves along their lane; one that crosses
/// the lane does not. Nobody who comes on the merge's lane is slower than the ego.
#[test]
fn a_merge_ends_on_the_lane() {
    assert_eq!((drives().along_conflict_m(), drives().crossing_m()[0]), (0.0, 1.8));
    let merge = on_route("merge");
    let ([enter_m, leave_m], [x, y]) = (merge.conflict_m(), merge.crossing_m());
    assert!((merge.length_m() - leave_m).abs() < 0.06 && x == 1.8 && y < -6.0, "{leave_m} {x} {y}");
    // The ego ends at x = 11, and is 4.1 m long.
    assert!((merge.along_conflict_m() - (11.0 - 4.1 / 2.0 - x)).abs() < 0.06, "{}", merge.along_conflict_m());
    assert!(merge.along_conflict_m() < leave_m - enter_m);
    assert!(merge.config().actor_speed_mps[0] >= merge.config().speed_mps);
}

/// The ego's camera sees the others where they are: an image differs from that of an empty road while one is in sight.
#[test]
fn images_show_the_others() {
    let drives = drives();
    let (one, none) = (drives.episode(1, 5, Some(1)), drives.episode(1, 5, Some(0)));
    assert_eq!(drives.camera(&none, 9.0).width_px, 128);
    let at_line_m = drives.conflict_m()[0] - 0.6;
    let middle = (0..400)
        .map(|i| f64::from(i) / 10.0)
        .find(|time_s| drives.actor_boxes(&one, *time_s).iter().all(|b| b.center[0] > -9.0));
    let camera = drives.camera(&one, at_line_m);
    let image = |episode, time_s| drives.image_from(episode, at_line_m, time_s, &camera);
    assert_ne!(image(&one, middle.unwrap()), image(&none, middle.unwrap()));
    assert_eq!(image(&one, 300.0), image(&none, 300.0), "long gone");
}

/// Training cameras are on the ego's roof, anywhere up to one metre behind the stop line, and the same arguments give the
/// same ones. The ego is at the camera in the images of every state: states without the actor look the same, and those
/// with the actor do not.
#[test]
fn training_cameras_follow_the_way() {
    let cameras = drives().with_training_cameras(60, 3).unwrap().cameras().to_vec();
    assert_eq!(cameras, drives().with_training_cameras(60, 3).unwrap().cameras());
    assert_ne!(cameras, drives().with_training_cameras(60, 4).unwrap().cameras());
    let mut places: Vec<f64> = Vec::new();
    for camera in &cameras {
        let ([x, y, yaw], at) = (camera.ego_pose.unwrap(), camera.camera.position_m());
        assert!(x == 1.8 && (yaw - std::f64::consts::FRAC_PI_2).abs() < 1e-9, "{x} {yaw}");
        assert!((-0.3..=0.6).contains(&(at[1] - y)) && (1.85..=2.3).contains(&at[2]), "{at:?} {y}");
        places.push(y);
    }
    places.sort_by(f64::total_cmp);
    let end = -16.2 + drives().conflict_m()[0] + 1.0;
    assert!(places[0] < -15.2 && (end - 1.0..end).contains(&places[59]), "{places:?}");
    assert!(places.windows(2).all(|pair| pair[1] - pair[0] < 1.5), "{places:?}");

    let dir = tempfile::tempdir().unwrap();
    let scenario = drives().with_training_cameras(3, 3).unwrap();
    assert_eq!(scenario.info().bev_view, None);
    scenario.render_dataset(dir.path(), Extras::None, |_, _| ControlFlow::Continue(())).unwrap();
    let image = |branch: usize, timestamp: usize, view: usize| {
        std::fs::read(dir.path().join(format!("images/b{branch}_t{timestamp}_v00{view}.png"))).unwrap()
    };
    assert!((0..3).all(|view| image(1, 0, view) == image(1, 1, view) && image(1, 1, view) == image(1, 2, view)));
    assert!((0..3).any(|view| image(0, 0, view) != image(0, 2, view)));
}

/// A scenario without closed-loop drives, and one whose ego never meets the others, are refused with the reason.
#[test]
fn what_cannot_be_driven_is_refused() {
    let text = std::fs::read_to_string(file()).unwrap();
    let refused = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        let scenario = Scenario::parse(&file(), &text.replace(from, to));
        scenario.and_then(|scenario| ClosedLoop::new(scenario, None)).unwrap_err().to_string()
    };
    assert!(refused("[closed_loop]", "[closed_lop]").contains("closed_lop"));
    assert!(
        refused("path = [[1.8, -16.2], [1.8, 2.2]]", "path = [[1.8, -36.2], [1.8, -26.2]]").contains("never meets")
    );
    assert!(refused("path = [[1.8, -16.2], [1.8, 2.2]]", "path = [[1.8, -16.2]]").contains("2 to 64"));
    assert!(refused("actors = [0, 2]", "actors = [2, 0]").contains("lowest"));
    assert!(refused("actors = [0, 2]", "actors = [0, 9]").contains("0 to 3"));
    assert!(refused("speed_mps = 5.0", "speed_mps = 0.0").contains("0.1"));
    assert!(refused("name = \"merge\"", "name = \"cross\"").contains("`cross` is named twice"));
    let unknown = ClosedLoop::new(Scenario::load(&file()).unwrap(), Some("crosss")).unwrap_err().to_string();
    assert!(unknown.contains("did you mean") && unknown.contains("cross"), "{unknown}");
    let toy = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios/toy.toml");
    let one_table = std::fs::read_to_string(&toy).unwrap() + "\n[closed_loop]\nspeed_mps = 5.0\n";
    let one_table = Scenario::parse(&toy, &one_table).unwrap_err().to_string();
    assert!(one_table.contains("`[[closed_loop]]`, each with a `name`"), "{one_table}");
    let toy = ClosedLoop::new(Scenario::load(&toy).unwrap(), None).unwrap_err().to_string();
    assert!(toy.contains("closed_loop"), "{toy}");
}
