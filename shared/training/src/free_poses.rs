//! Images from free poses for a dataset without a scenario file: a field renders them.
//!
//! An encoder memorises the poses of a dataset of a hundred poses. A field that is trained only on the trained poses,
//! with one latent for each state, renders every state from any pose between them. This field is not part of the
//! checkpoint: the checkpoint's field is conditioned on the latents of the encoder that learns from these images.
//!
//! Where a dataset's poses are missing in some states, or a camera took its images, the field also renders all states
//! from each trained pose. Only these images show which states look the same from there.

use crate::{
    TrainingError,
    config::TrainingConfig,
    field::{Clouds, FieldPhase},
    places,
    records::names,
    run::{Context, FREE_IMAGES, TrainingRun},
};
use carff_base::geometry::{PinholeCamera, cross, dot};
use carff_base::random::Key;
use carff_dataset::{DatasetWriter, FrameRecord, Image, MAX_DIFFERENT_PIXELS, ScenarioInfo};
use carff_evaluation::{PosedImages, Progress};
use carff_field::{Field, HypothesisBuffer, RenderOptions, to_bytes};
use carff_messages::{Gaussian, LATENT_DIM};
use rand::Rng;
use std::path::{Path, PathBuf};

/// Number of nearest poses of which one is the other end of the line from which a pose is drawn.
const NEIGHBOURS: usize = 6;

/// Smallest cosine between the axes of two neighbouring poses: 60 degrees. Poses between others would not be in a
/// dataset.
const LEAST_COSINE: f64 = 0.5;

/// Largest deviation from the line between two poses along each axis, as a share of its length.
const ASIDE: f64 = 0.5;

/// Largest rotation away from the interpolated direction, sideways and up, degrees.
const TURN_DEG: f64 = 8.0;

/// Side of the depth images that measure the nearest surfaces, pixels.
const LOOK_PX: u32 = 24;

/// Share of the pixels of a depth image that are nearer than its nearest surface.
const NEAR_SHARE: f64 = 0.1;

/// Smallest distance of the nearest surface, as a share of that of the neighbouring poses; a nearer camera is inside
/// something.
const LEAST_NEAR: f32 = 0.5;

/// Largest difference in any channel, of 255, between states that differ only by thin fog. Of the poses of
/// blender-intersection, 34 of 100 hide the actor at first. Of 100 free poses, 22 look the same with a tolerance of
/// 12, and 27 with this one.
const HAZE: u8 = 24;

/// The same for a field of images of a camera: noise and errors of the poses leave more fog. States that show the same
/// differ by more in at most [`MAX_DIFFERENT_PIXELS`] pixels. On 200 trained poses with one state each, labels of 29 of
/// 3000 pairs of states are then wrong, and of 184 with a limit of 24.
const CAMERA_HAZE: u8 = 48;

/// Largest number of draws for each requested pose.
const MOST_DRAWS: usize = 50;

/// Renders the dataset of `config.free_poses` into the run's folder unless it is there, and returns its folder. It has
/// images of all states from the same poses, no larger than the encoder's input. An interrupted call is resumed. `None`
/// where the configuration turns free poses off, where the dataset has one state, or where no pose is found.
pub fn render_free_poses(
    config: &TrainingConfig,
    dataset: &Path,
    run: &TrainingRun,
) -> Result<Option<PathBuf>, TrainingError> {
    if config.free_poses.count == 0 || config.free_poses.field_steps == 0 {
        return Ok(None);
    }
    let posed = PosedImages::open(dataset, config.split_seed)?;
    if posed.scenario.state_count() == 1 {
        return Ok(None);
    }
    // Refuses a dataset without places to probe before an hour of work.
    places(&posed.scenario)?;
    let dir = run.dir.join(FREE_IMAGES);
    let there = dir.join("transforms.json").is_file() || render(Context { config, posed: &posed, run }, &dir)?;
    Ok(there.then_some(dir))
}

