//! From pictures to a checkpoint: VAE, field, mixture density network, calibration, figures.

use crate::{
    TrainingError,
    config::{Augmentation, TrainingConfig},
    field::{self, Clouds},
    mixture::{self, Mdn},
    pictures::Pictures,
    places::places,
    run::{Progress, Run, damaged},
    vae::{self, Inputs, Vae},
};
use carff_checkpoint::CheckpointPlanning;
use carff_checkpoint::{FORMAT_VERSION, Manifest, ScenarioIdentity, SplitRecord, files, save_field};
use carff_dataset::{Observability, PoseRole, drives::eligible_inputs};
use carff_decision::{
    Calibration, CalibrationTrial, Evidence, Policy, ProbeLayout, Sampling, choose_threshold, unchosen_threshold,
};
use carff_evaluation::{Input, Models, Trial, birds_eye, planning_table, sample_accuracy, trials};
use carff_field::{Field, RenderBuffer, RenderOptions};
use carff_messages::{Gaussian, LATENT_DIM};
use carff_models::stored::save_weights;
use carff_random::Key;
use serde_json::{Value, json};
use std::path::Path;
use tch::Device;

/// Which models to train.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// All three, in order.
    All,
    /// The pose-conditional VAE.
    Vae,
    /// The field.
    Nerf,
    /// The mixture density network.
    Mdn,
}

/// Trains what `stage` says on a data set, and on the set `free` of freely drawn poses beside it, and writes what is
/// ready to the checkpoint folder `out`. Finished stages are read from their saved states; a stage that is asked for by
/// name needs those before it. VAE and mixture density network are trained on `device`, the field by its own kernels on
/// the processor.
pub fn train(
    config: &TrainingConfig,
    dataset: &Path,
    free: Option<&Path>,
    out: &Path,
    stage: Stage,
    device: Device,
    run: &Run,
) -> Result<Value, TrainingError> {
    carff_models::allocator::keep_large_blocks();
    tch::set_num_threads(config.threads);
    tch::manual_seed(config.seed as i64);
    let mut pictures = Pictures::open(dataset, config.split_seed)?;
    if let Some(free) = free {
        pictures.add_free(free)?;
    }
    let states = pictures.scenario.state_count();
    if states == 1 {
        return field_alone(config, &pictures, out, stage, run);
    }
    let places = places(&pictures.scenario)?;
    let pretrained = config.pretrained_backbone.as_deref();
    let mut vae = Vae::new(config, pictures.dataset.view_count(), states, pretrained, device)?;
    let posteriors = match finished(run, "vae", config.vae.all_epochs(), |state| vae.restore_weights(state)) {
        Ok(()) => posteriors_of(config, &pictures, &mut vae, run)?,
        Err(error) if matches!(stage, Stage::Nerf | Stage::Mdn) => return Err(error),
        Err(_) => {
            let inputs = Inputs::new(config, &pictures, &mut vae, run)?;
            vae::train(config, &pictures, &vae, &inputs, run)?;
            inputs.all_posteriors(&vae, run)?
        }
    };
    let mut metrics = json!({"vae": vae::evaluate(config, &pictures, &vae, &posteriors[0], true)?});
    let clouds = Clouds::new(&pictures, &posteriors[0])?;
    let mut manifest = Manifest { places, ..begun(config, &pictures, clouds.states()) };
    write_vae(config, &vae, out)?;

    // The mixture density network before the field: it is quick, and needs the posteriors alone.
    let mdn = Mdn::new(config, device)?;
    let mdn_ready = if matches!(stage, Stage::All | Stage::Mdn) {
        mixture::train(config, &pictures, &posteriors, &mdn, run)?;
        true
    } else {
        finished(run, "mdn", config.mdn.steps, |state| mdn.restore_weights(state)).is_ok()
    };
    if mdn_ready {
        save_weights(out, files::MIXTURE, &mdn.weights())?;
    }

    let field = if matches!(stage, Stage::All | Stage::Nerf) {
        Some(field::train(config, &pictures, &clouds, run)?)
    } else {
        run.load("nerf")?.and_then(|(_, state)| field::saved_field(config, &state))
    };
    if let Some(mut field) = field {
        // What ships is what is judged.
        field.round_to_f16();
        save_field(out, &field)?;
        manifest.field = Some(field.config().clone());
        let (prober, calibration) = calibrate_probing(&manifest, &field, &clouds, config.seed)?;
        metrics["probing"] = json!({"separations": calibration.separations(), "places": prober.places().len()});
        if let Some(view) = birds_eye(&field, &manifest.states, &pictures.dataset, config.threads.max(1) as usize)? {
            write_strip(run, "birds_eye.png", &view)?;
            metrics["birds_eye"] = serde_json::to_value(&view).unwrap_or(Value::Null);
        }
        manifest.probing = Some(calibration);
    }
    manifest.metrics = metrics;
    manifest.save(out)?;
    if manifest.probing.is_some() && mdn_ready {
        let mut models = Models::load(out)?;
        calibrate_threshold(config, &pictures, &mut models, out, run)?;
        let figures = figures(config, &pictures, &mut models, out)?;
        if let (Some(to), Some(from)) = (manifest.metrics.as_object_mut(), figures.as_object()) {
            to.extend(from.clone());
        }
        manifest.save(out)?;
    }
    run.metric(&json!({"stage": "done", "metrics": manifest.metrics}))?;
    Ok(manifest.metrics)
}

