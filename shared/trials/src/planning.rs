//! The planning table (paper section 4.3): success of each decision rule over eligible input views.

use carff_base::geometry::PinholeCamera;
use carff_base::random::Key;
use carff_base::statistics::wilson_interval;
use carff_checkpoint::{Encodes, FieldProbe, Forecasts};
use carff_dataset::{
    Dataset, DatasetError, Image,
    drives::{DriveKind, EligibleInput},
    sensor::{SensorNoise, apply_noise_into},
};
use carff_decision::{
    Evidence, Feedback, ForecastInput, ImageEvidence, Memory, MemorySettings, Mixture, Plan, Policy, ProbeLayout,
    Remembered, Sampling, StepLength, TakeFrame, TakeMemory, look_ahead,
};
use carff_field::Field;
use carff_messages::{Gaussian, LATENT_DIM, Rule};
use carff_unknown::{Comparer, Comparison, Known, PlaceViews, Seen, Sighting};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::{cell::RefCell, collections::BTreeMap};

/// Numbers of samples that the table has columns for.
pub const SAMPLE_COUNTS: [usize; 3] = [2, 10, 35];

/// Number of samples of a decision, as in the shipped graphs. [`Planner::table`] returns the outcomes with this number.
pub const SAMPLES: usize = 10;
/// Smallest number of trials of a planning table, where it has enough images.
pub const LEAST_TRIALS: usize = 300;
/// Largest number of trials of one image: images that differ only in sensor noise are not independent.
pub const MOST_REPEATS: usize = 5;

/// One trial: the posterior of an input view with one correct action.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// The posterior.
    pub posterior: Gaussian,
    /// Evidence of the image for the known states, where it was compared with them.
    pub image: Option<ImageEvidence>,
    /// Forecast from all images of the take, where there is a memory.
    pub remembered: Option<Mixture>,
    /// The correct action.
    pub kind: DriveKind,
    /// Frame number, which names the random draws of this trial.
    pub frame: u64,
    /// Seed of the run.
    pub seed: u64,
}

/// Frame number of the trial `repeat` of an image: no two trials share their random draws.
pub fn trial_frame(image: usize, repeat: usize) -> u64 {
    (image * 1000 + repeat) as u64
}

/// Correct actions among trials, with a 95 % Wilson interval.
///
/// ```
/// let mut count = carff_trials::Count::default();
/// [true, true, false].into_iter().for_each(|right| count.add(right));
/// assert_eq!((count.success, count.trials), (2, 3));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Count {
    /// Correct actions.
    pub success: usize,
    /// Trials.
    pub trials: usize,
    /// 95 % interval of the success rate, `[low, high]`; `[0, 1]` for no trials.
    pub interval: [f64; 2],
}

impl Default for Count {
    fn default() -> Self {
        Self { success: 0, trials: 0, interval: wilson_interval(0, 0) }
    }
}

impl Count {
    /// Counts one trial.
    pub fn add(&mut self, right: bool) {
        self.trials += 1;
        self.success += usize::from(right);
        self.interval = wilson_interval(self.success, self.trials);
    }

    /// Success rate, 0..=1; `None` for no trials.
    pub fn rate(&self) -> Option<f64> {
        (self.trials > 0).then(|| self.success as f64 / self.trials as f64)
    }
}

/// One value for each kind of trial. A kind without a value is absent in files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ByKind<T> {
    /// Trials in which advancing is correct.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clear: Option<T>,
    /// Trials in which halting is correct.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hazard: Option<T>,
}

impl<T> Default for ByKind<T> {
    fn default() -> Self {
        Self { clear: None, hazard: None }
    }
}

impl<T> ByKind<T> {
    /// Value of one kind.
    pub fn get(&self, kind: DriveKind) -> Option<&T> {
        match kind {
            DriveKind::Hazard => self.hazard.as_ref(),
            DriveKind::Clear => self.clear.as_ref(),
        }
    }

    /// Place of the value of one kind.
    pub fn entry(&mut self, kind: DriveKind) -> &mut Option<T> {
        match kind {
            DriveKind::Hazard => &mut self.hazard,
            DriveKind::Clear => &mut self.clear,
        }
    }
}

/// Counts of one rule by number of samples.
pub type BySamples = BTreeMap<usize, ByKind<Count>>;

