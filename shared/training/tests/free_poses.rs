//! Contracts of free poses that a field renders: their images, their inputs, and interruptions.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

mod common;

use carff_base::random::Key;
use carff_dataset::{Dataset, Degradation, Equivalence, Image, PoseRole, PoseSplit, degrade, sensor::SensorNoise};
use carff_evaluation::PosedImages;
use carff_field::Correction;
use carff_scenes::Detail;
use carff_training::{FreePoses, Phases, TrainingError, render_free_poses};
use common::{Place, SCENARIO};
use rand::Rng;
use rand_distr::StandardNormal;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const TRAINING: &str = r#"
dataset = "set"
out = "out"
seed = 3
split_seed = 5
threads = 1

[free_poses]
count = 24
seed = 4
field_steps = 200

[encoder]
backbone = { kind = "efficientnet-lite0", input_px = 32 }

[field]
levels = 6
log2_table_size = 13
max_resolution = 128
hidden_width = 32
samples_across = 64.0
occupancy_resolution = 32

[nerf]
rays = 1024

[nerf.trainer]
occupancy_warmup_steps = 100
threads = 1
"#;

/// A field that renders other poses needs more than a few poses to learn from.
fn place() -> Place {
    Place::new(&SCENARIO.replace("count = 8", "count = 40").replace("count = 6", "count = 20"), TRAINING)
}

/// Renders the dataset in the run folder `name`, until `stop_at` (phase, steps done), or to the end.
fn make(place: &Place, name: &str, stop_at: Option<(&str, usize)>) -> Result<Option<PathBuf>, TrainingError> {
    place.run(name, stop_at, |run| render_free_poses(&place.config, &place.at("set"), run))
}

/// The files of a dataset by name.
fn files(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::from([("transforms".to_owned(), std::fs::read(dir.join("transforms.json")).unwrap())]);
    for entry in std::fs::read_dir(dir.join("images")).unwrap() {
        let path = entry.unwrap().path();
        all.insert(path.display().to_string().split_off(dir.display().to_string().len()), std::fs::read(path).unwrap());
    }
    all
}

/// Every state is rendered from each free pose at the encoder's size, near to its true image. The second step's
/// branches look the same from the poses behind the wall, and differ from other poses.
#[test]
fn free_poses_show_what_is_there() {
    let mut place = place();
    place.config.free_poses.field_steps = 800;
    let set = Dataset::open(&make(&place, "run", None).unwrap().unwrap()).unwrap();
    let images = set.load_all_images().unwrap();
    assert_eq!((set.view_count(), set.state_count(), images.len()), (24, 4, 96));
    let error = |a: &Image, b: &Image| -> f64 {
        a.rgb.iter().zip(&b.rgb).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum()
    };
    let mut alike = 0;
    for (frame, image) in set.frames().iter().zip(&images) {
        assert_eq!((image.width_px, image.height_px), (32, 32));
        let (branch, timestamp) = (frame.branch.unwrap(), frame.timestamp.unwrap());
        let truth = place.scenario.render(branch, timestamp, &frame.camera, Detail::default()).unwrap().image;
        let count = truth.rgb.len() as u64 / 3;
        let mean =
            [0, 1, 2].map(|c| (truth.rgb.iter().skip(c).step_by(3).map(|&v| u64::from(v)).sum::<u64>() / count) as u8);
        alike += usize::from(error(image, &truth) < 0.5 * error(&Image::filled(32, 32, mean), &truth));
    }
    // Other poses show parts that no training image shows, such as the top of the wall.
    assert!(alike > 64, "{alike} of 96");
    let looks = Equivalence::from_dataset(&set, &images);
    let hidden = (0..24).filter(|&view| looks.same(view, 1, 3)).count();
    assert!((1..24).contains(&hidden), "{hidden} of 24");
}

/// States whose images are the same from all trained poses are rendered the same, to the last bit: the field adds no
/// difference.
#[test]
fn states_that_look_the_same_stay_the_same() {
    let place = place();
    let set = Dataset::open(&place.at("set")).unwrap();
    let of = |branch: usize| set.frames().iter().filter(move |f| (f.branch, f.timestamp) == (Some(branch), Some(0)));
    for from in of(0) {
        let to = of(1).find(|to| to.view == from.view).unwrap();
        std::fs::copy(&from.image_path, &to.image_path).unwrap();
    }
    let made = files(&make(&place, "run", None).unwrap().unwrap());
    let names: Vec<&String> = made.keys().filter(|name| name.contains("b0_t0")).collect();
    assert_eq!(names.len(), 24);
    for name in names {
        assert!(made[name] == made[&name.replace("b0_t0", "b1_t0")], "{name}");
    }
}

