//! Subject of an evaluation: a checkpoint, a dataset of its scenario, and the posterior of each image.

use crate::trials::lane_images::LaneImage;
use crate::trials::watches::Watch;
use crate::{ByRole, Decoding, EvaluationError, MaskedView, PosedImages, Progress, ROLES};
use carff_base::geometry::PinholeCamera;
use carff_base::random::Key;
use carff_checkpoint::{
    CalibratedWith, CheckpointError, CheckpointPlanning, FieldProbe, Manifest, ScenarioIdentity, TrainedWith,
};
use carff_dataset::{
    Image,
    drives::DriveKind,
    sensor::{SensorNoise, apply_noise_into},
};
use carff_decision::{MemorySettings, Sampling};
use carff_messages::Gaussian;
use carff_networks::{
    decoder::Decoder,
    encoder::{Encoder, images_from_bytes},
    mixture::MixtureNet,
    stored::{load_decoder, load_encoder_on, load_mixture},
};
use carff_plots::Panel;
use carff_scenes::{FreePose, UnknownView};
use carff_trials::{KnownStates, Perception, Planner};
use carff_unknown::Known;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use tch::{Device, Tensor};

/// Settings of an evaluation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EvalOptions {
    /// Device of the encoder.
    pub device: Device,
    /// Threads that render and probe.
    pub threads: usize,
    /// Seed of sensor noise, draws and folds.
    pub seed: u64,
}

/// Subject and seeds of an evaluation.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointAbout {
    /// Version of the program.
    pub program_version: String,
    /// Name of the scenario.
    pub scenario: String,
    /// Names of the branches.
    pub branches: Vec<String>,
    /// Time steps of a branch.
    pub timestamps: usize,
    /// Folder of the checkpoint, as given.
    pub checkpoint: String,
    /// Folder of the dataset, as given.
    pub dataset: String,
    /// Images of the dataset.
    pub images: usize,
    /// Number of poses of each role.
    pub poses: ByRole<usize>,
    /// Seed of the training.
    pub training_seed: u64,
    /// Seed of the split of the poses.
    pub split_seed: u64,
    /// Seed of the draws of this evaluation.
    pub seed: u64,
}

/// Something unknown in the images of a scenario, from free poses.
#[derive(Clone, Debug)]
pub struct Novelty {
    /// Name in the scenario file.
    pub name: String,
    /// True if training may not use it.
    pub held_out: bool,
    /// True next to the road, where it is harmless.
    pub beside: bool,
    /// Images in which it is in sight.
    pub views: Vec<UnknownView>,
}

/// The image of a drive whose decision has one right answer.
#[derive(Clone, Debug)]
pub struct DecisiveImage {
    /// The image, without sensor noise.
    pub image: Image,
    /// The camera.
    pub camera: PinholeCamera,
    /// The right answer.
    pub kind: DriveKind,
}

/// Images that do not show the scenario's place.
#[derive(Clone, Debug)]
pub struct OtherPlace {
    /// Name of the place, or of the change of the own place's images.
    pub name: String,
    /// Images with the cameras that claim to have taken them.
    pub images: Vec<(PinholeCamera, Image)>,
}

/// A checkpoint on a dataset.
pub struct Subject {
    /// Folder of the checkpoint.
    pub checkpoint: PathBuf,
    /// Description of the checkpoint.
    pub manifest: Manifest,
    /// Image to posterior.
    pub encoder: Encoder,
    /// Posterior and pose to image.
    pub decoder: Decoder,
    /// Posterior to mixture, or the reason why it is missing.
    pub mixture: Result<MixtureNet, String>,
    /// Hypothesis to state, or the reason why it is missing.
    pub probe: Result<FieldProbe, String>,
    /// Limits of the known states, where the checkpoint has them.
    pub known: Option<Known>,
    /// Images of the dataset.
    pub posed: PosedImages,
    /// Posterior of each image without sensor noise.
    pub posteriors: Vec<Gaussian>,
    /// Threshold of the calibrated rule, where one was chosen.
    pub threshold: Option<f64>,
    /// Learned numbers of the memory, where the checkpoint has them.
    pub memory: Option<MemorySettings>,
    /// Training curves, where the folder of the training run is available.
    pub training_curves: Vec<Panel>,
    /// Decisive image of each free drive. Empty until the caller renders them.
    pub free_drives: Vec<DecisiveImage>,
    /// Free poses with one image of each branch. Empty until the caller renders them.
    pub free_poses: Vec<FreePose>,
    /// Unknown vehicles and objects of the scenario, in sight from free poses. Empty until the caller renders them.
    pub novelties: Vec<Novelty>,
    /// Images of other places. Empty until the caller renders them.
    pub other_places: Vec<OtherPlace>,
    /// Drives whose camera pans. Empty until the caller renders them.
    pub watches: Vec<Watch>,
    /// Images of each drive with another vehicle on the lane. Empty until the caller renders them.
    pub lane_drives: Vec<Vec<LaneImage>>,
    /// Views from above of every state, with masks. Empty until the caller renders them.
    pub masked_views: Vec<MaskedView>,
    /// Settings of this evaluation.
    pub options: EvalOptions,
    /// Settings of the training that the evaluation takes over.
    pub trained: TrainedWith,
}

/// Images between two progress reports.
const BATCH: usize = 8;