/// Of a set of one state, as imported ones are, there is nothing to encode or to forecast: the field alone is trained, on
/// one latent, and judged on the poses that were kept away from it.
fn field_alone(
    config: &TrainingConfig,
    pictures: &Pictures,
    out: &Path,
    stage: Stage,
    run: &Run,
) -> Result<Value, TrainingError> {
    if matches!(stage, Stage::Vae | Stage::Mdn) {
        return Err(TrainingError::Unfit(
            "the data set has one state: there is nothing to encode or to forecast; train the field, with `--stage nerf`"
                .into(),
        ));
    }
    let only = Gaussian { mean: [0.0; LATENT_DIM], log_variance: [-10.0; LATENT_DIM] };
    let clouds = Clouds::new(pictures, &vec![only; pictures.images.len()])?;
    let mut field = field::train(config, pictures, &clouds, run)?;
    field.round_to_f16();
    save_field(out, &field)?;
    let options = RenderOptions { threads: config.threads.max(1) as usize, ..RenderOptions::default() };
    let mut buffer = RenderBuffer::new();
    let mut strip = carff_evaluation::BirdsEye::default();
    let mut metrics = serde_json::Map::new();
    for (name, role) in [("trained", PoseRole::Rest), ("unseen", PoseRole::Unseen)] {
        let mut psnr_db = Vec::new();
        for i in pictures.with_roles(&[role]) {
            let (camera, truth) = (pictures.dataset.frames()[i].camera, &pictures.images[i]);
            field.render(&camera, &only.mean, &options, &mut buffer);
            let true_values: Vec<f32> = truth.rgb.iter().map(|&b| f32::from(b) / 255.0).collect();
            psnr_db.extend(carff_metrics::psnr_db(&buffer.rgb, &true_values));
            let alike =
                strip.truths.first().is_none_or(|t| (t.width_px, t.height_px) == (truth.width_px, truth.height_px));
            if role == PoseRole::Unseen && alike && strip.truths.len() < 8 {
                let rgb = buffer.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
                strip.pictures.push(carff_dataset::Image { rgb, ..*truth });
                strip.truths.push(truth.clone());
            }
        }
        let mean = carff_metrics::mean(&psnr_db);
        metrics.insert(name.into(), json!({"poses": psnr_db.len(), "psnr_db": mean}));
    }
    write_strip(run, "views.png", &strip)?;
    let manifest = Manifest {
        field: Some(field.config().clone()),
        metrics: json!({"views": metrics}),
        ..begun(config, pictures, vec![only])
    };
    manifest.save(out)?;
    run.metric(&json!({"stage": "done", "metrics": manifest.metrics}))?;
    Ok(manifest.metrics)
}

/// The posteriors that a finished VAE gave, from the run's folder; computed anew when they are not there.
fn posteriors_of(
    config: &TrainingConfig,
    pictures: &Pictures,
    vae: &mut Vae,
    run: &Run,
) -> Result<Vec<Vec<Gaussian>>, TrainingError> {
    match run.load_posteriors(config.augmentation.copies + 1, pictures.images.len())? {
        Some(posteriors) => Ok(posteriors),
        None => Inputs::new(config, pictures, vae, run)?.all_posteriors(vae, run),
    }
}

fn finished(
    run: &Run,
    stage: &str,
    total: usize,
    restore: impl FnOnce(&carff_models::weights::Tensors) -> bool,
) -> Result<(), TrainingError> {
    match run.load(stage)? {
        Some((done, state)) if done >= total => {
            if restore(&state) {
                Ok(())
            } else {
                Err(damaged(&run.state_path(stage)))
            }
        }
        Some((done, _)) => {
            Err(TrainingError::Unfit(format!("stage {stage} stopped at {done} of {total}: finish it first")))
        }
        None => Err(TrainingError::Unfit(format!("stage {stage} is not trained yet: run it first"))),
    }
}