/// Counts by rule, number of samples, and kind of trial. A rule without trials is absent in files.
///
/// ```
/// use carff_dataset::drives::DriveKind;
/// use carff_trials::PlanningTable;
/// use carff_messages::Rule;
/// let mut table = PlanningTable::default();
/// table.add(Rule::Paper, 10, DriveKind::Hazard, true);
/// assert_eq!(table.paper[&10].hazard.unwrap().success, 1);
/// let text = serde_json::to_string(&table)?;
/// assert_eq!(serde_json::from_str::<PlanningTable>(&text)?, table);
/// assert!(serde_json::from_str::<PlanningTable>(&text.replace("paper", "papers")).is_err());
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlanningTable {
    /// Halts when the hazard probability reaches the threshold.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub calibrated: BySamples,
    /// Always advances.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub overconfident: BySamples,
    /// The paper's rule.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub paper: BySamples,
    /// Always halts.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub underconfident: BySamples,
}

impl PlanningTable {
    /// Counts one trial of a rule.
    pub fn add(&mut self, rule: Rule, samples: usize, kind: DriveKind, right: bool) {
        let by_samples = match rule {
            Rule::Underconfident => &mut self.underconfident,
            Rule::Overconfident => &mut self.overconfident,
            Rule::Paper => &mut self.paper,
            Rule::Calibrated => &mut self.calibrated,
        };
        by_samples.entry(samples).or_default().entry(kind).get_or_insert_default().add(right);
    }

    /// Names and counts of all rules, in the order of reports.
    pub fn rules(&self) -> [(&'static str, &BySamples); 4] {
        [
            ("underconfident", &self.underconfident),
            ("overconfident", &self.overconfident),
            ("paper", &self.paper),
            ("calibrated", &self.calibrated),
        ]
    }

    /// Returns true if nothing was counted.
    pub fn is_empty(&self) -> bool {
        self.rules().iter().all(|(_, by_samples)| by_samples.is_empty())
    }
}

/// The known states of a checkpoint, with which images are compared.
pub struct KnownStates<'a> {
    known: &'a Known,
    field: &'a Field,
    states: Vec<[f32; LATENT_DIM]>,
    threads: usize,
    comparer: RefCell<Comparer>,
    /// The places that images are searched for, for a belief with a memory.
    places: Option<RefCell<PlaceViews>>,
}

impl<'a> KnownStates<'a> {
    /// The known states of a probe's field. `threads` render.
    pub fn new(known: &'a Known, probe: &'a FieldProbe, threads: usize) -> Self {
        let states = probe.states().iter().map(|state| state.mean).collect();
        let comparer = RefCell::new(Comparer::new(probe.field(), &known.lanes));
        Self { known, field: probe.field(), states, threads, comparer, places: None }
    }

    /// As [`Self::new`], for a belief with a memory: evidence has what an image shows of each place, too.
    pub fn with_places(known: &'a Known, probe: &'a FieldProbe, threads: usize) -> Self {
        let places = probe.layout().places().iter().map(|place| (place.oriented_box, place.occupied_in.as_slice()));
        let places = PlaceViews::new(places, &known.lanes.own);
        Self { places: Some(RefCell::new(places)), ..Self::new(known, probe, threads) }
    }

    /// Evidence of an image for the known states; `None` for an image without pixels.
    pub fn evidence(&self, camera: &PinholeCamera, image: &Image) -> Option<ImageEvidence> {
        let compared = self.compare(camera, image)?;
        let evidence = ImageEvidence::new(&compared.seen.ratios);
        let Some(places) = &self.places else { return Some(evidence) };
        let view = (camera, image.view()?);
        let judged = (&compared.seen, &compared.comparison);
        let comparer = self.comparer.borrow();
        let field = comparer.without_own(self.field);
        let shown = places.borrow_mut().look(field, &self.states, view, judged, self.threads);
        Some(evidence.with_places(&shown))
    }

    /// Describes what an image shows of the lanes; `None` for a view of another place, or without lanes.
    pub fn sighting(&self, camera: &PinholeCamera, image: &Image) -> Option<Sighting> {
        let mut comparer = self.comparer.borrow_mut();
        let (seen, comparison) = self.see(&mut comparer, camera, image)?;
        self.known.sighting(&comparer, &comparison, &seen)
    }

