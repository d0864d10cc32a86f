//! Pictures from freely drawn poses for a set that no scenario file can draw again: a field shows them.
//!
//! Of a hundred poses an encoder learns each by heart. A field that is trained on the set's trained poses alone, each state
//! under a latent of its own, shows every state from any pose between them. It is made for this, and does not ship: the field
//! that ships is conditioned on the latents of the encoder that learns from these pictures.

use crate::{
    TrainingError,
    config::TrainingConfig,
    field::{self, Clouds},
    pictures::Pictures,
    places::places,
    run::{Progress, Run},
};
use carff_dataset::{DatasetWriter, FrameRecord, Image, PoseRole, ScenarioInfo};
use carff_field::{Field, HypothesisBuffer, RenderOptions};
use carff_geometry::PinholeCamera;
use carff_messages::{Gaussian, LATENT_DIM};
use carff_random::Key;
use rand::Rng;
use std::path::{Path, PathBuf};

/// Folder of the pictures in the run's folder.
pub const FOLDER: &str = "free-poses";

/// Stage of the field that shows them, as progress, metrics and saved states name it.
pub const STAGE: &str = "free";

/// Nearest poses of which one is the other end of the stretch that a pose is drawn from.
const NEIGHBOURS: usize = 6;

/// Poses whose axes are further apart than this have nothing between them that a set would hold: cosine of 60 degrees.
const LEAST_COSINE: f64 = 0.5;

/// Largest deviation from the stretch between two poses, along each axis, as a share of its length.
const ASIDE: f64 = 0.5;

/// Largest turn away from the direction between two poses' directions, to the side and up, degrees.
const TURN_DEG: f64 = 8.0;

/// Side of the pictures in which it is seen how near things are, pixels.
const LOOK_PX: u32 = 24;

/// Share of a picture's pixels that may be nearer than what counts as its nearest.
const NEAR_SHARE: f64 = 0.1;

/// A drawn camera stands in something when its nearest is nearer than this share of what the poses about it have.
const LEAST_NEAR: f32 = 0.5;

/// By how much of 255 states differ through thin fog alone, in any channel. Of blender-intersection's poses between which
/// they are drawn 34 of 100 hide the actor at first; of 100 drawn ones 22 look the same up to 12, 27 up to this.
const HAZE: u8 = 24;

/// Draws for each pose that is wanted, before those that are found must do.
const MOST_DRAWS: usize = 50;

/// The set of `config.free_poses` in the run's folder, made unless it is there: pictures of all states, no larger than the
/// encoder looks at, each from the same poses. Goes on where an earlier call stopped. None where the configuration wants
/// none, where there is one state alone, or where no pose is found.
pub fn set(config: &TrainingConfig, dataset: &Path, run: &Run) -> Result<Option<PathBuf>, TrainingError> {
    if config.free_poses.count == 0 || config.free_poses.field_steps == 0 {
        return Ok(None);
    }
    let pictures = Pictures::open(dataset, config.split_seed)?;
    if pictures.scenario.state_count() == 1 {
        return Ok(None);
    }
    // What the forecast cannot be trained on is refused before an hour goes into it.
    places(&pictures.scenario)?;
    let dir = run.dir.join(FOLDER);
    let there = dir.join("transforms.json").is_file() || make(config, &pictures, &dir, run)?;
    Ok(there.then_some(dir))
}