/// What the manifest says before anything is trained but the states' latents.
fn begun(config: &TrainingConfig, pictures: &Pictures, states: Vec<Gaussian>) -> Manifest {
    Manifest {
        format_version: FORMAT_VERSION,
        scenario: ScenarioIdentity::of(&pictures.scenario, pictures.dataset.view_count()),
        seed: config.seed,
        split: SplitRecord {
            seed: config.split_seed,
            unseen: pictures.split.views(PoseRole::Unseen),
            calibration: pictures.split.views(PoseRole::Calibration),
        },
        encoder: config.encoder.clone(),
        decoder: config.decoder.clone(),
        mixture: config.mixture.clone(),
        field: None,
        states,
        places: Vec::new(),
        probing: None,
        training: serde_json::to_value(config).unwrap_or(Value::Null),
        metrics: Value::Null,
    }
}

/// Copies a file, whole or not at all. One that is there already under this name stays: copied onto itself it would be
/// emptied.
fn copy(from: &Path, to: &Path) -> std::io::Result<()> {
    if to.exists() && from.canonicalize()? == to.canonicalize()? {
        return Ok(());
    }
    let partial = to.with_extension("partial");
    std::fs::copy(from, &partial)?;
    std::fs::rename(&partial, to)
}

fn write_vae(config: &TrainingConfig, vae: &Vae, out: &Path) -> Result<(), TrainingError> {
    let (mut encoder, decoder, backbone) = vae.weights();
    match (&config.pretrained_backbone, config.encoder.backbone.frozen) {
        (Some(file), true) => {
            let target = out.join(files::BACKBONE);
            std::fs::create_dir_all(out)
                .and_then(|()| copy(file, &target))
                .map_err(|source| TrainingError::File { path: target, source })?;
        }
        _ => encoder.extend(backbone),
    }
    save_weights(out, files::ENCODER, &encoder)?;
    Ok(save_weights(out, files::DECODER, &decoder)?)
}

/// Latents of each known state that the prober is calibrated on.
const CALIBRATION_LATENTS: usize = 64;

fn calibrate_probing(
    manifest: &Manifest,
    field: &Field,
    clouds: &Clouds,
    seed: u64,
) -> Result<(ProbeLayout, Calibration), TrainingError> {
    let prober = ProbeLayout::new(manifest.places.clone(), manifest.scenario.hazard_states())?;
    let places = prober.places().len();
    let mut densities = vec![0.0; prober.points().len()];
    let occupancies: Vec<Vec<f32>> = (0..prober.state_count())
        .map(|state| {
            let mut rng = carff_random::stream(Key { seed, frame: state as u64, step: 0x7072_6f62, sample: 0 });
            let mut rows = Vec::with_capacity(CALIBRATION_LATENTS * places);
            for _ in 0..CALIBRATION_LATENTS {
                let latent: [f32; LATENT_DIM] = clouds.draw(state, 1.0, &mut rng);
                field.density(prober.points(), &latent, &mut densities);
                let mut row = vec![0.0; places];
                prober.occupancies(&densities, &mut row);
                rows.extend(row);
            }
            rows
        })
        .collect();
    let calibration = Calibration::fit(&prober, &occupancies)?;
    Ok((prober, calibration))
}

/// Names this use of the seed, so that no picture is altered just as it was in training.
const CALIBRATION_STREAM: u64 = 0x6361_6c69_6272_6174;

