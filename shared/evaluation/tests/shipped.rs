//! Contracts of the shipped checkpoint: the belief from views that do not show the actor's place, and the comparison of
//! views from a moving vehicle.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_dataset::{Image, Observability};
use carff_decision::{Evidence, Feedback, Plan, Sampling, look_ahead};
use carff_evaluation::{KnownStates, Models};
use carff_scenes::{Detail, FRAMES_PER_TIMESTAMP, Scenario};
use carff_unknown::{Comparer, Known, KnownScene};
use std::path::Path;

/// The branches with and without the actor, at the first step.
const BRANCHES: [usize; 2] = [0, 1];

const SCENARIO: &str = "configs/scenarios/approaching-intersection.toml";
const CHECKPOINT: &str = "configs/checkpoints/approaching-intersection";

/// Seed of the drives on which the closer look was designed.
const DESIGN_SEED: u64 = 0x3e9 ^ carff_base::random::tag("diag");

/// A view that hides the actor's place gives an even belief, with and without the actor. The images of both branches
/// are the same, and training has not memorised poses.
#[test]
fn hidden_views_give_an_even_belief() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let scenario = Scenario::load(&root.join(SCENARIO)).unwrap();
    let mut models = Models::load(&root.join(CHECKPOINT)).unwrap();
    let mut hazard = |view: usize, branch: usize, timestamp: usize| {
        let camera = scenario.cameras()[view].camera;
        let rendering = scenario.render(branch, timestamp, &camera, Detail::default()).unwrap();
        let hidden = rendering.actor.is_some_and(|actor| actor.observability == Observability::None);
        let image = rendering.image;
        let sides = [i64::from(image.height_px), i64::from(image.width_px), 3];
        let posterior = models.encoder.encode_bytes(&tch::Tensor::from_slice(&image.rgb).view(sides)).unwrap();
        let plan = Plan {
            samples: 10,
            sampling: Sampling::Stratified,
            feedback: Feedback::State,
            horizon: 2,
            seed: 1,
            frame: (view * 2 + branch) as u64,
        };
        let steps = look_ahead(|input, _| models.mixture.forecast(input), &mut models.probe, &posterior, None, plan);
        (hidden, Evidence::of_steps(&steps).hazard_probability())
    };
    let mut pairs = Vec::new();
    // Every second ego view: enough views, and quick to render.
    for view in (0..scenario.cameras().len()).filter(|v| scenario.cameras()[*v].view_kind == "dash").step_by(2) {
        let [with, without] = BRANCHES.map(|branch| hazard(view, branch, 0));
        if with.0 && without.0 {
            pairs.push((view, with.1, without.1));
        }
    }
    assert!(pairs.len() >= 5, "too few hidden views: {pairs:?}");
    let mean = pairs.iter().map(|(_, a, b)| (a + b) / 2.0).sum::<f64>() / pairs.len() as f64;
    let difference = pairs.iter().map(|(_, a, b)| (a - b).abs()).sum::<f64>() / pairs.len() as f64;
    assert!((0.35..0.65).contains(&mean), "mean hazard probability {mean}: {pairs:?}");
    assert!(difference < 0.1, "with and without the actor differ by {difference}: {pairs:?}");
}

