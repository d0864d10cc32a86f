//! Images of a scenario that no dataset has: free drives and poses, unknown objects, other places.

use crate::train::Display;
use carff_base::geometry::PinholeCamera;
use carff_base::random::{Key, gaussians};
use carff_dataset::Image;
use carff_evaluation::{
    DecisiveImage, MaskedView, Novelty, OtherPlace, Perception, Progress, Subject, Watch, WatchPlan,
};
use carff_scenes::config::{BystanderPlace, VariationRole};
use carff_scenes::{Detail, FRAMES_PER_TIMESTAMP, FreePose, Scenario, UnknownView};
use ndarray::Axis;
use std::path::PathBuf;

/// Views with masks of each state, and deviation of their cameras' positions along x and y, metres.
const VIEWS_PER_STATE: usize = 12;
const VIEW_SHIFT_M: f64 = 0.4;

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
    let perception = Perception { known: None, ..subject.perception() };
    let plan = WatchPlan { count: count as usize, seed, exact: true };
    Ok(carff_evaluation::watches(scenario, &perception, net, plan, &|p| display.show(p))?)
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
