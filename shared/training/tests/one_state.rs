//! Contracts of datasets of one state, such as imported ones, and of the shipped training files. Only the field is
//! trained, and it is judged on held-out poses.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_dataset::{Dataset, ImportOptions, import};
use carff_scenes::{Extras, Scenario};
use carff_training::{Phases, Progress, Training, TrainingConfig, TrainingError, TrainingRun};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Two blocks of different colours, seen from above and around.
const SCENARIO: &str = r##"
name = "still"
bounds_m = [[-3.0, -3.0, 0.0], [3.0, 3.0, 2.0]]
timestamps = 1
branches = ["only"]
image = { width_px = 48, height_px = 48, fov_deg = 45.0 }
ground_surface = "plain"
ground_colour = "#808080"

[[object]]
name = "red"
role = "static"
at = [-1.0, 0.0, 0.0, 20.0]

[[object.box]]
center = [0.0, 0.0, 0.6]
size_m = [1.6, 1.0, 1.2]
colour = "#d02010"

[[object]]
name = "blue"
role = "static"
at = [1.2, 0.6, 0.0, 0.0]

[[object.cylinder]]
from = [0.0, 0.0, 0.0]
to = [0.0, 0.0, 1.4]
radius_m = 0.6
colour = "#1030d0"

[[orbit]]
view_kind = "orbit"
count = 30
center = [0.0, 0.0, 0.5]
radius_m = [6.0, 7.0]
elevation_deg = [25.0, 70.0]
"##;

const TRAINING: &str = r#"
dataset = "set"
out = "out"
seed = 3
split_seed = 5
threads = 1

[field]
levels = 6
log2_table_size = 13
max_resolution = 128
hidden_width = 32
samples_across = 64.0

[nerf]
rays = 1024

[nerf.trainer]
steps = 500
occupancy_warmup_steps = 100
threads = 1
"#;

/// An imported dataset trains the same with `--phase nerf` and with all phases. Its field renders held-out poses better
/// than their mean colours. Phases without work refuse it.
#[test]
fn an_imported_set_trains_the_field() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let scenario = Scenario::parse(Path::new("still.toml"), SCENARIO).unwrap();
    scenario.render_dataset(&path("rendered"), Extras::None, |_, _| ControlFlow::Continue(())).unwrap();
    // Without its scenario it is like any other dataset.
    let text = std::fs::read_to_string(path("rendered/transforms.json")).unwrap();
    let mut plain: serde_json::Value = serde_json::from_str(&text).unwrap();
    plain.as_object_mut().unwrap().remove("scenario");
    std::fs::write(path("rendered/transforms.json"), plain.to_string()).unwrap();
    let options = ImportOptions { bounds: Some(scenario.info().bounds), ..ImportOptions::default() };
    import(&path("rendered"), &path("set"), &options).unwrap();

    std::fs::write(path("training.toml"), TRAINING).unwrap();
    let config = TrainingConfig::load(&path("training.toml")).unwrap();
    let (stop, on_progress) = (AtomicBool::new(false), |_: &Progress| {});
    let (dataset, out) = (path("set"), path("out"));
    let training = Training {
        config: &config,
        dataset: &dataset,
        free_poses: &[],
        scenario: None,
        out: &out,
        device: tch::Device::Cpu,
    };
    let train = |phases: Phases| {
        let run = TrainingRun { dir: folder.path().to_owned(), on_progress: &on_progress, stop: &stop };
        training.run(phases, &run)
    };
    for phases in [Phases::Vae, Phases::Mixture] {
        let error = train(phases).unwrap_err();
        assert!(matches!(error, TrainingError::Unfit(_)) && error.to_string().contains("--phase nerf"), "{error}");
    }
    let figures = train(Phases::Field).unwrap();
    let views = figures.views.unwrap();
    assert_eq!((views.trained.poses, views.unseen.poses), (24, 3));

    let images = Dataset::open(&path("set")).unwrap().load_all_images().unwrap();
    let mut of_mean = 0.0;
    for image in &images {
        let pixels = image.rgb.len() / 3;
        let sum = |c: usize| image.rgb.iter().skip(c).step_by(3).map(|&v| u64::from(v)).sum::<u64>();
        let mean = [0, 1, 2].map(|c| (sum(c) / pixels as u64) as u8);
        let flat = carff_dataset::Image::filled(image.width_px, image.height_px, mean);
        of_mean += flat.psnr_db(image).unwrap() / images.len() as f64;
    }
    let held_out = views.unseen.psnr_db.unwrap();
    assert!(held_out > of_mean + 4.0, "{held_out} dB, mean colours {of_mean} dB");
    assert!(path("views.png").is_file() && path("out/field.safetensors").is_file());
    // A finished training is not repeated.
    assert_eq!(train(Phases::All).unwrap(), figures);
}

/// Every shipped training file is valid, names its scenario (except the file for imported datasets, which have none),
/// and writes to the checkpoint of its own name.
#[test]
fn every_shipped_training_file_is_valid() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    for entry in std::fs::read_dir(root.join("configs/training")).unwrap() {
        let path = entry.unwrap().path();
        let config = TrainingConfig::load(&path).unwrap();
        let name = path.file_stem().unwrap().to_str().unwrap();
        assert_eq!(config.scenario.is_some(), name != "posed-set", "{name}");
        assert!(config.scenario.is_none_or(|s| root.join(s).is_file()), "{name}");
        let out = config.out.to_str().unwrap().to_owned();
        assert!(out.ends_with(&format!("checkpoints/{name}")) || out.starts_with("runs/"), "{name}: {out}");
    }
}