/// From each pose, only one state was seen. The field renders all states from the trained poses, and these images show
/// which states look the same there. Without them, a training is refused.
#[test]
fn poses_of_one_state_are_completed() {
    let mut place = place();
    place.config.free_poses.field_steps = 1500;
    let [whole, partial] = ["set", "partial"].map(|name| place.at(name));
    let degradation = Degradation { noise: SensorNoise::OFF, pose_jitter_px: 0.0, one_state: true, seed: 1 };
    degrade(&Dataset::open(&whole).unwrap(), &partial, &degradation).unwrap();
    let path = partial.join("transforms.json");
    let mut set: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    for frame in set["frames"].as_array_mut().unwrap() {
        frame.as_object_mut().unwrap().retain(|key, _| key != "observability" && key != "alike_states");
    }
    std::fs::write(&path, set.to_string()).unwrap();
    let out = place.at("out");
    let refused = place.run("run", None, |run| place.training(&partial, &out).run(Phases::All, run)).unwrap_err();
    assert!(refused.to_string().contains("no image of some states"), "{refused}");

    let made = place.run("made", None, |run| render_free_poses(&place.config, &partial, run)).unwrap().unwrap();
    let open = |dir: &Path| PosedImages::open(dir, place.config.split_seed).unwrap();
    let (truth, mut posed) = (open(&whole), open(&partial));
    posed.add_free_poses(&made).unwrap();
    assert_eq!(posed.incomplete_view(), None);
    let trained = posed.trained();
    let own = trained.iter().map(|&i| posed.labels[i]);
    let agree = own.filter(|label| {
        let (seen, true_ones) = (posed.seen_alike(label.view, label.state), truth.seen_alike(label.view, label.state));
        seen == true_ones
            && label.observability == truth.labels[truth.at(label.state, label.view).unwrap()].observability
    });
    let agree = agree.count();
    assert!(5 * agree > 4 * trained.len(), "{agree} of {}", trained.len());
}

/// A dataset whose boxes are the same in several states cannot be probed, and is refused before any work.
#[test]
fn a_set_without_boxes_is_refused_at_once() {
    let place = place();
    let path = place.at("set").join("transforms.json");
    let mut set: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    for key in ["states", "candidates"] {
        set["scenario"].as_object_mut().unwrap().remove(key);
    }
    std::fs::write(&path, set.to_string()).unwrap();
    let refused = make(&place, "run", None).unwrap_err().to_string();
    assert!(refused.contains("`scenario.states[].boxes`"), "{refused}");
    assert_eq!(std::fs::read_dir(place.at("run")).unwrap().count(), 0);
    let (set, out) = (place.at("set"), place.at("out"));
    let refused = place.run("run", None, |run| place.training(&set, &out).run(Phases::All, run)).unwrap_err();
    assert!(refused.to_string().contains("`scenario.states[].boxes`"));
    assert!(!out.exists());
}

/// The rendered images do not depend on the images of held-out poses, so that results on these are valid.
#[test]
fn unseen_poses_stay_unseen() {
    let place = place();
    let before = files(&make(&place, "before", None).unwrap().unwrap());
    let set = Dataset::open(&place.at("set")).unwrap();
    let unseen = PoseSplit::for_dataset(&set, place.config.split_seed).views(PoseRole::Unseen);
    let mut changed = 0;
    for (i, frame) in set.frames().iter().enumerate().filter(|(_, f)| f.view.is_some_and(|v| unseen.contains(&v))) {
        let image = set.load_image(i).unwrap();
        let noise = Image::filled(image.width_px, image.height_px, [(i * 7) as u8, 0, 255]);
        noise.save_png(&frame.image_path).unwrap();
        changed += 1;
    }
    assert!(changed >= 4, "{changed}");
    assert!(files(&make(&place, "after", None).unwrap().unwrap()) == before);
}

/// After interruptions while its field trains and while its images are rendered, the dataset has the same bytes. A
/// finished dataset is not rendered again, and a configuration without free poses gets none.
#[test]
fn making_free_poses_resumes() {
    let mut place = place();
    let straight = make(&place, "straight", None).unwrap().unwrap();
    for stop_at in [("free", 80), ("images", 5)] {
        assert!(matches!(make(&place, "halting", Some(stop_at)), Err(TrainingError::Stopped)), "{stop_at:?}");
    }
    let halting = make(&place, "halting", None).unwrap().unwrap();
    assert!(files(&straight) == files(&halting));
    std::fs::remove_file(place.at("halting").join("free.state.safetensors")).unwrap();
    assert_eq!(make(&place, "halting", None).unwrap(), Some(halting));
    place.config.free_poses.field_steps = 0;
    assert_eq!(make(&place, "none", None).unwrap(), None);
}

