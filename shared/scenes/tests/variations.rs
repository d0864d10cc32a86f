//! Tests of appearances, bystanders and unknown views: only what is unknown changes.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::path::Path;

use carff_dataset::Image;
use carff_scenes::config::{BystanderPlace, VariationRole};
use carff_scenes::{Detail, Scenario, VISIBLE_DIFFERENCE};

/// Scenarios on roads.
const ROADS: [&str; 3] = ["approaching-intersection", "two-lane-merge", "single-approaching-intersection"];

fn file(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/scenarios");
    std::fs::read_to_string(folder.join(name).with_extension("toml")).unwrap()
}

fn shipped(name: &str) -> Scenario {
    Scenario::parse(name.as_ref(), &file(name)).unwrap()
}

/// Returns the image of a state from fixed camera 0.
fn image(scenario: &Scenario, branch: usize, timestamp: usize) -> Image {
    let camera = scenario.cameras()[0].camera.resized(64, 64);
    scenario.render(branch, timestamp, &camera, Detail::Image).unwrap().image
}

/// Each scenario on roads has enough variations of each role and place, and each one can be chosen.
#[test]
fn shipped_scenarios_have_variations() {
    for name in ROADS {
        let scenario = shipped(name);
        let of = |role| scenario.appearances().iter().filter(|a| a.role == role).count();
        assert!(of(VariationRole::Trained) >= 6 && of(VariationRole::HeldOut) >= 8, "{name}");
        let on = |place| scenario.bystanders().iter().filter(|b| b.place == place).count();
        assert!(on(BystanderPlace::Road) >= 4 && on(BystanderPlace::Roadside) >= 4, "{name}");
        for appearance in scenario.appearances() {
            assert_eq!(scenario.with_appearance(&appearance.name).unwrap().cameras(), scenario.cameras());
        }
        for object in scenario.bystanders() {
            assert_eq!(scenario.with_object(&object.name).unwrap().cameras(), scenario.cameras());
        }
    }
}

/// A file without variations gives the same cameras, states and images as the file with them.
#[test]
fn variations_change_nothing_by_default() {
    for name in ROADS {
        let text = file(name);
        let (start, end) = (text.find("# --- variations").unwrap(), text.find("# --- cameras").unwrap());
        let plain = Scenario::parse(name.as_ref(), &format!("{}{}", &text[..start], &text[end..])).unwrap();
        assert!(plain.appearances().is_empty() && plain.bystanders().is_empty());
        let full = shipped(name);
        assert_eq!((plain.cameras(), plain.info()), (full.cameras(), full.info()));
        assert_eq!(image(&plain, 0, 1), image(&full, 0, 1));
        assert_eq!(plain.free_pose(3, 5).unwrap(), full.free_pose(3, 5).unwrap());
    }
}

/// Another appearance changes images with the dynamic vehicle only, and neither cameras nor free poses, of any kind.
#[test]
fn an_appearance_keeps_all_poses() {
    let scenario = shipped("approaching-intersection");
    let van = scenario.with_appearance("red-van").unwrap();
    assert_ne!(image(&van, 0, 2), image(&scenario, 0, 2));
    assert_eq!(image(&van, 1, 2), image(&scenario, 1, 2));
    for number in 0..4 {
        let (own, other) = (scenario.free_pose(number, 7).unwrap(), van.free_pose(number, 7).unwrap());
        assert_eq!((own.view_kind, own.timestamp, own.camera), (other.view_kind, other.timestamp, other.camera));
        assert_eq!(own.views[1].image, other.views[1].image);
    }
    assert_eq!(scenario.free_drive(1, 2, 7).unwrap(), van.free_drive(1, 2, 7).unwrap());
    let free = |scenario: Scenario| scenario.with_free_cameras(6, 7).unwrap().cameras().to_vec();
    assert_eq!(free(van), free(scenario));
}