impl Subject {
    /// Reads checkpoint and dataset, and encodes every image.
    pub fn load(
        checkpoint: &Path,
        dataset: &Path,
        options: EvalOptions,
        on_progress: &dyn Fn(&Progress),
    ) -> Result<Self, EvaluationError> {
        let manifest = Manifest::load(checkpoint)?;
        let posed = PosedImages::open(dataset, manifest.split.seed)?;
        let given = ScenarioIdentity::of(&posed.scenario, posed.dataset.view_count());
        manifest.check_scenario(checkpoint, &given)?;
        let encoder = load_encoder_on(checkpoint, &manifest, options.device)?;
        let trained = manifest.trained_with(checkpoint)?;
        let planning = CheckpointPlanning::load(checkpoint).ok();
        let mut subject = Self {
            checkpoint: checkpoint.to_owned(),
            decoder: load_decoder(checkpoint, &manifest)?,
            mixture: or_why(load_mixture(checkpoint, &manifest))?,
            probe: or_why(carff_checkpoint::load_field_probe(checkpoint, &manifest))?,
            known: Known::load(checkpoint)?,
            posteriors: Vec::with_capacity(posed.images.len()),
            threshold: planning.map(|p| p.hazard_threshold),
            memory: planning.and_then(|p| p.memory).map(|memory| memory.settings),
            manifest,
            encoder,
            posed,
            training_curves: Vec::new(),
            free_drives: Vec::new(),
            free_poses: Vec::new(),
            novelties: Vec::new(),
            other_places: Vec::new(),
            watches: Vec::new(),
            lane_drives: Vec::new(),
            masked_views: Vec::new(),
            options,
            trained,
        };
        let total = subject.posed.images.len();
        let all: Vec<usize> = (0..total).collect();
        for chunk in all.chunks(BATCH) {
            for &i in chunk {
                let image = &subject.posed.images[i];
                let posterior = subject.encoder.encode(&as_tensor(&image.rgb, image));
                subject.posteriors.extend(posterior);
            }
            let done = subject.posteriors.len();
            on_progress(&Progress { phase: "encoding", done, total, line: String::new() });
        }
        Ok(subject)
    }

    /// Sensor noise of a camera in use: the noise under which the threshold was chosen.
    pub fn noise(&self) -> SensorNoise {
        self.trained.calibration.sensor
    }

    /// Camera in use, encoder, and comparison where the checkpoint has known states.
    pub fn perception(&self) -> Perception<'_> {
        let known = self.known.as_ref().zip(self.probe.as_ref().ok());
        Perception {
            encoder: &self.encoder,
            noise: self.noise(),
            seed: self.options.seed,
            known: known.map(|(known, probe)| KnownStates::new(known, probe, self.options.threads)),
        }
    }

    /// Forecast and probe, or the reason why one is missing.
    pub fn planner(&self, sampling: Sampling) -> Result<Planner<'_>, String> {
        let probe = self.probe.as_ref().map_err(Clone::clone)?;
        let net = self.mixture.as_ref().map_err(Clone::clone)?;
        let CalibratedWith { feedback, horizon, .. } = self.trained.calibration;
        Ok(Planner { net, probe, sampling, feedback, horizon })
    }

    /// The decoder.
    pub fn decoding(&self) -> Decoding<'_> {
        Decoding { posed: &self.posed, decoder: &self.decoder, residual: self.trained.vae.residual }
    }

    /// An image with sensor noise, `[1, 3, H, W]` in 0..=1. The noise of an image is always the same.
    pub fn noisy_input(&self, image: usize) -> Tensor {
        let key = Key::named("reca", self.options.seed, image as u64);
        let image = &self.posed.images[image];
        let mut noisy = image.rgb.clone();
        if apply_noise_into(&image.rgb, &mut noisy, &self.noise(), key).is_err() {
            // Only settings out of range are refused; those of a checkpoint were validated.
            noisy.copy_from_slice(&image.rgb);
        }
        as_tensor(&noisy, image)
    }

    /// Name of a state: its branch and its time step.
    pub fn state_name(&self, state: usize) -> String {
        let scenario = &self.posed.scenario;
        let branch = scenario.branches.get(scenario.branch_of(state)).map_or("?", String::as_str);
        format!("{branch} t{}", scenario.timestamp_of(state))
    }

    /// Returns true if two states look the same from above.
    pub fn same_from_above(&self, a: usize, b: usize) -> bool {
        self.posed.scenario.bev_view.is_some_and(|view| self.posed.equivalence.same(view, a, b))
    }

    /// Description for the results.
    pub fn about(&self) -> CheckpointAbout {
        let scenario = &self.manifest.scenario;
        let mut poses = ByRole::default();
        for role in ROLES {
            poses.set(role, self.posed.split.views(role).len());
        }
        CheckpointAbout {
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            scenario: scenario.name.clone(),
            branches: scenario.branches.clone(),
            timestamps: scenario.timestamps,
            checkpoint: self.checkpoint.display().to_string(),
            dataset: self.posed.dataset.dir().display().to_string(),
            images: self.posed.images.len(),
            poses,
            training_seed: self.manifest.seed,
            split_seed: self.manifest.split.seed,
            seed: self.options.seed,
        }
    }
}

/// Bytes of an image of the size of `image` as `[1, 3, H, W]` in 0..=1.
fn as_tensor(rgb: &[u8], image: &Image) -> Tensor {
    let sides = [1, i64::from(image.height_px), i64::from(image.width_px), 3];
    images_from_bytes(&Tensor::from_slice(rgb).view(sides))
}

/// Turns a part that is not trained yet into the reason to leave tables out. A damaged part is an error.
fn or_why<T>(part: Result<T, CheckpointError>) -> Result<Result<T, String>, CheckpointError> {
    match part {
        Err(CheckpointError::Missing { part, phase, .. }) => {
            Ok(Err(format!("the checkpoint has no {part} (`carff train --phase {phase}` makes it)")))
        }
        other => other.map(Ok),
    }
}