    /// Compares an image; `None` for an image without pixels.
    pub fn compare(&self, camera: &PinholeCamera, image: &Image) -> Option<Compared> {
        let mut comparer = self.comparer.borrow_mut();
        let (seen, comparison) = self.see(&mut comparer, camera, image)?;
        let best = (0..seen.ratios.len()).max_by(|&a, &b| seen.ratios[a].total_cmp(&seen.ratios[b]))?;
        let rendered = comparer.rendered().nth(best)?.to_vec();
        Some(Compared { seen, comparison, best, rendered })
    }

    fn see(&self, comparer: &mut Comparer, camera: &PinholeCamera, image: &Image) -> Option<(Seen, Comparison)> {
        self.known.see(comparer, self.field, &self.states, (camera, image.view()?), self.threads)
    }
}

/// An image that was compared with the known states.
pub struct Compared {
    /// Boxes and ratios: the parts that the states leave unexplained.
    pub seen: Seen,
    /// The residuals.
    pub comparison: Comparison,
    /// The state that explains the image best.
    pub best: usize,
    /// That state, rendered from the camera's pose at the compared size: RGB, 0..=1, row by row; black where nothing was
    /// compared.
    pub rendered: Vec<f32>,
}

/// From an image to a trial, as the graph sees it: a camera with sensor noise, the encoder, and the comparison of the
/// same noisy image with the known states.
pub struct Perception<'a> {
    /// The encoder.
    pub encoder: &'a dyn Encodes,
    /// Noise of the sensor.
    pub noise: SensorNoise,
    /// Seed of the noise.
    pub seed: u64,
    /// Known states; `None` if images are not compared.
    pub known: Option<KnownStates<'a>>,
}

impl Perception<'_> {
    /// Trials of each input's image, `repeats` times with fresh sensor noise.
    pub fn trials(
        &self,
        dataset: &Dataset,
        inputs: &[EligibleInput],
        repeats: usize,
    ) -> Result<Vec<Trial>, DatasetError> {
        let mut trials = Vec::with_capacity(inputs.len() * repeats);
        for input in inputs {
            let state = dataset.scenario().and_then(|s| s.state(input.branch, input.timestamp));
            let Some(index) = state.and_then(|state| dataset.frame_index(state, input.view)) else { continue };
            let image = dataset.load_image(index)?;
            for repeat in 0..repeats {
                let shot = (&dataset.frames()[index].camera, &image);
                trials.extend(self.trial(shot, input.kind, trial_frame(index, repeat)));
            }
        }
        Ok(trials)
    }

    /// A trial of one camera's image. `frame` names its random draws.
    pub fn trial(&self, (camera, image): (&PinholeCamera, &Image), kind: DriveKind, frame: u64) -> Option<Trial> {
        self.noisy_trial((camera, image), kind, frame).map(|(trial, _)| trial)
    }

    /// As [`Self::trial`], with the noisy image.
    pub fn noisy_trial(
        &self,
        (camera, image): (&PinholeCamera, &Image),
        kind: DriveKind,
        frame: u64,
    ) -> Option<(Trial, Image)> {
        let mut noisy = image.clone();
        let key = Key { seed: self.seed, frame, step: 0, sample: 0 };
        if apply_noise_into(&image.rgb, &mut noisy.rgb, &self.noise, key).is_err() {
            // Only settings out of range are refused; those of a checkpoint were validated.
            noisy.rgb.copy_from_slice(&image.rgb);
        }
        let posterior = self.encoder.posterior_of(noisy.view()?)?;
        let image = self.known.as_ref().and_then(|known| known.evidence(camera, &noisy));
        Some((Trial { posterior, image, remembered: None, kind, frame, seed: self.seed }, noisy))
    }
}

/// The memory over the frames of a drive.
#[derive(Clone, Debug)]
pub struct TakeMemories {
    layout: ProbeLayout,
    settings: MemorySettings,
    memory: TakeMemory,
}

impl TakeMemories {
    /// Memories with the learned numbers; a time step takes `frames_per_timestamp` frames.
    pub fn new(net: &dyn Forecasts, probe: &FieldProbe, settings: MemorySettings, frames_per_timestamp: u64) -> Self {
        let layout = probe.layout().clone();
        let memory = Memory::new(&layout, probe.states().to_vec(), |state| net.forecast(state), settings);
        Self { settings, memory: TakeMemory::new(memory, StepLength::Frames(frames_per_timestamp)), layout }
    }

