//! Tests of free drives: smooth motion, new poses, reproducible frames, and correct truth.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::path::Path;

use carff_base::geometry::PinholeCamera;
use carff_dataset::Observability;
use carff_dataset::drives::DriveKind;
use carff_scenes::{Detail, Scenario};

const FRAMES: usize = 6;

fn shipped(name: &str) -> Scenario {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios");
    Scenario::load(&folder.join(name).with_extension("toml")).unwrap()
}

/// Returns the distance of the positions, metres, and the angle between the lines of sight, radians.
fn apart(a: &PinholeCamera, b: &PinholeCamera) -> (f64, f64) {
    let (p, q) = (a.position_m(), b.position_m());
    let distance = (0..3).map(|i| (p[i] - q[i]).powi(2)).sum::<f64>().sqrt();
    let cosine: f64 = (0..3).map(|i| a.world_from_camera[i][2] * b.world_from_camera[i][2]).sum();
    (distance, cosine.clamp(-1.0, 1.0).acos())
}

/// Seed, drive and frame determine bytes, pose and truth of a frame, independent of earlier renderings. Another seed or
/// number gives another drive.
#[test]
fn frames_are_named_by_seed_drive_and_frame() {
    let scenario = shipped("approaching-intersection");
    let drive = scenario.free_drive(3, FRAMES, 1).unwrap();
    let frames: Vec<_> = (0..drive.frame_count()).map(|frame| scenario.free_frame(&drive, frame).unwrap()).collect();
    assert_eq!(frames.len(), 3 * FRAMES);
    let again = shipped("approaching-intersection");
    let drive_again = again.free_drive(3, FRAMES, 1).unwrap();
    assert_eq!(drive, drive_again);
    for frame in [7, 2, 17] {
        assert_eq!(frames[frame], again.free_frame(&drive_again, frame).unwrap());
    }
    assert_ne!(drive, scenario.free_drive(3, FRAMES, 2).unwrap());
    assert_ne!(drive, scenario.free_drive(5, FRAMES, 1).unwrap());
    let error = scenario.free_frame(&drive, 3 * FRAMES).unwrap_err().to_string();
    assert!(error.contains("timestamp 3"), "{error}");
}

/// A camera moves from frame to frame, but by little. No pose equals one of the hundred fixed poses or a training pose
/// of the encoder. The last frame of each time step is marked.
#[test]
fn poses_are_smooth_and_new() {
    let scenario = shipped("approaching-intersection");
    let trained = shipped("approaching-intersection").with_free_cameras(400, 11).unwrap();
    let known: Vec<PinholeCamera> =
        scenario.cameras().iter().chain(trained.cameras()).map(|camera| camera.camera).collect();
    for number in 0..4 {
        let drive = scenario.free_drive(number, FRAMES, 1).unwrap();
        let frames: Vec<_> =
            (0..drive.frame_count()).map(|frame| scenario.free_frame(&drive, frame).unwrap()).collect();
        for (i, frame) in frames.iter().enumerate() {
            assert_eq!((frame.timestamp, frame.last_of_timestamp), (i / FRAMES, i % FRAMES == FRAMES - 1));
            for pose in &known {
                let (distance_m, angle) = apart(&frame.camera, pose);
                assert!(distance_m > 1e-4 || angle > 1e-4, "drive {number} frame {i} is a known pose");
            }
        }
        for pair in frames.windows(2) {
            let (distance_m, angle) = apart(&pair[0].camera, &pair[1].camera);
            // The ego moves 3 m in a time step of six frames; sway is added.
            assert!(distance_m < 0.75 && angle < 0.05, "drive {number}: {distance_m} m, {angle} rad");
            assert!(distance_m > 1e-3, "drive {number} does not move");
        }
        if drive.kind() == DriveKind::Hazard {
            assert_eq!(drive.view_kind(), "dash");
            let (distance_m, _) = apart(&frames[0].camera, &frames[frames.len() - 1].camera);
            assert!(distance_m > 5.0, "the ego moves: {distance_m} m");
        }
    }
}