fn make(config: &TrainingConfig, pictures: &Pictures, dir: &Path, run: &Run) -> Result<bool, TrainingError> {
    let codes = codes(pictures, config.seed);
    let of_pictures: Vec<Gaussian> = pictures.labels.iter().map(|label| codes[label.state]).collect();
    let clouds = Clouds::new(pictures, &of_pictures)?;
    let field = field::train_stage(config, pictures, &clouds, STAGE, config.free_poses.field_steps, run)?;
    let latents: Vec<[f32; LATENT_DIM]> = codes.iter().map(|code| code.mean).collect();
    let options = RenderOptions { threads: config.threads.max(1) as usize, ..RenderOptions::default() };
    // The first is rendered by itself, all others share what does not change: specks there would tell it from them.
    let together: Vec<[f32; LATENT_DIM]> = latents.first().into_iter().chain(&latents).copied().collect();
    let mut buffer = HypothesisBuffer::default();

    let cameras = cameras(config, pictures, &field, &latents, &options);
    if cameras.is_empty() {
        return Ok(false);
    }
    let scenario = ScenarioInfo { bev_view: None, ..pictures.scenario.clone() };
    let identity = format!("{FOLDER} {:?} {}", config.free_poses, config.seed);
    let (writer, notes) = DatasetWriter::go_on::<usize>(dir, &identity)?;
    let total = cameras.len();
    let mut records = Vec::with_capacity(total * latents.len());
    for (view, camera) in cameras.iter().enumerate() {
        let records_of_view = scenario.states.iter().map(|state| {
            let name = format!("images/b{}_t{}_v{view:04}.png", state.branch, state.timestamp);
            FrameRecord {
                branch_and_timestamp: Some((state.branch, state.timestamp)),
                view: Some(view),
                ..FrameRecord::new(name, *camera)
            }
        });
        let records_of_view: Vec<FrameRecord> = records_of_view.collect();
        if !notes.contains(&view) {
            field.render_hypotheses(camera, &together, &options, &mut buffer);
            let bytes = |rgb: &[f32]| rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
            let mut of_states: Vec<Vec<u8>> = buffer.pictures[1..].iter().map(|picture| bytes(&picture.rgb)).collect();
            settle(&mut of_states);
            for (record, rgb) in records_of_view.iter().zip(of_states) {
                let image = Image { width_px: camera.width_px, height_px: camera.height_px, rgb };
                writer.write_image(&record.file_path, &image)?;
            }
            writer.note(&view)?;
        }
        records.extend(records_of_view);
        (run.on_progress)(&Progress { stage: "pictures", done: view + 1, total, line: String::new() });
        if run.stopped() {
            return Err(TrainingError::Stopped);
        }
    }
    records.sort_by_key(|r| (r.branch_and_timestamp, r.view));
    writer.finish(&records, Some(&scenario))?;
    Ok(true)
}

/// Gives each pixel of a state the colour that it has in an earlier one, where the two differ by no more than [`HAZE`]: a
/// network would learn to see them apart where nothing does.
fn settle(of_states: &mut [Vec<u8>]) {
    for state in 1..of_states.len() {
        let (earlier, rest) = of_states.split_at_mut(state);
        for (i, pixel) in rest[0].chunks_exact_mut(3).enumerate() {
            let near = |other: &&[u8]| pixel.iter().zip(*other).all(|(a, b)| a.abs_diff(*b) <= HAZE);
            if let Some(same) = earlier.iter().map(|other| &other[i * 3..i * 3 + 3]).find(near) {
                pixel.copy_from_slice(same);
            }
        }
    }
}

/// A latent for each state, drawn once; states that look the same from every trained pose have one.
fn codes(pictures: &Pictures, seed: u64) -> Vec<Gaussian> {
    let states = pictures.scenario.state_count();
    let mut views: Vec<usize> = pictures.trained().into_iter().map(|i| pictures.labels[i].view).collect();
    views.sort_unstable();
    views.dedup();
    (0..states)
        .map(|state| {
            let same = |other: &usize| views.iter().all(|&view| pictures.equivalence.same(view, state, *other));
            let first = (0..state).find(same).unwrap_or(state);
            let mean = carff_random::gaussians(Key { seed, frame: first as u64, step: 0x636f_6465, sample: 0 });
            Gaussian { mean, log_variance: [-10.0; LATENT_DIM] }
        })
        .collect()
}