/// The heading of an appearance turns the vehicle's box about its place.
#[test]
fn an_appearance_turns_the_vehicle() {
    let scenario = shipped("approaching-intersection");
    let appearance = scenario.appearances().iter().find(|a| a.heading_deg != 0.0).unwrap();
    let turned = scenario.with_appearance(&appearance.name).unwrap();
    let of = |scenario: &Scenario| scenario.info().candidates[0].named_box.oriented_box;
    let (old, new) = (of(&scenario), of(&turned));
    assert_eq!(old.center[..2], new.center[..2]);
    assert!((new.yaw - old.yaw - appearance.heading_deg.to_radians()).abs() < 1e-12);
    assert_eq!(new.half_size, appearance.size_m.map(|v| v / 2.0));
}

/// An added object is in every state, under its name and with its box on the ground, and cannot be added twice.
#[test]
fn an_object_is_in_every_state() {
    let scenario = shipped("approaching-intersection");
    let with = scenario.with_object("crate-on-road").unwrap();
    for state in 0..scenario.info().state_count() {
        let (branch, timestamp) = (scenario.info().branch_of(state), scenario.info().timestamp_of(state));
        assert_ne!(image(&with, branch, timestamp), image(&scenario, branch, timestamp));
    }
    let is_crate = |b: &&carff_dataset::NamedBox| b.name == "crate-on-road";
    let found = with.info().static_boxes.iter().find(is_crate).unwrap();
    assert!((found.oriented_box.center[2] - found.oriented_box.half_size[2]).abs() < 0.03);
    assert_eq!((with.object_of("actor"), scenario.object_of("crate-on-road")), (scenario.object_of("actor"), None));
    let both = with.with_object("animal-on-road").unwrap();
    assert_eq!(both.unknown_view(1, 3).unwrap().boxes.len(), 2);
    let error = with.with_object("crate-on-road").unwrap_err().to_string();
    assert!(error.contains("no `bystander` named `crate-on-road`"), "{error}");
    let error = scenario.with_appearance("white-vam").unwrap_err().to_string();
    assert!(error.contains("did you mean `white-van`?"), "{error}");
}

/// An unknown view has the free pose's camera. Its image differs from the one without the unknown in the counted
/// pixels, and the image without is that of the clear branch, which shows no truck either.
#[test]
fn unknown_views_count_their_pixels() {
    let scenario = shipped("approaching-intersection");
    let van = scenario.with_appearance("white-van").unwrap();
    let object = scenario.with_object("trunk-on-road").unwrap();
    let mut in_sight = 0;
    for number in 0..6 {
        let pose = scenario.free_pose(number, 3).unwrap();
        for (variation, branch) in [(&van, 0), (&object, 1)] {
            let view = variation.unknown_view(number, 3).unwrap();
            assert_eq!((view.branch, view.timestamp, view.camera), (branch, pose.timestamp, pose.camera));
            assert_eq!(view.without, pose.views[1].image);
            let differs = |(a, b): &(&[u8], &[u8])| (0..3).any(|c| a[c].abs_diff(b[c]) > VISIBLE_DIFFERENCE);
            let (with, without) = (view.image.rgb.chunks(3), view.without.rgb.chunks(3));
            assert_eq!(with.zip(without).filter(differs).count(), view.visible_px as usize);
            assert_eq!((view.in_sight(), view.boxes.len()), (view.visible_px >= 100, 1));
            assert_eq!(view, variation.unknown_view(number, 3).unwrap());
            in_sight += usize::from(view.in_sight());
        }
    }
    assert!(in_sight > 0);
    let error = scenario.unknown_view(0, 3).unwrap_err().to_string();
    assert!(error.contains("nothing is unknown"), "{error}");
}

/// Contradictions between variations and other tables are refused with line and key.
#[test]
fn contradictions_are_refused() {
    let text = file("approaching-intersection");
    for (from, to, expected) in [
        ("name = \"red-pickup\"", "name = \"grey-car\"", "key `appearance`: `grey-car` is named twice"),
        ("name = \"trunk-on-road\"", "name = \"ego\"", "key `bystander`: `ego` is named twice"),
        ("dynamic = true", "dynamic = false", "key `appearance`: no vehicle is dynamic"),
        ("heading_deg = 5.0", "heading_deg = 500.0", "500 is out of range"),
        ("place = \"roadside\"", "place = \"sky\"", "unknown variant `sky`"),
    ] {
        let error = Scenario::parse("a.toml".as_ref(), &text.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(error.contains(expected), "{to}: {error}");
    }
}
