//! Images of a scenario that no dataset has: free drives and poses, unknown objects, other places.

use crate::train::Display;
use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_base::random::{Key, gaussians, uniform};
use carff_dataset::Image;
use carff_evaluation::{
    DecisiveImage, KnownStates, LaneImage, MaskedView, Novelty, OtherPlace, Perception, Progress, Subject, Visibility,
    Watch, WatchPlan,
};
use carff_scenes::config::{BystanderPlace, VariationRole};
use carff_scenes::{
    ClosedLoop, Detail, FRAMES_PER_TIMESTAMP, FreePose, Scenario, ScenarioError, UnknownView, VISIBLE_DIFFERENCE,
    is_in_sight,
};
use ndarray::Axis;
use std::path::PathBuf;

/// Views with masks of each state, and deviation of their cameras' positions along x and y, metres.
const VIEWS_PER_STATE: usize = 12;
const VIEW_SHIFT_M: f64 = 0.4;
/// Images of a lane drive, time between two of them, and latest time of its first, seconds; speed of its ego, m/s.
const LANE_FRAMES: usize = 12;
const LANE_FRAME_S: f64 = 0.1;
const LANE_DRIVE_S: f64 = 8.0;
const LANE_EGO_MPS: f64 = 2.0;
/// A vehicle in sight is whole if this share of the pixels of its box shows it; a vehicle fills about three quarters.
const WHOLE_SHARE: f64 = 0.6;

/// Decisive image of each free drive.
pub fn free_drives(
    scenario: &Scenario,
    count: u32,
    seed: u64,
    display: &Display,
) -> anyhow::Result<Vec<DecisiveImage>> {
    let total = count as usize;
    (0..total)
        .map(|done| {
            display.show(&Progress { phase: "free drives", done, total, line: String::new() });
            let drive = scenario.free_drive(done as u64, FRAMES_PER_TIMESTAMP, seed)?;
            let frame = scenario.free_frame(&drive, drive.decisive_frame())?;
            Ok(DecisiveImage { image: frame.image, camera: frame.camera, kind: drive.kind() })
        })
        .collect()
}

/// Drives whose camera pans, seen as the graph sees them.
pub fn watches(
    subject: &Subject,
    scenario: &Scenario,
    count: u32,
    seed: u64,
    display: &Display,
) -> anyhow::Result<Vec<Watch>> {
    let Ok(net) = &subject.mixture else { return Ok(Vec::new()) };
    let known = subject.known.as_ref().zip(subject.probe.as_ref().ok());
    let known = known.map(|(known, probe)| KnownStates::with_places(known, probe, subject.options.threads));
    let perception = Perception { known, ..subject.perception() };
    let plan = WatchPlan { count: count as usize, seed, exact: true };
    Ok(carff_evaluation::watches(scenario, &perception, net, plan, &|p| display.show(p))?)
}

/// Drives with one other vehicle on the lane, at a random place of the ego and a random time, with a camera that moves.
/// Empty for a scenario without closed-loop drives.
pub fn lane_drives(
    scenario: &Scenario,
    count: u32,
    seed: u64,
    display: &Display,
) -> anyhow::Result<Vec<Vec<LaneImage>>> {
    let world = match ClosedLoop::new(Scenario::load(scenario.path())?, None) {
        Err(ScenarioError::NoClosedLoop { .. }) => return Ok(Vec::new()),
        world => world?,
    };
    let (nobody, total) = (world.episode(0, seed, Some(0)), count as usize);
    let of_drive = |number: usize| {
        display.show(&Progress { phase: "lane drives", done: number, total, line: String::new() });
        let episode = world.episode(number as u64, seed, Some(1));
        let draw = |name: &str| uniform(Key::named(name, seed, number as u64));
        let (start_m, start_s) = (draw("ego") * world.conflict_m()[0], draw("time") * LANE_DRIVE_S);
        let image = |frame: usize| {
            let passed_s = frame as f64 * LANE_FRAME_S;
            let (at_m, time_s) = ((start_m + LANE_EGO_MPS * passed_s).min(world.conflict_m()[0]), start_s + passed_s);
            let vehicle = world.actor_boxes(&episode, time_s)[0];
            let next = world.actor_boxes(&episode, time_s + 1.0)[0];
            let camera = world.camera(&episode, at_m);
            let image = world.image_from(&episode, at_m, time_s, &camera);
            let without = world.image_from(&nobody, at_m, time_s, &camera);
            LaneImage {
                time_s: passed_s,
                visibility: visibility(&vehicle, &camera, &image, &without),
                image,
                camera,
                heading_rad: world.ego_pose(at_m)[2],
                vehicle_m: [vehicle.center[0], vehicle.center[1]],
                speed_mps: (next.center[0] - vehicle.center[0]).hypot(next.center[1] - vehicle.center[1]),
            }
        };
        (0..LANE_FRAMES).map(image).collect()
    };
    Ok((0..total).map(of_drive).collect())
}

/// Visibility of a vehicle, from an image with and without it: whole if most of the pixels of its box show it.
fn visibility(vehicle: &OrientedBox, camera: &PinholeCamera, image: &Image, without: &Image) -> Visibility {
    let shown = image.differing_pixels(without, VISIBLE_DIFFERENCE).count();
    // A larger camera with the same rays in its middle: what is out of view counts too.
    let turned = vehicle.turned();
    let (width, height) = (i64::from(camera.width_px), i64::from(camera.height_px));
    let pixels = (-height..2 * height).flat_map(|y| (-width..2 * width).map(move |x| (x, y)));
    let is_met = |(x, y): &(i64, i64)| turned.is_met_by(&camera.ray(*x as f64 + 0.5, *y as f64 + 0.5));
    let outline = pixels.filter(is_met).count();
    match shown {
        0 => Visibility::None,
        _ if !is_in_sight(shown as u32, image) => Visibility::Hardly,
        _ if (shown as f64) < WHOLE_SHARE * outline as f64 => Visibility::Partial,
        _ => Visibility::Whole,
    }
}