/// The drawn cameras: each between a trained pose and one of the poses next to it, and a little aside. Where the field shows
/// something much nearer than these two see, or a known box of any state is in the way, another one is drawn.
fn cameras(
    config: &TrainingConfig,
    pictures: &Pictures,
    field: &Field,
    latents: &[[f32; LATENT_DIM]],
    options: &RenderOptions,
) -> Vec<PinholeCamera> {
    let mut known: Vec<(usize, PinholeCamera)> = pictures
        .with_roles(&[PoseRole::Rest, PoseRole::Calibration])
        .into_iter()
        .map(|i| (pictures.labels[i].view, pictures.dataset.frames()[i].camera))
        .collect();
    known.sort_by_key(|(view, _)| *view);
    known.dedup_by_key(|(view, _)| *view);
    let known: Vec<PinholeCamera> = known.into_iter().map(|(_, camera)| camera).collect();
    if known.is_empty() {
        return Vec::new();
    }
    let mut buffer = HypothesisBuffer::default();
    let mut near_m = |camera: &PinholeCamera| {
        field.render_hypotheses(&camera.resized(LOOK_PX, LOOK_PX), latents, options, &mut buffer);
        buffer.pictures.iter().map(|picture| nearest_m(&picture.depth_m)).fold(f32::INFINITY, f32::min)
    };
    let known_near_m: Vec<f32> = known.iter().map(&mut near_m).collect();
    let scenario = &pictures.scenario;
    let boxes: Vec<_> = scenario.states.iter().flat_map(|s| &s.boxes).chain(&scenario.static_boxes).collect();
    let neighbours: Vec<Vec<usize>> = (0..known.len()).map(|i| neighbours(&known, i)).collect();
    let mut rng = carff_random::stream(Key { seed: config.free_poses.seed, frame: 0, step: 0x706f_7365, sample: 0 });
    let mut found = Vec::with_capacity(config.free_poses.count);
    for _ in 0..config.free_poses.count * MOST_DRAWS {
        if found.len() == config.free_poses.count {
            break;
        }
        let one = rng.random_range(0..known.len());
        let Some(&other) = neighbours[one].get(rng.random_range(0..NEIGHBOURS)) else { continue };
        let camera = fitted(&between(&known[one], &known[other], &mut rng), config.encoder.backbone.input_px as u32);
        let free = !boxes.iter().any(|b| b.oriented_box.contains(camera.position_m()));
        if free && near_m(&camera) >= LEAST_NEAR * known_near_m[one].min(known_near_m[other]) {
            found.push(camera);
        }
    }
    found
}

/// How near a picture's things are, but for its nearest pixels, metres; infinite where no ray meets any.
fn nearest_m(depth_m: &[f32]) -> f32 {
    let mut met: Vec<f32> = depth_m.iter().copied().filter(|d| *d > 0.0).collect();
    met.sort_by(f32::total_cmp);
    met.get((met.len() as f64 * NEAR_SHARE) as usize).copied().unwrap_or(f32::INFINITY)
}

/// The poses next to one, nearest first: those that look in about its direction and stand about as upright.
fn neighbours(cameras: &[PinholeCamera], of: usize) -> Vec<usize> {
    let distance_m = |i: usize| {
        let (a, b) = (cameras[of].position_m(), cameras[i].position_m());
        (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>().sqrt()
    };
    let alike = |i: usize| [1, 2].iter().all(|&a| dot(axis(&cameras[of], a), axis(&cameras[i], a)) > LEAST_COSINE);
    let mut others: Vec<usize> = (0..cameras.len()).filter(|&i| i != of && alike(i)).collect();
    others.sort_by(|&a, &b| distance_m(a).total_cmp(&distance_m(b)));
    others.truncate(NEIGHBOURS);
    others
}

/// A camera at a random place of the stretch between two, and a little aside; its intrinsics are the first one's.
fn between(one: &PinholeCamera, other: &PinholeCamera, rng: &mut impl Rng) -> PinholeCamera {
    let share: f64 = rng.random();
    let mix = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] { std::array::from_fn(|i| a[i] + share * (b[i] - a[i])) };
    let (from, to) = (one.position_m(), other.position_m());
    let length_m = (0..3).map(|i| (from[i] - to[i]).powi(2)).sum::<f64>().sqrt();
    let aside = ASIDE * length_m;
    let place = mix(from, to).map(|v| if aside > 0.0 { v + rng.random_range(-aside..=aside) } else { v });
    let mut turn = || rng.random_range(-TURN_DEG..=TURN_DEG).to_radians().tan();
    let (aside, above) = (turn(), turn());
    let [right, up, back] = [0, 1, 2].map(|a| mix(axis(one, a), axis(other, a)));
    let back = unit(std::array::from_fn(|i| back[i] + aside * right[i] + above * up[i]));
    let right = unit(cross(up, back));
    let up = cross(back, right);
    let row = |i: usize| [right[i], up[i], back[i], place[i]];
    PinholeCamera { world_from_camera: [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]], ..*one }
}

/// The camera with a picture whose longer side has at most `most_px`.
fn fitted(camera: &PinholeCamera, most_px: u32) -> PinholeCamera {
    let longer = camera.width_px.max(camera.height_px);
    if longer <= most_px {
        return *camera;
    }
    let scaled = |side: u32| (u64::from(side) * u64::from(most_px)).div_ceil(u64::from(longer)) as u32;
    camera.resized(scaled(camera.width_px), scaled(camera.height_px))
}