/// Chooses the calibrated rule's threshold on the calibration poses, and writes it beside the manifest.
fn calibrate_threshold(
    config: &TrainingConfig,
    pictures: &Pictures,
    models: &mut Models,
    out: &Path,
    run: &Run,
) -> Result<(), TrainingError> {
    let settings = &config.calibration;
    let unfit = |e: &dyn std::fmt::Display| TrainingError::Unfit(e.to_string());
    if pictures.scenario.hazard_branches.is_empty() {
        // Nothing is to be told apart, so nothing is chosen; no state is a hazard, and no threshold above 0 is reached.
        return CheckpointPlanning::new(config.split_seed, 0.5).save(out).map_err(|e| unfit(&e));
    }
    let inputs =
        eligible_inputs(&pictures.dataset, &pictures.split.views(PoseRole::Calibration)).map_err(|e| unfit(&e))?;
    // Altered as in training: a threshold that was chosen on pictures just as they were learned would be too sharp for
    // others.
    let altered = Augmentation { sensor: settings.sensor, ..config.augmentation.clone() };
    let mut trials = Vec::with_capacity(inputs.len() * settings.repeats);
    for input in &inputs {
        let state = input.branch * pictures.scenario.timestamps + input.timestamp;
        let Some(index) = pictures.dataset.frame_index(state, input.view) else { continue };
        for repeat in 0..settings.repeats {
            let picture = pictures.inputs(&[index], repeat, &altered, config.seed ^ CALIBRATION_STREAM);
            let frame = (index * 1000 + repeat) as u64;
            let (kind, seed) = (input.kind, config.seed);
            let posteriors = models.encoder.encode(&picture);
            trials.extend(posteriors.into_iter().map(|posterior| Trial { posterior, kind, frame, seed }));
        }
    }
    let mut found = Vec::with_capacity(trials.len());
    for trial in &trials {
        let plan = carff_decision::Plan {
            samples: settings.samples,
            sampling: Sampling::Stratified,
            horizon: settings.horizon,
            seed: trial.seed,
            frame: trial.frame,
        };
        let steps = carff_decision::look_ahead(
            |input, _| models.mixture.forecast(input),
            &mut models.probe,
            &trial.posterior,
            plan,
        );
        let hazard = Evidence::of_steps(&steps).hazard_probability();
        found.push(CalibrationTrial {
            hazard_probability: hazard,
            halt_is_right: trial.kind == carff_dataset::drives::DriveKind::Hazard,
        });
    }
    let chosen = choose_threshold(&found);
    let threshold = chosen.unwrap_or_else(|| {
        unchosen_threshold(pictures.scenario.hazard_branches.len(), pictures.scenario.branches.len())
    });
    if chosen.is_none() {
        let line = format!(
            "the calibration poses allow no trial of one kind (hazard or clear), so that nothing chooses the calibrated rule's \
             threshold: {threshold} is half of an even belief; another `split_seed` may allow them"
        );
        (run.on_progress)(&Progress { stage: "threshold", done: 1, total: 1, line });
    }
    let probabilities = |halt: bool| -> Vec<f64> {
        found.iter().filter(|t| t.halt_is_right == halt).map(|t| t.hazard_probability).collect()
    };
    run.metric(&json!({
        "stage": "threshold", "threshold": threshold, "chosen": chosen.is_some(), "trials": found.len(),
        "hazard": probabilities(true), "clear": probabilities(false),
    }))?;
    CheckpointPlanning::new(config.split_seed, threshold).save(out).map_err(|e| unfit(&e))
}

/// The figures that a checkpoint's manifest carries. The thresholds are chosen by now; nothing is chosen from these.
fn figures(
    config: &TrainingConfig,
    pictures: &Pictures,
    models: &mut Models,
    out: &Path,
) -> Result<Value, TrainingError> {
    let unfit = |e: &dyn std::fmt::Display| TrainingError::Unfit(e.to_string());
    let threshold = CheckpointPlanning::load(out).map_err(|e| unfit(&e))?.hazard_threshold;
    let rules = Policy::all(threshold);
    let mut planning = serde_json::Map::new();
    let tables = [
        ("all_views", PoseRole::Rest),
        ("calibration_views", PoseRole::Calibration),
        ("unseen_views", PoseRole::Unseen),
    ];
    for (name, role) in tables {
        let views = pictures.split.views(role);
        let inputs = eligible_inputs(&pictures.dataset, &views).map_err(|e| unfit(&e))?;
        let trials =
            trials(&models.encoder, &pictures.dataset, &inputs, 5, &config.calibration.sensor, config.seed + 1)?;
        let (table, _) = planning_table(
            &models.mixture,
            &models.probe,
            &trials,
            &rules,
            Sampling::Stratified,
            config.calibration.horizon,
        );
        planning.insert(name.into(), serde_json::to_value(table).unwrap_or(Value::Null));
    }
    let mut samples = serde_json::Map::new();
    for (name, role) in [("trained", PoseRole::Rest), ("unseen", PoseRole::Unseen)] {
        let full = |i: &usize| pictures.labels[*i].observability == Observability::Full;
        let mut inputs = Vec::new();
        for i in pictures.with_roles(&[role]).into_iter().filter(full) {
            let image = pictures.inputs(&[i], 0, &config.augmentation, config.seed + 1);
            inputs.extend(models.encoder.encode(&image).into_iter().map(|posterior| Input {
                state: pictures.labels[i].state,
                view: pictures.labels[i].view,
                posterior,
                frame: i as u64,
            }));
        }
        let table = sample_accuracy(
            &models.mixture,
            &mut models.probe,
            &inputs,
            pictures.scenario.timestamps,
            &pictures.equivalence,
            50,
            config.seed + 1,
        );
        samples.insert(
            name.into(),
            json!({"full": table, "accuracy": table.accuracy(), "possible": table.possible_share()}),
        );
    }
    Ok(json!({"planning": planning, "samples": samples}))
}