/// Renders the dataset into `dir`; `false` when no pose is found.
fn render(context: Context, dir: &Path) -> Result<bool, TrainingError> {
    let Context { config, posed, run } = context;
    let codes = codes(posed, config.seed);
    let of_images: Vec<Gaussian> = posed.labels.iter().map(|label| codes[label.state]).collect();
    let clouds = Clouds::new(posed, &of_images)?;
    let field = FieldPhase::new(context, &clouds, names::FREE_POSES, config.free_poses.field_steps)?.trained()?;
    let latents: Vec<[f32; LATENT_DIM]> = codes.iter().map(|code| code.mean).collect();
    let options = RenderOptions { threads: config.threads.max(1) as usize, ..RenderOptions::default() };
    // The first hypothesis is rendered separately, and the others share its static parts: it is rendered twice, since
    // specks would distinguish it from the others.
    let together: Vec<[f32; LATENT_DIM]> = latents.first().into_iter().chain(&latents).copied().collect();
    let mut buffer = HypothesisBuffer::default();

    let mut cameras = cameras(config, posed, &field, &latents, &options);
    if !posed.are_comparable() {
        let input_px = config.encoder.backbone.input_px as u32;
        cameras.extend(trained_poses(posed).iter().map(|(_, camera)| fitted(camera, input_px)));
    }
    if cameras.is_empty() {
        return Ok(false);
    }
    let scenario = ScenarioInfo { bev_view: None, ..posed.scenario.clone() };
    let identity = format!("{FREE_IMAGES} {:?} {}", config.free_poses, config.seed);
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
            let image = |rgb| Image { width_px: camera.width_px, height_px: camera.height_px, rgb };
            let mut of_states: Vec<Image> = buffer.images[1..].iter().map(|r| image(to_bytes(&r.rgb))).collect();
            settle(&mut of_states, posed.is_of_camera());
            for (record, image) in records_of_view.iter().zip(of_states) {
                writer.write_image(&record.file_path, &image)?;
            }
            writer.note(&view)?;
        }
        records.extend(records_of_view);
        (run.on_progress)(&Progress { phase: "images", done: view + 1, total, line: String::new() });
        if run.stopped() {
            return Err(TrainingError::Stopped);
        }
    }
    records.sort_by_key(|r| (r.branch_and_timestamp, r.view));
    writer.finish(&records, Some(&scenario))?;
    Ok(true)
}

/// Gives each pixel of a state the colour of an earlier state where the two differ by no more than [`HAZE`]. A network
/// would otherwise learn to distinguish states by fog. For a field of images of a camera, a state that looks like an
/// earlier one through [`CAMERA_HAZE`] takes over its image.
fn settle(of_states: &mut [Image], of_camera: bool) {
    for state in 1..of_states.len() {
        let (earlier, rest) = of_states.split_at_mut(state);
        let own = &mut rest[0];
        let same = |other: &&Image| own.differing_pixels(other, CAMERA_HAZE).nth(MAX_DIFFERENT_PIXELS).is_none();
        if let Some(same) = earlier.iter().find(same).filter(|_| of_camera) {
            own.clone_from(same);
            continue;
        }
        for (i, pixel) in own.rgb.chunks_exact_mut(3).enumerate() {
            let near = |other: &&[u8]| pixel.iter().zip(*other).all(|(a, b)| a.abs_diff(*b) <= HAZE);
            if let Some(same) = earlier.iter().map(|other| &other.rgb[i * 3..i * 3 + 3]).find(near) {
                pixel.copy_from_slice(same);
            }
        }
    }
}

/// One random latent for each state. States that look the same from every trained pose share a latent.
fn codes(posed: &PosedImages, seed: u64) -> Vec<Gaussian> {
    let states = posed.scenario.state_count();
    let views: Vec<usize> = trained_poses(posed).into_iter().map(|(view, _)| view).collect();
    (0..states)
        .map(|state| {
            let same = |other: &usize| views.iter().all(|&view| posed.seen_equivalence.same(view, state, *other));
            let first = (0..state).find(same).unwrap_or(state);
            let mean = carff_base::random::gaussians(Key::named("code", seed, first as u64));
            Gaussian { mean, log_variance: [-10.0; LATENT_DIM] }
        })
        .collect()
}

