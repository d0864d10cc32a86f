//! Contracts of the results of a tiny trained scenario: every possible table, and a reason for every other one.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

mod common;

use carff_dataset::Image;
use carff_evaluation::{EvalOptions, LocalisationTable, MaskedView, MethodFigures, Results, Subject, Table, evaluate};
use carff_scenes::Detail;
use carff_training::{
    Phases,
    ablation::{self, AblationTable, Variant},
    training_curves,
};
use common::{Place, SCENARIO};

/// Networks so small that they are partly trained within seconds.
const TRAINING: &str = r#"
dataset = "set"
out = "out"
seed = 3
split_seed = 5
threads = 1

[encoder]
backbone = { kind = "efficientnet-lite0", input_px = 64 }
reduce_channels = 16
pool_channels = 8
hidden = 16

[decoder]
hidden = 16
channels = 16

[augmentation]
copies = 0

[vae]
epochs = 4
batch = 16
learning_rate = 4e-3
dropout = 0.0

[mixture]
components = 2
hidden = 32

[mdn]
steps = 60
batch = 32

[field]
levels = 4
log2_table_size = 11
max_resolution = 64
hidden_width = 32
samples_across = 32.0

[nerf]
rays = 256

[nerf.trainer]
steps = 120
occupancy_warmup_steps = 40
threads = 1
"#;

const OPTIONS: EvalOptions = EvalOptions { device: tch::Device::Cpu, threads: 1, seed: 2 };

fn train(place: &Place, phases: Phases) {
    let (set, checkpoint) = (place.at("set"), place.at("checkpoint"));
    place.run("run", None, |run| place.training(&set, &checkpoint).run(phases, run)).unwrap();
}

fn evaluated(place: &Place, tables: &[Table]) -> Results {
    let mut subject = Subject::load(&place.at("checkpoint"), &place.at("set"), OPTIONS, &|_| {}).unwrap();
    subject.training_curves = training_curves(&place.at("run")).unwrap();
    evaluate(&subject, tables, &place.at("results"), &|_| {}).unwrap()
}

/// All tables exist with consistent counts, the file equals the results in memory, and the page shows every drawn
/// image. The same seed gives the same figures. A request for one table gives only that table.
#[test]
fn every_table_is_made() {
    let place = Place::new(SCENARIO, TRAINING);
    train(&place, Phases::All);
    let results = evaluated(&place, &Table::ALL);
    let read: Results =
        serde_json::from_str(&std::fs::read_to_string(place.at("results/results.json")).unwrap()).unwrap();
    assert_eq!((&read.targets, &read.subject, &read.gallery), (&results.targets, &results.subject, &results.gallery));

    let images = results.images.as_ref().unwrap();
    let toggled = images.toggled.as_ref().unwrap();
    assert_eq!((toggled.psnr_db.len(), toggled.renderings), (4, 4));
    assert!(toggled.actor_db.is_some() && images.novel_views.unseen.as_ref().unwrap().images > 0);
    let predicted = images.predicted.as_ref().unwrap();
    assert!(predicted.psnr_db[0].is_none() && predicted.psnr_db[1].is_some(), "first steps are not forecast");

    let encoder = results.encoder.as_ref().unwrap();
    let trained = results.subject.poses.trained.unwrap() + results.subject.poses.calibration.unwrap();
    assert_eq!(encoder.svm.trained.images, 4 * trained);
    assert!(encoder.svm.trained.ceiling > 0.25 && encoder.svm.trained.ceiling <= 1.0);
    assert!(encoder.state_accuracy.unseen.unwrap().full.trials > 0);

    let recall = results.forecast.as_ref().unwrap().parts.trained.as_ref().unwrap();
    assert!(recall.accuracy.trials >= 300 && recall.recall.trials >= 200 && recall.recall.mean.len() == 50);
    assert!(recall.recall.mean.windows(2).all(|w| w[0] <= w[1]), "more samples of one trial show no less");
    assert!((recall.expected_recall[1] - 0.75).abs() < 0.2);

    let planning = results.planning.as_ref().unwrap();
    assert_eq!(planning.one_image.paper[&10].hazard.unwrap().trials, 30);
    assert!(planning.all_views.calibrated[&10].clear.unwrap().trials >= 300);
    assert!(planning.free_drives.is_none());
    assert!(results.hazard_reliability.trained.as_ref().unwrap().trials > 0);
    assert!(results.frequencies.trained.as_ref().unwrap().by_branch[0].outcomes.len() == 2);
    // Drives, unknown objects and masks need a scenario file.
    assert_eq!(
        results.left_out.keys().collect::<Vec<_>>(),
        ["horizon", "localisation", "memory", "robustness", "vehicles"],
        "{:?}",
        results.left_out
    );

    let page = std::fs::read_to_string(place.at("results/README.md")).unwrap();
    let files: Vec<&str> = page.split("](").skip(1).filter_map(|rest| rest.split(')').next()).collect();
    assert!(files.len() >= 8, "{files:?}");
    for file in files {
        assert!(Image::load(&place.at("results").join(file)).unwrap().width_px > 100, "{file}");
    }

    both_methods_localise_the_same_samples(&place);
    let again = evaluated(&place, &[Table::Recall]);
    assert_eq!(again.forecast, results.forecast);
    assert!(again.planning.is_none() && again.encoder.is_none() && again.gallery.is_none());
}