/// Rendered above true, one column a picture.
fn write_strip(run: &Run, name: &str, view: &carff_evaluation::BirdsEye) -> Result<(), TrainingError> {
    let (Some(first), columns) = (view.pictures.first(), view.pictures.len()) else { return Ok(()) };
    let (w, h) = (first.width_px as usize, first.height_px as usize);
    let mut sheet = carff_dataset::Image {
        width_px: (w * columns) as u32,
        height_px: (h * 2) as u32,
        rgb: vec![0; w * columns * h * 2 * 3],
    };
    for (row, images) in [&view.pictures, &view.truths].into_iter().enumerate() {
        for (column, image) in images.iter().enumerate() {
            for y in 0..h {
                let to = ((row * h + y) * w * columns + column * w) * 3;
                sheet.rgb[to..to + w * 3].copy_from_slice(&image.rgb[y * w * 3..(y + 1) * w * 3]);
            }
        }
    }
    Ok(sheet.save_png(&run.dir.join(name))?)
}

/// A progress line for those who have no bar.
pub fn plain_line(progress: &Progress) -> String {
    format!("{} {}/{}  {}", progress.stage, progress.done, progress.total, progress.line)
}

/// The figures of a finished training, for a person.
pub fn summary(metrics: &Value) -> String {
    let number = |path: &str| metrics.pointer(path).and_then(Value::as_f64);
    let mut lines = Vec::new();
    let mut line = |label: &str, values: &[(&str, Option<f64>, f64, &str)]| {
        let parts: Vec<String> = values
            .iter()
            .filter_map(|(name, value, scale, unit)| value.map(|v| format!("{name} {:.1}{unit}", v * scale)))
            .collect();
        if !parts.is_empty() {
            lines.push(format!("{label}: {}", parts.join(", ")));
        }
    };
    line(
        "state accuracy of latents, fully observable views",
        &[
            ("trained poses", number("/vae/trained/full/accuracy"), 100.0, " %"),
            ("unseen poses", number("/vae/unseen/full/accuracy"), 100.0, " %"),
        ],
    );
    line(
        "the same by name, where states that look the same count as wrong",
        &[
            ("trained poses", number("/vae/trained/full/raw"), 100.0, " %"),
            ("of at most", number("/vae/trained/full/raw_ceiling"), 100.0, " %"),
            ("unseen poses", number("/vae/unseen/full/raw"), 100.0, " %"),
            ("of at most", number("/vae/unseen/full/raw_ceiling"), 100.0, " %"),
        ],
    );
    line(
        "state accuracy of probed samples, fully observable views",
        &[
            ("trained poses", number("/samples/trained/accuracy"), 100.0, " %"),
            ("unseen poses", number("/samples/unseen/accuracy"), 100.0, " %"),
        ],
    );
    line(
        "the same, where every state that may come next counts as right",
        &[
            ("trained poses", number("/samples/trained/possible"), 100.0, " %"),
            ("unseen poses", number("/samples/unseen/possible"), 100.0, " %"),
        ],
    );
    line(
        "PSNR of views",
        &[
            ("trained poses", number("/views/trained/psnr_db"), 1.0, " dB"),
            ("unseen poses", number("/views/unseen/psnr_db"), 1.0, " dB"),
        ],
    );
    line(
        "bird's-eye PSNR",
        &[
            ("matching", number("/birds_eye/matching_db"), 1.0, " dB"),
            ("un-matching", number("/birds_eye/unmatching_db"), 1.0, " dB"),
            ("mean picture of all states", number("/birds_eye/mean_picture_db"), 1.0, " dB"),
            ("inside the vehicles' pixels", number("/birds_eye/changed_db"), 1.0, " dB"),
        ],
    );
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A copy is whole and takes the place of what was there; onto itself, through a link too, it changes nothing.
    #[test]
    fn a_file_survives_its_own_copy() {
        let folder = tempfile::tempdir().unwrap();
        let [from, link, to] = ["from", "link", "to"].map(|name| folder.path().join(name));
        std::fs::write(&from, "weights").unwrap();
        std::os::unix::fs::symlink(&from, &link).unwrap();
        std::fs::write(&to, "older and longer").unwrap();
        copy(&from, &to).unwrap();
        copy(&link, &from).unwrap();
        copy(&from, &from).unwrap();
        for path in [&from, &to] {
            assert_eq!(std::fs::read_to_string(path).unwrap(), "weights");
        }
        assert!(copy(&folder.path().join("none"), &to).is_err());
    }
}