/// Views from above of every state with the class of each pixel. The camera of each is moved a little.
pub fn masked_views(
    subject: &Subject,
    scenario: &Scenario,
    seed: u64,
    display: &Display,
) -> anyhow::Result<Vec<MaskedView>> {
    let Ok(probe) = &subject.probe else { return Ok(Vec::new()) };
    let camera = carff_evaluation::view_camera(&subject.posed.dataset, probe.field());
    let classes: Vec<(u16, u8)> = carff_evaluation::occupants(probe.layout())
        .iter()
        .zip(1..)
        .filter_map(|(name, class)| Some((scenario.object_of(name)?, class)))
        .collect();
    let states = scenario.info().state_count();
    let total = states * VIEWS_PER_STATE;
    (0..total)
        .map(|done| {
            display.show(&Progress { phase: "masked views", done, total, line: String::new() });
            let mut moved = camera;
            let shift = gaussians::<2>(Key::named("mask", seed, done as u64));
            for (axis, shift) in shift.into_iter().enumerate() {
                moved.world_from_camera[axis][3] += VIEW_SHIFT_M * f64::from(shift);
            }
            let state = done % states;
            let (branch, timestamp) = (scenario.info().branch_of(state), scenario.info().timestamp_of(state));
            let options = Detail::Image;
            let rendering = scenario.render(branch, timestamp, &moved, options)?;
            let class = |object: &u16| classes.iter().find(|(of, _)| of == object).map_or(0, |(_, class)| *class);
            Ok(MaskedView {
                rgb: carff_evaluation::to_unit(&rendering.image.rgb),
                classes: rendering.object_id.iter().map(class).collect(),
            })
        })
        .collect()
}

/// Free poses with their images.
pub fn free_poses(scenario: &Scenario, count: u32, seed: u64, display: &Display) -> anyhow::Result<Vec<FreePose>> {
    let total = count as usize;
    (0..total)
        .map(|done| {
            display.show(&Progress { phase: "free poses", done, total, line: String::new() });
            Ok(scenario.free_pose(done as u64, seed)?)
        })
        .collect()
}

/// The scenario's unknown vehicles and objects, in sight from free poses.
pub fn novelties(scenario: &Scenario, count: u32, seed: u64, display: &Display) -> anyhow::Result<Vec<Novelty>> {
    let held_out = |role: VariationRole| role == VariationRole::HeldOut;
    let vehicles =
        scenario.appearances().iter().map(|a| Ok((scenario.with_appearance(&a.name)?, &a.name, a.role, false)));
    let objects = scenario
        .bystanders()
        .iter()
        .map(|b| Ok((scenario.with_object(&b.name)?, &b.name, b.role, b.place == BystanderPlace::Roadside)));
    let total = scenario.appearances().len() + scenario.bystanders().len();
    let of_variation = |(done, varied): (usize, anyhow::Result<(Scenario, &String, VariationRole, bool)>)| {
        let (varied, name, role, beside) = varied?;
        display.show(&Progress { phase: "unknown objects", done, total, line: name.clone() });
        // A vehicle of a hazard branch is absent at some time steps.
        let views = (0..u64::from(count)).filter_map(|number| varied.unknown_view(number, seed).ok());
        let views = views.filter(UnknownView::in_sight).collect();
        Ok(Novelty { name: name.clone(), held_out: held_out(role), beside, views })
    };
    vehicles.chain(objects).enumerate().map(of_variation).collect()
}

/// Images of the other scenarios in the scenario's folder, and changed images of its own free poses.
pub fn other_places(
    scenario: &Scenario,
    own: &[FreePose],
    count: u32,
    seed: u64,
    display: &Display,
) -> anyhow::Result<Vec<OtherPlace>> {
    let first = |pose: &FreePose| pose.views.first().map(|view| (pose.camera, view.image.clone()));
    let mut places = Vec::new();
    for path in scenario_files(scenario)? {
        let other = Scenario::load(&path)?;
        if other.roads() == scenario.roads() {
            continue;
        }
        let poses = free_poses(&other, count, seed, display)?;
        places.push(OtherPlace { name: other.info().name.clone(), images: poses.iter().filter_map(first).collect() });
    }
    let shown: Vec<(PinholeCamera, Image)> = own.iter().filter_map(first).collect();
    for (name, axis) in [("mirrored", Axis(1)), ("upside down", Axis(0))] {
        let images = shown.iter().filter_map(|(camera, image)| Some((*camera, reversed(image, axis)?))).collect();
        places.push(OtherPlace { name: name.to_owned(), images });
    }
    let others = shown.iter().cycle().skip(shown.len() / 2).map(|(camera, _)| *camera);
    let images = shown.iter().zip(others).map(|((_, image), camera)| (camera, image.clone())).collect();
    places.push(OtherPlace { name: "another pose".to_owned(), images });
    Ok(places)
}

fn reversed(image: &Image, axis: Axis) -> Option<Image> {
    let mut view = image.view()?;
    view.invert_axis(axis);
    Some(Image { rgb: view.iter().copied().collect(), ..image.clone() })
}

/// The scenario files in a scenario's folder, by name.
fn scenario_files(scenario: &Scenario) -> anyhow::Result<Vec<PathBuf>> {
    let Some(folder) = scenario.path().parent() else { return Ok(Vec::new()) };
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
        .collect();
    files.sort();
    Ok(files)
}
