//! Tests of the window without a screen: they press elements by label and check the session.

#![allow(clippy::unwrap_used, reason = "also in shared fixtures")]

use crate::common::{HIDING_VIEW, image, models};
use carff_viewer::app::{Options, Viewer, Waker};
use carff_viewer::session::{Selection, Session};
use eframe::egui::{Event, Key, Modifiers, MouseWheelUnit, Theme, ThemePreference, Vec2, pos2, vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::{NodeT, Queryable};
use std::path::Path;
use std::time::{Duration, Instant};

/// Longest wait for an image. It only bounds a test that hangs.
const PATIENCE: Duration = Duration::from_mins(5);

/// Creates a window with small images; `None`: no image yet.
fn window(view: Option<usize>, folder: &Path) -> Harness<'static, Viewer> {
    let options = Options { threads: 1, folder: folder.to_owned(), theme: ThemePreference::Dark, one_shot: None };
    let none = Err("No dataset: drop a PNG image here.".to_owned());
    let mut viewer = Viewer::new(Session::new(models()), none, None, options, Waker::default()).unwrap();
    viewer.finest_px = 96;
    if let Some(view) = view {
        viewer.toggle_input(image(0, 0, view)).unwrap();
    }
    let mut harness = Harness::builder()
        .with_size(vec2(1440.0, 900.0))
        .build_state(|ctx, viewer: &mut Viewer| viewer.show(ctx), viewer);
    harness.run_steps(3);
    harness
}

fn click(harness: &mut Harness<'static, Viewer>, label: &str) {
    harness.get_by_label(label).click();
    harness.run_steps(2);
}

fn press(harness: &mut Harness<'static, Viewer>, modifiers: Modifiers, key: Key) {
    harness.key_press_modifiers(modifiers, key);
    harness.run_steps(2);
}

fn step(harness: &Harness<'static, Viewer>) -> u32 {
    harness.state().session.moment().unwrap().step
}

fn wait_until_drawn(harness: &mut Harness<'static, Viewer>) {
    let since = Instant::now();
    while !harness.state().is_drawn() {
        assert!(since.elapsed() < PATIENCE, "the scene is not rendered");
        std::thread::sleep(Duration::from_millis(10));
        harness.run_steps(1);
    }
}

/// The three main commands, back and forward work by their buttons; a button without effect is disabled.
#[test]
fn buttons_look_ahead() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    assert_eq!(step(&harness), 0);
    click(&mut harness, "Predict");
    assert_eq!(step(&harness), 1);
    assert!(harness.state().session.moment().unwrap().belief.is_none());
    click(&mut harness, "Probe");
    let belief = harness.state().session.moment().unwrap().belief.clone().unwrap();
    assert_eq!(belief.samples.len(), 10);
    assert!(harness.query_by_label("halt").is_some(), "the rule's decision is in the log");
    click(&mut harness, "Probe and predict");
    assert_eq!(step(&harness), 2);
    assert!(harness.get_by_label("Probe and predict").accesskit_node().is_disabled());
    assert!(harness.get_by_label("▶").accesskit_node().is_disabled());
    click(&mut harness, "◀");
    assert_eq!(step(&harness), 1);
    click(&mut harness, "▶");
    assert_eq!(step(&harness), 2);
    click(&mut harness, "Toggle");
    assert_eq!(step(&harness), 0);
    assert!(harness.state().session.moment().unwrap().forecast.is_none());
}

/// The window works at its smallest size, at any smaller one that a window manager forces, and while it is resized.
#[test]
fn any_size() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    click(&mut harness, "Predict");
    click(&mut harness, "Probe");
    let sizes =
        [(900.0, 600.0), (1440.0, 640.0), (1366.0, 768.0), (900.0, 2000.0), (300.0, 200.0), (64.0, 64.0), (1.0, 1.0)];
    for (width, height) in sizes {
        harness.set_size(vec2(width, height));
        harness.run_steps(3);
    }
    for height in (1..900).step_by(23) {
        harness.set_size(vec2(1440.0 - height as f32, height as f32));
        harness.run_steps(1);
    }
    harness.set_size(vec2(900.0, 600.0));
    harness.run_steps(2);
    click(&mut harness, "Probe and predict");
    assert_eq!(step(&harness), 2, "the buttons are there at the smallest size");
}

/// On a screen of 1366 x 768 the settings, the belief and the maps are visible without scrolling.
#[test]
fn nothing_is_below_the_fold() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    harness.set_size(vec2(1366.0, 768.0));
    click(&mut harness, "Predict");
    click(&mut harness, "Probe");
    let bottom = harness.get_by_label("Decisions").rect().top();
    for label in ["seed", "density at", "camera of the view", "camera of the image", "hazard state"] {
        assert!(harness.get_by_label(label).rect().bottom() <= bottom, "{label}");
    }
}