/// A camera's own axis in world space: right, up, back.
fn axis(camera: &PinholeCamera, column: usize) -> [f64; 3] {
    [0, 1, 2].map(|row| camera.world_from_camera[row][column])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(v: [f64; 3]) -> [f64; 3] {
    let length = dot(v, v).sqrt().max(1e-12);
    v.map(|x| x / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(eye: [f64; 3], target: [f64; 3]) -> PinholeCamera {
        PinholeCamera::look_at(eye, target, [0.0, 0.0, 1.0], 640, 480, 60.0)
    }

    /// What lies between two poses is a pose, no further aside than half of the way along each axis, that looks no further
    /// away than it may turn; its intrinsics are the first one's.
    #[test]
    fn between_two_poses_is_a_pose() {
        let (one, other) = (camera([4.0, 0.0, 2.0], [0.0; 3]), camera([0.0, 5.0, 1.0], [0.0, 1.0, 0.0]));
        let mut rng = carff_random::stream(Key { seed: 1, frame: 0, step: 0, sample: 0 });
        let aside_m = 0.5 * 42.0_f64.sqrt();
        for _ in 0..100 {
            let drawn = between(&one, &other, &mut rng);
            drawn.validate().unwrap();
            assert_eq!((drawn.fl_x_px, drawn.width_px), (one.fl_x_px, one.width_px));
            let [low, high] = [one, other].map(|c| c.position_m());
            let place = drawn.position_m();
            let within = |i: usize| (low[i].min(high[i]) - aside_m..=low[i].max(high[i]) + aside_m).contains(&place[i]);
            assert!((0..3).all(within), "{drawn:?}");
            // Towards one or the other, up to 8 degrees to the side and up.
            let cosine = dot(axis(&drawn, 2), axis(&one, 2)).max(dot(axis(&drawn, 2), axis(&other, 2)));
            let apart = dot(axis(&one, 2), axis(&other, 2)).acos() / 2.0;
            assert!(cosine.acos() <= apart + 12.0_f64.to_radians(), "{drawn:?}");
        }
        // From where it stands itself: there alone.
        assert_eq!(between(&one, &one, &mut rng).position_m(), one.position_m());
    }

    /// Poses that look elsewhere, or stand on their heads, are no neighbours, however near; the others are by distance.
    #[test]
    fn neighbours_look_the_same_way() {
        let mut all = vec![camera([4.0, 0.0, 2.0], [0.0; 3]), camera([4.0, 0.1, 2.0], [8.0, 0.0, 2.0])];
        all.push(PinholeCamera::look_at([4.0, 0.1, 2.0], [0.0; 3], [0.0, 0.0, -1.0], 640, 480, 60.0));
        all.extend([3.0, 1.0, 2.0].map(|y| camera([4.0, y, 2.0], [0.0; 3])));
        assert_eq!(neighbours(&all, 0), [4, 5, 3]);
    }

    /// The longer side is what the encoder looks at, the field of view stays; what is smaller stays as it is.
    #[test]
    fn pictures_are_no_larger_than_what_is_looked_at() {
        let large = camera([4.0, 0.0, 2.0], [0.0; 3]);
        let small = fitted(&large, 224);
        assert_eq!((small.width_px, small.height_px), (224, 168));
        assert!((small.fl_x_px / 224.0 - large.fl_x_px / 640.0).abs() < 1e-9);
        assert_eq!(fitted(&small, 224), small);
    }

    /// The nearest tenth is passed over; rays that meet nothing do not count.
    #[test]
    fn nearest_is_not_a_speck() {
        let depth_m: Vec<f32> = (0..40).map(|i| if i < 20 { 0.0 } else { i as f32 }).collect();
        assert_eq!(nearest_m(&depth_m), 22.0);
        assert_eq!(nearest_m(&[0.0; 4]), f32::INFINITY);
    }

    /// What differs by the limit is made the same, by one more it stays; a third state takes after whichever it is near.
    #[test]
    fn fog_does_not_tell_states_apart() {
        let mut states =
            vec![vec![100, 100, 100, 10, 10, 10], vec![124, 76, 100, 10, 10, 35], vec![90, 100, 100, 10, 10, 30]];
        settle(&mut states);
        assert_eq!(states[0], [100, 100, 100, 10, 10, 10]);
        assert_eq!(states[1], [100, 100, 100, 10, 10, 35]);
        assert_eq!(states[2], [100, 100, 100, 10, 10, 10]);
    }
}