    /// Adds the trial of the next frame of a drive, and returns it with its memory.
    pub fn remember(&mut self, net: &dyn Forecasts, trial: Trial, frame_in_drive: u64) -> Trial {
        let frame = TakeFrame { take_start: 0, frame: frame_in_drive, capture_time_ns: 0 };
        let Remembered { forecast, states, .. } = self.memory.see(frame, &net.forecast(&trial.posterior));
        let image = trial.image.map(|image| {
            self.memory.compare(frame_in_drive, image.places());
            image.with_memory(states, &self.layout, &self.settings)
        });
        Trial { image, remembered: Some(forecast), ..trial }
    }
}

/// Result of one trial.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrialOutcome {
    /// Probability of a hazard or of something unknown over the horizon, 0..=1.
    pub hazard_probability: f32,
    /// The correct action.
    pub kind: DriveKind,
}

/// Forecast, probe and horizon behind a planning table.
#[derive(Clone, Copy)]
pub struct Planner<'a> {
    /// Posterior to mixture.
    pub net: &'a dyn Forecasts,
    /// Hypothesis to state.
    pub probe: &'a FieldProbe,
    /// Spread of the samples over the mixture's components.
    pub sampling: Sampling,
    /// Input of each further step.
    pub feedback: Feedback,
    /// Steps that are looked ahead.
    pub horizon: u32,
}

/// Returns the evidence of one trial's look-ahead.
fn evidence_of(
    probe: &mut FieldProbe,
    trial: &Trial,
    plan: Plan,
    forecast: impl FnMut(&Gaussian, ForecastInput) -> Mixture,
) -> Evidence {
    Evidence::of_steps(&look_ahead(forecast, probe, &trial.posterior, trial.image.as_ref(), plan))
}

impl Planner<'_> {
    /// Returns the evidence of each trial from `samples` samples, on all threads of rayon's pool.
    pub fn evidence(&self, trials: &[Trial], samples: usize) -> Vec<Evidence> {
        let posteriors: Vec<Gaussian> = trials.iter().map(|t| t.posterior).collect();
        let first = if posteriors.is_empty() { Vec::new() } else { self.net.forecast_all(&posteriors) };
        let later = self.net.forecast_all(self.probe.states());
        let Self { sampling, feedback, horizon, .. } = *self;
        let plan = |trial: &Trial| Plan { samples, sampling, feedback, horizon, seed: trial.seed, frame: trial.frame };
        let known = |mixture: &Mixture, trial: &Trial, input| match input {
            ForecastInput::State(state) => later[state].clone(),
            ForecastInput::Image | ForecastInput::Sample => trial.remembered.as_ref().unwrap_or(mixture).clone(),
        };
        let trials = || trials.iter().zip(&first);
        match feedback {
            Feedback::State => {
                let of_trial = |probe: &mut FieldProbe, (trial, mixture): (&Trial, &Mixture)| {
                    evidence_of(probe, trial, plan(trial), |_, input| known(mixture, trial, input))
                };
                let trials: Vec<_> = trials().collect();
                trials.into_par_iter().map_init(|| self.probe.clone(), of_trial).collect()
            }
            // A network of libtorch belongs to one thread.
            Feedback::Latent => {
                let mut probe = self.probe.clone();
                let of_trial = |(trial, mixture): (&Trial, &Mixture)| {
                    evidence_of(&mut probe, trial, plan(trial), |latent, input| match input {
                        ForecastInput::Sample => self.net.forecast(latent),
                        input => known(mixture, trial, input),
                    })
                };
                trials().map(of_trial).collect()
            }
        }
    }

    /// Runs every trial with every rule and number of samples. Outcomes, in the order of the trials, are those of 10
    /// samples.
    pub fn table(&self, trials: &[Trial], policies: &[Policy]) -> (PlanningTable, Vec<TrialOutcome>) {
        let (mut table, mut outcomes) = (PlanningTable::default(), Vec::new());
        for samples in SAMPLE_COUNTS {
            for (trial, evidence) in trials.iter().zip(self.evidence(trials, samples)) {
                for policy in policies {
                    let right = policy.decide(&evidence).halt == (trial.kind == DriveKind::Hazard);
                    table.add(policy.rule, samples, trial.kind, right);
                }
                if samples == SAMPLES {
                    let hazard_probability = evidence.hazard_or_unknown_probability() as f32;
                    outcomes.push(TrialOutcome { hazard_probability, kind: trial.kind });
                }
            }
        }
        (table, outcomes)
    }
}