/// A pressed thumbnail shows its scene; so does a state of the belief. Marks follow the shown scene.
#[test]
fn scenes_are_chosen() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    click(&mut harness, "Predict");
    click(&mut harness, "component 2");
    assert_eq!(harness.state().session.moment().unwrap().selection, Selection::Component(1));
    click(&mut harness, "Probe");
    click(&mut harness, "component 1");
    let moment = harness.state().session.moment().unwrap().clone();
    assert_eq!(moment.selection, Selection::Component(0));
    assert_eq!(moment.found.unwrap().probed, moment.belief.unwrap().components[0]);
    click(&mut harness, "no-actor t1");
    assert_eq!(harness.state().session.moment().unwrap().selection, Selection::State(4));
}

/// Every command has its key; the help lists the keys and does not block the window.
#[test]
fn keys_do_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    for (key, wanted) in [
        (Key::P, 1),
        (Key::Enter, 2),
        (Key::OpenBracket, 1),
        (Key::OpenBracket, 0),
        (Key::CloseBracket, 1),
        (Key::T, 0),
        (Key::N, 1),
    ] {
        press(&mut harness, Modifiers::NONE, key);
        assert_eq!(step(&harness), wanted, "{key:?}");
    }
    let before = harness.state().session.moment().unwrap().selection;
    press(&mut harness, Modifiers::NONE, Key::ArrowRight);
    assert_ne!(harness.state().session.moment().unwrap().selection, before);
    press(&mut harness, Modifiers::NONE, Key::ArrowLeft);
    assert_eq!(harness.state().session.moment().unwrap().selection, before);
    press(&mut harness, Modifiers::NONE, Key::O);
    assert!(harness.state().session.moment().unwrap().found.is_some());
    press(&mut harness, Modifiers::NONE, Key::F1);
    assert!(harness.query_by_label("Probe: occupancy of each place, and the belief").is_some());
    press(&mut harness, Modifiers::NONE, Key::F1);
    assert!(harness.query_by_label("Probe: occupancy of each place, and the belief").is_none());
    press(&mut harness, Modifiers::NONE, Key::F1);
    press(&mut harness, Modifiers::NONE, Key::Escape);
    assert!(!harness.state().shows_help && harness.state().message().is_none());
    press(&mut harness, Modifiers::NONE, Key::L);
    assert_eq!(harness.ctx.theme(), Theme::Light);
    press(&mut harness, Modifiers::NONE, Key::B);
    press(&mut harness, Modifiers::NONE, Key::D);
    assert!(!harness.state().overlays.boxes && !harness.state().overlays.densities);
}

/// Dragging turns the camera, dragging with the other button moves it, the wheel zooms, and keys set it.
#[test]
fn the_mouse_moves_the_camera() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    let before = harness.state().camera;
    let (from, to) = (pos2(700.0, 250.0), pos2(760.0, 290.0));
    harness.drag_at(from);
    harness.run_steps(1);
    harness.event(Event::PointerMoved(to));
    harness.run_steps(1);
    harness.drop_at(to);
    harness.run_steps(1);
    let turned = harness.state().camera;
    assert_ne!((turned.azimuth_deg, turned.elevation_deg), (before.azimuth_deg, before.elevation_deg));
    assert_eq!((turned.target_m, turned.distance_m), (before.target_m, before.distance_m));
    harness.hover_at(to);
    harness.event(Event::MouseWheel {
        unit: MouseWheelUnit::Point,
        delta: Vec2::new(0.0, 120.0),
        modifiers: Modifiers::NONE,
    });
    harness.run_steps(30);
    assert!(harness.state().camera.distance_m < before.distance_m);
    press(&mut harness, Modifiers::NONE, Key::Num2);
    assert_eq!(harness.state().camera.elevation_deg, 90.0);
    press(&mut harness, Modifiers::NONE, Key::Num3);
    let eye_m = harness.state().camera.eye_m();
    let taken_m = image(0, 0, HIDING_VIEW).camera.unwrap().position_m();
    assert!((0..3).all(|i| (eye_m[i] - taken_m[i]).abs() < 1e-6));
    press(&mut harness, Modifiers::NONE, Key::Num1);
    assert_eq!(harness.state().camera, before);
}

/// The scene is rendered and can be saved. A window without an image shows what to do, and its commands are disabled.
#[test]
fn scenes_are_drawn_and_saved() {
    let folder = tempfile::tempdir().unwrap();
    let mut harness = window(Some(HIDING_VIEW), folder.path());
    click(&mut harness, "Predict");
    wait_until_drawn(&mut harness);
    press(&mut harness, Modifiers::SHIFT, Key::S);
    let saved = carff_dataset::Image::load(&folder.path().join("carff-scene-0001.png")).unwrap();
    assert_eq!(saved.width_px.max(saved.height_px), 96);
    assert!(harness.state().message().unwrap().contains("carff-scene-0001.png"));

    let harness = window(None, folder.path());
    assert!(harness.state().is_drawn(), "nothing is missing");
    for label in ["Toggle", "Predict", "Probe", "Probe and predict"] {
        assert!(harness.get_by_label(label).accesskit_node().is_disabled(), "{label}");
    }
    assert!(harness.query_by_label("No dataset: drop a PNG image here.").is_some());
}