/// Hazard and clear trials alternate. A hazard trial is of a hazard branch and hides the actor completely; a clear
/// trial is of another branch and shows its whole place. A rendering of the state from the same pose confirms it.
#[test]
fn the_truth_is_true() {
    let scenario = shipped("approaching-intersection");
    for number in 0..8 {
        let drive = scenario.free_drive(number, FRAMES, 5).unwrap();
        let hazard = number % 2 == 0;
        assert_eq!(drive.kind(), if hazard { DriveKind::Hazard } else { DriveKind::Clear });
        assert_eq!(scenario.info().is_hazard(drive.branch()), hazard);
        let frame = scenario.free_frame(&drive, drive.decisive_frame()).unwrap();
        assert!(frame.last_of_timestamp && frame.timestamp == drive.eligible_timestamp() && frame.timestamp < 2);
        let state = scenario.render(frame.branch, frame.timestamp, &frame.camera, Detail::default()).unwrap();
        let seen = state.actor.unwrap().visible_fraction;
        if hazard {
            assert_eq!(frame.observability, Some(Observability::None));
            assert!(seen < 0.05, "drive {number}: {seen}");
        } else {
            assert_eq!(frame.observability, Some(Observability::Full));
            assert!(seen > 0.7, "drive {number}: {seen}");
        }
    }
}

/// Every shipped scenario has free drives; scenarios without hazards only have clear trials.
#[test]
fn every_shipped_scenario_can_be_driven() {
    for name in
        ["hand-reaching", "open-branch-intersection", "single-approaching-intersection", "toy", "two-lane-merge"]
    {
        let scenario = shipped(name);
        for number in 0..2 {
            let drive = scenario.free_drive(number, 2, 1).unwrap();
            let hazard = number == 0 && !scenario.info().hazard_branches.is_empty();
            assert_eq!(drive.kind() == DriveKind::Hazard, hazard, "{name}");
            let frame = scenario.free_frame(&drive, drive.decisive_frame()).unwrap();
            let kind = scenario.info().trial_kind(frame.branch, frame.timestamp, frame.observability);
            assert_eq!(kind, Some(drive.kind()), "{name}");
        }
    }
}

/// A free pose gives one image of each branch from one camera, at a time step with a next one; even numbers are on the
/// ego's roof. Exactly the looks whose states are alike look the same, and equal arguments give equal looks.
#[test]
fn free_poses_show_every_branch() {
    let scenario = shipped("approaching-intersection");
    for number in 0..6 {
        let pose = scenario.free_pose(number, 3).unwrap();
        assert_eq!(pose, scenario.free_pose(number, 3).unwrap());
        assert_eq!((pose.views.len(), pose.view_kind == "dash" || number % 2 == 1), (2, true));
        assert!(pose.timestamp + 1 < scenario.info().timestamps);
        let states = [0, 1].map(|branch| scenario.info().state(branch, pose.timestamp).unwrap());
        let alike = pose.views[0].alike.contains(&states[1]);
        assert_eq!(alike, carff_dataset::looks_same(&pose.views[0].image, &pose.views[1].image));
        assert!(pose.views.iter().zip(states).all(|(look, state)| look.alike.contains(&state)));
        assert!(alike || pose.views[0].observability != Some(Observability::None));
    }
    assert_ne!(scenario.free_pose(0, 3).unwrap(), scenario.free_pose(0, 4).unwrap());
}

/// Watches go through the branches alternately, and their camera pans. A frame looks like its own state, and like others
/// only where the actor or its place is hidden.
#[test]
fn watches_pan_and_know_what_looks_alike() {
    let scenario = shipped("approaching-intersection");
    let (mut certain, mut together) = (0, 0);
    for number in 0..6 {
        let drive = scenario.watch(number, 2, 5).unwrap();
        assert_eq!(drive, scenario.watch(number, 2, 5).unwrap());
        assert_eq!(drive.branch() as u64, number % 2);
        let first = scenario.free_image(&drive, 0).0;
        let turned = (1..drive.frame_count()).map(|frame| apart(&first, &scenario.free_image(&drive, frame).0).1);
        assert!(turned.fold(0.0, f64::max) > 0.1, "watch {number} does not pan");
        for frame in [0, drive.frame_count() - 1] {
            let own = scenario.info().state(drive.branch(), drive.timestamp_of(frame)).unwrap();
            let alike = scenario.alike(&drive, frame);
            assert!(alike.contains(&own), "watch {number}, frame {frame}: {alike:?}");
            if alike.len() == 1 { certain += 1 } else { together += 1 }
        }
    }
    assert!(certain > 0 && together > 0, "{certain} frames show their state, {together} do not");
}