/// Random cameras, each near the line between a trained pose and one of its neighbours. A camera is drawn again where
/// the field has a much nearer surface than for these two poses, or where the camera is in a known box of any state.
fn cameras(
    config: &TrainingConfig,
    posed: &PosedImages,
    field: &Field,
    latents: &[[f32; LATENT_DIM]],
    options: &RenderOptions,
) -> Vec<PinholeCamera> {
    let known: Vec<PinholeCamera> = trained_poses(posed).into_iter().map(|(_, camera)| camera).collect();
    if known.is_empty() {
        return Vec::new();
    }
    let mut buffer = HypothesisBuffer::default();
    let mut near_m = |camera: &PinholeCamera| {
        field.render_hypotheses(&camera.resized(LOOK_PX, LOOK_PX), latents, options, &mut buffer);
        buffer.images.iter().map(|image| nearest_m(&image.depth_m)).fold(f32::INFINITY, f32::min)
    };
    let known_near_m: Vec<f32> = known.iter().map(&mut near_m).collect();
    let scenario = &posed.scenario;
    let boxes: Vec<_> = scenario.states.iter().flat_map(|s| &s.boxes).chain(&scenario.static_boxes).collect();
    let neighbours: Vec<Vec<usize>> = (0..known.len()).map(|i| neighbours(&known, i)).collect();
    let mut rng = carff_base::random::stream(Key::named("pose", config.free_poses.seed, 0));
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

/// The trained poses by number, each with its camera.
fn trained_poses(posed: &PosedImages) -> Vec<(usize, PinholeCamera)> {
    let mut known: Vec<(usize, PinholeCamera)> =
        posed.trained().into_iter().map(|i| (posed.labels[i].view, posed.dataset.frames()[i].camera)).collect();
    known.sort_by_key(|(view, _)| *view);
    known.dedup_by_key(|(view, _)| *view);
    known
}

/// Distance of the nearest surface of a depth image without its nearest pixels, metres; infinite without surfaces.
fn nearest_m(depth_m: &[f32]) -> f32 {
    let mut met: Vec<f32> = depth_m.iter().copied().filter(|d| *d > 0.0).collect();
    met.sort_by(f32::total_cmp);
    met.get((met.len() as f64 * NEAR_SHARE) as usize).copied().unwrap_or(f32::INFINITY)
}

/// Neighbours of a pose, nearest first: poses with a similar direction and a similar up axis.
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

/// A camera at a random place near the line between two cameras, with the intrinsics of the first one.
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

/// The camera, resized to at most `most_px` on its longer side.
fn fitted(camera: &PinholeCamera, most_px: u32) -> PinholeCamera {
    let longer = camera.width_px.max(camera.height_px);
    if longer <= most_px {
        return *camera;
    }
    let scaled = |side: u32| (u64::from(side) * u64::from(most_px)).div_ceil(u64::from(longer)) as u32;
    camera.resized(scaled(camera.width_px), scaled(camera.height_px))
}

/// An axis of a camera in world space: right, up, back.
fn axis(camera: &PinholeCamera, column: usize) -> [f64; 3] {
    [0, 1, 2].map(|row| camera.world_from_camera[row][column])
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

    /// A free pose is valid, deviates from the line by at most half of its length along each axis, and from the
    /// direction by the largest rotation; its intrinsics are those of the first pose.
    #[test]
    fn between_two_poses_is_a_pose() {
        let (one, other) = (camera([4.0, 0.0, 2.0], [0.0; 3]), camera([0.0, 5.0, 1.0], [0.0, 1.0, 0.0]));
        let mut rng = carff_base::random::stream(Key { seed: 1, frame: 0, step: 0, sample: 0 });
        let aside_m = 0.5 * 42.0_f64.sqrt();
        for _ in 0..100 {
            let drawn = between(&one, &other, &mut rng);
            drawn.validate().unwrap();
            assert_eq!((drawn.fl_x_px, drawn.width_px), (one.fl_x_px, one.width_px));
            let [low, high] = [one, other].map(|c| c.position_m());
            let place = drawn.position_m();
            let within = |i: usize| (low[i].min(high[i]) - aside_m..=low[i].max(high[i]) + aside_m).contains(&place[i]);
            assert!((0..3).all(within), "{drawn:?}");
            // Towards one or the other, up to 8 degrees sideways and up.
            let cosine = dot(axis(&drawn, 2), axis(&one, 2)).max(dot(axis(&drawn, 2), axis(&other, 2)));
            let apart = dot(axis(&one, 2), axis(&other, 2)).acos() / 2.0;
            assert!(cosine.acos() <= apart + 12.0_f64.to_radians(), "{drawn:?}");
        }
        // Between a pose and itself there is no other place.
        assert_eq!(between(&one, &one, &mut rng).position_m(), one.position_m());
    }

    /// Poses with another direction, or upside down, are not neighbours at any distance; neighbours are sorted by
    /// distance.
    #[test]
    fn neighbours_look_the_same_way() {
        let mut all = vec![camera([4.0, 0.0, 2.0], [0.0; 3]), camera([4.0, 0.1, 2.0], [8.0, 0.0, 2.0])];
        all.push(PinholeCamera::look_at([4.0, 0.1, 2.0], [0.0; 3], [0.0, 0.0, -1.0], 640, 480, 60.0));
        all.extend([3.0, 1.0, 2.0].map(|y| camera([4.0, y, 2.0], [0.0; 3])));
        assert_eq!(neighbours(&all, 0), [4, 5, 3]);
    }

    /// The longer side is limited to the encoder's input and the field of view is kept; a smaller camera is unchanged.
    #[test]
    fn images_are_no_larger_than_the_encoder_input() {
        let large = camera([4.0, 0.0, 2.0], [0.0; 3]);
        let small = fitted(&large, 224);
        assert_eq!((small.width_px, small.height_px), (224, 168));
        assert!((small.fl_x_px / 224.0 - large.fl_x_px / 640.0).abs() < 1e-9);
        assert_eq!(fitted(&small, 224), small);
    }

    /// The nearest tenth is skipped; rays without a surface do not count.
    #[test]
    fn nearest_is_not_a_speck() {
        let depth_m: Vec<f32> = (0..40).map(|i| if i < 20 { 0.0 } else { i as f32 }).collect();
        assert_eq!(nearest_m(&depth_m), 22.0);
        assert_eq!(nearest_m(&[0.0; 4]), f32::INFINITY);
    }

    /// A difference up to the limit is removed, and a larger one is kept; a third state may match any earlier state.
    #[test]
    fn fog_does_not_distinguish_states() {
        let image = |rgb: [u8; 6]| Image { width_px: 2, height_px: 1, rgb: rgb.to_vec() };
        let mut states =
            [[100, 100, 100, 10, 10, 10], [124, 76, 100, 10, 10, 35], [90, 100, 100, 10, 10, 30]].map(image);
        settle(&mut states, false);
        assert_eq!(states[0].rgb, [100, 100, 100, 10, 10, 10]);
        assert_eq!(states[1].rgb, [100, 100, 100, 10, 10, 35]);
        assert_eq!(states[2].rgb, [100, 100, 100, 10, 10, 10]);
    }

    /// Thick fog and a few pixels do not distinguish the states of a camera's images; nine pixels do, and keep the
    /// contrast that a pixel has.
    #[test]
    fn thick_fog_does_not_distinguish_the_images_of_a_camera() {
        let image = |fog: u8, pixels: usize| {
            let rgb = (0..64).flat_map(|i| if i < pixels { [149; 3] } else { [100 + fog, 100, 100] });
            Image { width_px: 8, height_px: 8, rgb: rgb.collect() }
        };
        for (fog, pixels, same) in [(48, 0, true), (49, 0, false), (0, 8, true), (0, 9, false), (48, 8, true)] {
            let mut states = [image(0, 0), image(fog, pixels)];
            settle(&mut states, true);
            assert_eq!(states[0] == states[1], same, "{fog} {pixels}");
        }
        let mut states = [image(0, 0), image(30, 9)];
        settle(&mut states, true);
        assert_eq!((&states[1].rgb[..3], &states[1].rgb[27..30]), (&[149; 3][..], &[130, 100, 100][..]));
    }
}