/// Localisation by density and by segmentation of views with masks: both name a state, or none, for the same samples,
/// and the same seed gives the same counts.
fn both_methods_localise_the_same_samples(place: &Place) {
    let _exclusive = common::exclusive();
    let mut subject = Subject::load(&place.at("checkpoint"), &place.at("set"), OPTIONS, &|_| {}).unwrap();
    let probe = subject.probe.as_ref().unwrap();
    let camera = carff_evaluation::view_camera(&subject.posed.dataset, probe.field());
    let names = carff_evaluation::occupants(probe.layout());
    let objects: Vec<u16> = names.iter().map(|name| place.scenario.object_of(name).unwrap()).collect();
    let masked = |state: usize| {
        let info = place.scenario.info();
        let (branch, timestamp) = (info.branch_of(state), info.timestamp_of(state));
        let rendering = place.scenario.render(branch, timestamp, &camera, Detail::Image).unwrap();
        let class = |object: &u16| objects.iter().position(|of| of == object).map_or(0, |index| index as u8 + 1);
        let classes = rendering.object_id.iter().map(class).collect();
        MaskedView { rgb: carff_evaluation::to_unit(&rendering.image.rgb), classes }
    };
    subject.masked_views = (0..subject.posed.scenario.state_count()).map(masked).collect();
    let tables = [(); 2].map(|()| {
        let results = evaluate(&subject, &[Table::Localisation], &place.at("localisation"), &|_| {}).unwrap();
        assert!(results.left_out.is_empty(), "{:?}", results.left_out);
        results.localisation.unwrap()
    });
    assert_eq!(tables[0].trained_views, subject.masked_views.len());
    let counts = |table: &LocalisationTable| {
        let figures = table.parts.trained.unwrap();
        let of = |method: MethodFigures| (method.possible, method.unknown, method.only_this_fails);
        (figures.images, figures.samples, figures.agree, of(figures.density), of(figures.segmentation))
    };
    let (images, samples, agree, density, segmentation) = counts(&tables[0]);
    assert_eq!(counts(&tables[1]), (images, samples, agree, density, segmentation));
    assert!(images > 0 && samples % images == 0 && agree <= samples);
    let possible_by_both = density.0 - segmentation.2;
    assert_eq!(possible_by_both, segmentation.0 - density.2);
    assert!(density.0 + density.1 <= samples && segmentation.0 + segmentation.1 <= samples);
}

/// A scenario with one branch has nothing to plan and no branch to recall. A checkpoint with only a trained VAE has no
/// images of a field. Each missing table is a line with the reason, not an error.
#[test]
fn what_cannot_be_is_said() {
    let single = SCENARIO
        .replace(r#"branches = ["with", "without"]"#, r#"branches = ["with"]"#)
        .replace(r#"hazard_branches = ["with"]"#, "");
    let place = Place::new(&single, TRAINING);
    train(&place, Phases::Vae);
    let results = evaluated(&place, &[Table::Psnr, Table::Encoder, Table::Recall, Table::Planning, Table::Frequencies]);
    let left_out: Vec<&str> = results.left_out.keys().map(String::as_str).collect();
    assert_eq!(left_out, ["frequencies", "planning", "psnr", "recall"]);
    assert!(results.left_out["psnr"].contains("--phase nerf"), "{:?}", results.left_out);
    assert!(results.encoder.is_some());
    let page = std::fs::read_to_string(place.at("results/README.md")).unwrap();
    assert!(page.contains("no branch in which the hazard action is right"), "{page}");
}

/// Every variant is trained and scored, an existing row is read again, and the table names all variants, each with the
/// range over its seeds.
#[test]
fn every_variant_has_a_row() {
    let mut place = Place::new(SCENARIO, TRAINING);
    place.config.vae.epochs = 1;
    let (set, out) = (place.at("set"), place.at("ablation"));
    let row = |variant: Variant| {
        let run = format!("ablation/{}/seed-{}/run", variant.name(), place.config.seed);
        place.run(&run, None, |run| ablation::row(&place.training(&set, &out), variant, run, OPTIONS).unwrap())
    };
    let mut rows: Vec<_> = Variant::ALL.into_iter().map(row).collect();
    assert!(rows.iter().all(|r| r.scores.train.psnr_db > 5.0 && r.scores.svm.trained.images > 0));
    let checkpoint = ablation::folder(&out, Variant::Full, place.config.seed).join("checkpoint");
    std::fs::remove_dir_all(&checkpoint).unwrap();
    assert_eq!(row(Variant::Full).scores.train.images, rows[0].scores.train.images);
    assert!(!checkpoint.exists(), "read, not trained again");
    let found = ablation::rows(&out).unwrap();
    assert_eq!(found, rows, "rows of earlier runs stay in the table");
    let mut other = rows[0].clone();
    other.seed += 1;
    (rows[0].scores.svm.trained_by_pose.accuracy, other.scores.svm.trained_by_pose.accuracy) = (0.5, 0.75);
    rows.push(other);
    let table = AblationTable { dataset: "set".into(), epochs: 1, free_poses: 0, rows };
    ablation::write_table(&table, &out).unwrap();
    let page = std::fs::read_to_string(out.join("README.md")).unwrap();
    for variant in Variant::ALL {
        assert!(page.contains(variant.description(&place.config)), "{variant:?}");
    }
    assert!(page.contains("| 2 | 62.5 (50.0 to 75.0) |"), "{page}");
}