/// From the roof of a vehicle between and behind the places that it has in the known states, nothing is unknown: the states
/// show the vehicle ahead, where the camera sees the road. Something on that road is unknown.
#[test]
fn the_vehicle_itself_is_not_unknown() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let scenario = Scenario::load(&root.join(SCENARIO)).unwrap();
    let models = Models::load(&root.join(CHECKPOINT)).unwrap();
    let known = Known::load(&root.join(CHECKPOINT)).unwrap().unwrap();
    let states = KnownStates::new(&known, &models.probe, 2);
    let [mut explained, mut images, mut found, mut patched] = [0; 4];
    for number in 0..8 {
        let drive = scenario.watch(number, FRAMES_PER_TIMESTAMP, 7).unwrap();
        for frame in [0, 2, 7, 13, 14] {
            let (camera, mut image) = scenario.free_image(&drive, frame);
            let residual = |image: &Image| states.compare(&camera, image).unwrap().seen.residual;
            images += 1;
            explained += usize::from(residual(&image) <= 1.0);
            // A red thing of 24 x 24 pixels, where the road is straight ahead.
            let ground = known.lanes.ground_points(&camera);
            if [[54, 100], [74, 100]].iter().all(|[x, y]| ground[y * 128 + x].is_some_and(|ground| ground.on_lanes)) {
                let patch = Image { width_px: 24, height_px: 24, rgb: [200, 30, 40].repeat(24 * 24) };
                image.paste(&patch, 52, 78);
                patched += 1;
                found += usize::from(residual(&image) > 1.0);
            }
        }
    }
    assert!(explained * 10 >= images * 8, "{explained} of {images} images have nothing unknown");
    assert!(patched >= 10 && found == patched, "something is found in {found} of {patched} images");
}

/// A wall next to the camera, and a line that is flatter than a pixel, are not unknown: the field does not show them as the
/// image does. The images are those of a design seed, in which the first version of the comparison
/// found something.
#[test]
fn walls_and_flat_lines_are_not_unknown() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    for (name, images) in [("approaching-intersection", [157, 214, 26]), ("two-lane-merge", [195, 58, 234])] {
        let scenario = Scenario::load(&root.join(format!("configs/scenarios/{name}.toml"))).unwrap();
        let checkpoint = root.join("configs/checkpoints").join(name);
        let (models, known) = (Models::load(&checkpoint).unwrap(), Known::load(&checkpoint).unwrap().unwrap());
        let states = KnownStates::new(&known, &models.probe, 2);
        for number in images {
            let drive = scenario.watch(number, FRAMES_PER_TIMESTAMP, DESIGN_SEED).unwrap();
            let (camera, image) = scenario.free_image(&drive, number as usize * 7 % drive.frame_count());
            let residual = states.compare(&camera, &image).unwrap().seen.residual;
            assert!(residual <= 1.0, "{name}, image {number}: {residual}");
        }
    }
}

/// The vehicle itself is not unknown where another camera sees it: the states without it leave it unexplained, and those
/// with it explain it. The result does not depend on images that the camera took before.
#[test]
fn the_vehicle_itself_is_explained_where_it_is_seen() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let scenario = Scenario::load(&root.join(SCENARIO)).unwrap();
    let models = Models::load(&root.join(CHECKPOINT)).unwrap();
    let known = Known::load(&root.join(CHECKPOINT)).unwrap().unwrap();
    let (field, lanes) = (models.probe.field(), &known.lanes);
    let states: Vec<_> = models.probe.states().iter().map(|state| state.mean).collect();
    let scene = KnownScene { field, states: &states, hazard_states: &known.hazard_states, lanes };
    let [mut seen, mut explained] = [0; 2];
    for pose in scenario.cameras().iter().filter(|pose| pose.view_kind != "dash").step_by(4) {
        let mut reused = Comparer::new(field, lanes);
        for timestamp in 0..3 {
            let image = scenario.render(BRANCHES[1], timestamp, &pose.camera, Detail::default()).unwrap().image;
            let judge = |comparer: &mut Comparer| {
                let compared = comparer.compare(scene, &pose.camera, image.view().unwrap(), 2).unwrap();
                let with_own = comparer.look_closer(&compared, scene, 2);
                [Some(&compared), with_own.as_ref()].map(|compared| compared.map(|c| known.judge(c)))
            };
            let [without, with] = judge(&mut reused);
            assert_eq!([without.clone(), with.clone()], judge(&mut Comparer::new(field, lanes)));
            if without.unwrap().residual > 1.0 {
                seen += 1;
                explained += usize::from(with.is_some_and(|with| with.residual <= 1.0));
            }
        }
    }
    assert!(seen >= 5 && explained * 10 >= seen * 8, "it is explained in {explained} of {seen} images that show it");
}