/// The field finds the errors of the poses of a camera's images, and their gains. Its images, and not the camera's, show
/// which states look the same, and get the camera's noise.
#[test]
fn errors_of_poses_and_gains_are_found() {
    const JITTER_PX: f64 = 1.5;
    let mut place = place();
    place.config.free_poses = FreePoses { field_steps: 3000, count: 1, ..place.config.free_poses };
    let [whole, degraded] = ["set", "degraded"].map(|name| place.at(name));
    let noise = SensorNoise { sigma: 2.0, gain_sigma: 0.05, channel_gain_sigma: 0.03, ..SensorNoise::OFF };
    let degradation = Degradation { noise, pose_jitter_px: JITTER_PX, one_state: false, seed: 1 };
    degrade(&Dataset::open(&whole).unwrap(), &degraded, &degradation).unwrap();
    let made = place.run("run", None, |run| render_free_poses(&place.config, &degraded, run)).unwrap().unwrap();
    let state = tch::Tensor::read_safetensors(place.at("run/free.state.safetensors")).unwrap();
    let found = &state.iter().find(|(name, _)| name == "corrections").unwrap().1;
    let found = Vec::<f32>::try_from(found).unwrap();
    let mut posed = PosedImages::open(&degraded, place.config.split_seed).unwrap();
    let side_px = f64::from(posed.images[0].width_px);
    // The image shows its place shifted by the error of its pose.
    let errors = posed.trained().into_iter().zip(found.chunks(Correction::LEN)).flat_map(|(image, found)| {
        let mut rng = carff_base::random::stream(Key::named("jitt", 1, image as u64));
        [found[0], found[3]].map(|share| {
            let shift_px = JITTER_PX * rng.sample::<f64, _>(StandardNormal);
            [(f64::from(share) * side_px + shift_px).abs(), shift_px.abs()]
        })
    });
    let errors: Vec<[f64; 2]> = errors.collect();
    // Images of little more than road do not show where they are from.
    let [left, before] = [0, 1].map(|i| median(errors.iter().map(|e| e[i]).collect()));
    assert!(left < 0.4 * before, "{left:.2} of {before:.2} px");

    // The same gains at exact poses: the sums of the colours change by them only.
    let brighter = place.at("brighter");
    degrade(&Dataset::open(&whole).unwrap(), &brighter, &Degradation { pose_jitter_px: 0.0, ..degradation }).unwrap();
    let [exact, brighter] = [&whole, &brighter].map(|set| PosedImages::open(set, place.config.split_seed).unwrap());
    let sum =
        |image: &Image, channel: usize| image.rgb.iter().skip(channel).step_by(3).map(|&v| f64::from(v)).sum::<f64>();
    let gains = posed.trained().into_iter().zip(found.chunks(Correction::LEN)).flat_map(|(image, found)| {
        [0, 1, 2].map(|channel| {
            let gain = sum(&brighter.images[image], channel) / sum(&exact.images[image], channel);
            [(f64::from(found[6 + channel]) - gain).abs(), (gain - 1.0).abs()]
        })
    });
    let gains: Vec<[f64; 2]> = gains.collect();
    let [left, before] = [0, 1].map(|i| median(gains.iter().map(|e| e[i]).collect()));
    assert!(left < 0.6 * before, "{left:.4} of {before:.4}");

    let agreeing = |posed: &PosedImages| {
        let alike = |images: &PosedImages, i: usize| images.seen_alike(posed.labels[i].view, posed.labels[i].state);
        posed.trained().into_iter().filter(|&i| alike(posed, i) == alike(&exact, i)).count()
    };
    let through_noise = agreeing(&posed);
    posed.add_free_poses(&made).unwrap();
    let (rendered, trained) = (agreeing(&posed), posed.trained());
    assert!(rendered >= through_noise && 5 * rendered > 4 * trained.len(), "{rendered}, {through_noise}");
    for image in trained {
        let of_view = posed.of_view(posed.labels[image].view);
        assert!(of_view.iter().all(|&other| other >= posed.dataset.frames().len()), "{of_view:?}");
        assert_eq!(posed.missing_noise(image), 0.0);
        // Rendered images have half the side, as the encoder's input, to which the camera's images are reduced.
        let reduced = f64::from(posed.images[of_view[0]].width_px) / side_px;
        let share = posed.missing_noise(of_view[0]) / (f64::from(noise.sigma) * reduced);
        assert!((0.85..1.3).contains(&share), "{share}");
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
