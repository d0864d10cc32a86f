//! Planning tables of a run of the graph: every rule over the run's drives, and over every eligible view. The networks
//! are those of the stages: the encoder in ONNX Runtime, the mixture density network in native code.

mod filmstrip;
mod memory;

pub use memory::TakenImage;

use crate::onnx::OnnxEncoder;
use crate::planning::{KnownStates, LEAST_TRIALS, MOST_REPEATS, Perception, Planner};
use crate::{Count, EvaluationError, PlanningTable, SAMPLE_COUNTS};
use carff_checkpoint::{CheckpointPlanning, FieldProbe, Manifest, load_field_probe};
use carff_dataset::{
    Dataset, Observability, PoseRole, PoseSplit, ScenarioInfo,
    drives::{DriveKind, EligibleInput, eligible_inputs},
    sensor::SensorNoise,
};
use carff_decision::{
    Evidence, Feedback, ForecastInput, ImageEvidence, Plan, Policy, Sampling, Step, StepLength, look_ahead,
};
use carff_inference::MixtureNet;
use carff_messages::{Gaussian, Rule};
use carff_scenes::Scenario;
use carff_unknown::Known;
use memory::RunMemory;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;

/// Settings of the run that is judged.
#[derive(Debug)]
pub struct RunSettings {
    /// Name of the run.
    pub run: String,
    /// Folder of the dataset.
    pub dataset: PathBuf,
    /// Folder of the checkpoint.
    pub checkpoint: PathBuf,
    /// Scenario from which free drives are rendered; `None` for other runs.
    pub free: Option<Scenario>,
    /// Frames of a free drive between two states.
    pub frames_per_timestamp: usize,
    /// Rule of the controller.
    pub rule: Rule,
    /// Threshold of the calibrated rule.
    pub threshold: f64,
    /// Samples of each step.
    pub samples: usize,
    /// Spread of the samples over the mixture's components.
    pub sampling: Sampling,
    /// Input of each further step.
    pub feedback: Feedback,
    /// Steps that are looked ahead.
    pub horizon: u32,
    /// True if images were compared with the known states.
    pub compares: bool,
    /// True if a belief rests on the comparison of the image before.
    pub compares_late: bool,
    /// True if something unknown means nothing to the rules.
    pub ignores_unknown: bool,
    /// Length of a time step, if the forecaster has a memory.
    pub remembers: Option<StepLength>,
    /// Noise of the camera.
    pub noise: SensorNoise,
    /// Seed of the split into trained and held-out poses.
    pub split_seed: u64,
    /// Seed of the run.
    pub seed: u64,
}

/// A camera frame of a drive on which the controller decided.
#[derive(Clone, Debug, PartialEq)]
pub struct DecidedFrame {
    /// Frame number in the run.
    pub frame: u64,
    /// Number of the drive.
    pub drive: u64,
    /// Number of earlier frames of the drive.
    pub frame_in_drive: usize,
    /// Hidden branch.
    pub branch: usize,
    /// Time step of the branch.
    pub timestamp: usize,
    /// Camera pose; `None` for a free pose.
    pub view: Option<usize>,
    /// Visibility of the actor's place, where known.
    pub observability: Option<Observability>,
    /// Posterior of the encoder, where it was recorded.
    pub posterior: Option<Gaussian>,
    /// Evidence of the image, if it was compared with the known states.
    pub image: Option<ImageEvidence>,
    /// Evidence of the graph's belief, where every step of it was recorded.
    pub evidence: Option<Evidence>,
    /// True if the action was not an advance.
    pub halted: bool,
    /// Hazard probability of the decision.
    pub hazard_probability: f32,
    /// Reason of the action, where it is not the belief.
    pub other_reason: Option<String>,
}

/// Selects the frame of each drive whose decision counts: the last decided frame of the first timestamp at which the
/// drive is a trial by [`ScenarioInfo::trial_kind`].
pub fn decisive_frames(
    frames: impl IntoIterator<Item = DecidedFrame>,
    scenario: &ScenarioInfo,
) -> Vec<(DecidedFrame, DriveKind)> {
    let mut by_drive: BTreeMap<u64, (DecidedFrame, DriveKind)> = BTreeMap::new();
    for frame in frames {
        let Some(kind) = scenario.trial_kind(frame.branch, frame.timestamp, frame.observability) else { continue };
        match by_drive.get(&frame.drive) {
            Some((there, _)) if there.timestamp < frame.timestamp => {}
            _ => {
                by_drive.insert(frame.drive, (frame, kind));
            }
        }
    }
    by_drive.into_values().collect()
}

/// Correct decisions of a run's drives, under the rule and the samples that drove: `drives` of its report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveCounts {
    /// Rule of the controller.
    pub rule: String,
    /// Requested samples of each step.
    pub samples: usize,
    /// Drives in which halting is correct.
    pub hazard: Count,
    /// Drives in which advancing is correct.
    pub clear: Count,
}

impl DriveCounts {
    /// Counts the decisive frames.
    ///
    /// ```
    /// use carff_trials::run::DriveCounts;
    /// let counts = DriveCounts::of(carff_messages::Rule::Calibrated, 10, &[]);
    /// assert_eq!((counts.hazard.trials, counts.hazard.interval), (0, [0.0, 1.0]));
    /// ```
    pub fn of(rule: Rule, samples: usize, decisive: &[(DecidedFrame, DriveKind)]) -> Self {
        let mut counts =
            Self { rule: rule.name().to_owned(), samples, hazard: Count::default(), clear: Count::default() };
        for (frame, kind) in decisive {
            match kind {
                DriveKind::Hazard => counts.hazard.add(frame.halted),
                DriveKind::Clear => counts.clear.add(!frame.halted),
            }
        }
        counts
    }

    /// The counts as text, one line for each kind of drive.
    pub fn text(&self) -> String {
        let [hazard, clear] = [self.hazard, self.clear].map(|count| share(Some(count)));
        format!(
            "Drives of this run, correct decisions of the rule `{}` with {} samples, 95 % interval\n  \
             hazard, not shown: halts       {hazard}\n  clear, in full view: advances  {clear}",
            self.rule, self.samples
        )
    }
}

/// Planning tables of a run: `planning` of its report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunPlanning {
    /// Threshold of the calibrated rule.
    pub threshold: f64,
    /// Agreement of the run with the library.
    pub live: LiveAgreement,
    /// Drives of the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drives: Option<PlanningTable>,
    /// Free drives of the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub free_drives: Option<PlanningTable>,
    /// Every eligible image of trained poses that chose no setting.
    pub all_views: PlanningTable,
    /// Every eligible image of held-out poses.
    pub unseen_views: PlanningTable,
    /// Images behind the tables of views.
    pub views: RunViews,
}

/// Decisions of the graph against those of the library.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LiveAgreement {
    /// Rule of the controller.
    pub rule: String,
    /// Samples of each step.
    pub samples: usize,
    /// Compared decisions.
    pub compared: usize,
    /// Decisions that are those of the library.
    pub agrees_with_library: usize,
    /// For each rule: its decision on the graph's belief against its decision on the library's.
    #[serde(default)]
    pub rules: BTreeMap<String, RuleAgreement>,
}

/// Decisions of one rule on the beliefs of the graph, against those on the library's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RuleAgreement {
    /// Compared decisions.
    pub compared: usize,
    /// Decisions with equal action and confidence.
    pub agrees_with_library: usize,
}

/// Images behind the tables of views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunViews {
    /// Trained poses that chose no setting.
    pub all_views: RunViewCounts,
    /// Held-out poses.
    pub unseen_views: RunViewCounts,
}

/// Number of images of each kind, and of the trials of each image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunViewCounts {
    /// Images in which halting is correct.
    pub hazard: usize,
    /// Images in which advancing is correct.
    pub clear: usize,
    /// Trials of each image.
    pub repeats: usize,
}

/// A run with its dataset and models.
pub struct JudgedRun {
    settings: RunSettings,
    dataset: Dataset,
    scenario: ScenarioInfo,
    manifest: Manifest,
    probe: FieldProbe,
    /// Known states, where images were compared with them.
    known: Option<Known>,
    /// The forecaster as the graph computes it: the same bits.
    forecaster: MixtureNet,
    /// The memory at each frame of the run; `None` without a memory.
    remembered: Option<RunMemory>,
}

impl JudgedRun {
    /// Reads dataset and models of a run.
    ///
    /// `images` are those of the run, in the order of their frames: a memory rests on all images of a take.
    pub fn load(settings: RunSettings, images: &[TakenImage]) -> Result<Self, EvaluationError> {
        let dataset = Dataset::open(&settings.dataset)?;
        let scenario =
            dataset.scenario().cloned().ok_or_else(|| EvaluationError::Unfit("it has no scenario".into()))?;
        let manifest = Manifest::load(&settings.checkpoint)?;
        let probe = load_field_probe(&settings.checkpoint, &manifest)?;
        let forecaster = MixtureNet::load(&settings.checkpoint, &manifest)?;
        let known = if settings.compares { Known::load(&settings.checkpoint)? } else { None };
        let learned = CheckpointPlanning::load(&settings.checkpoint)?.memory;
        let remembered = learned
            .zip(settings.remembers)
            .map(|(learned, step)| RunMemory::new(&forecaster, &probe, learned.settings, step, images));
        Ok(Self { settings, dataset, scenario, manifest, probe, known, forecaster, remembered })
    }

    /// Scenario of the run.
    pub fn scenario(&self) -> &ScenarioInfo {
        &self.scenario
    }

    /// Computes the planning tables from the decisive frames of the run.
    /// `progress` receives the present step.
    pub fn planning(
        &self,
        decisive: &[(DecidedFrame, DriveKind)],
        progress: impl Fn(String),
    ) -> Result<RunPlanning, EvaluationError> {
        progress("planning tables, 1 of 3: the drives".to_owned());
        let (drives, live) = self.drives_table(decisive);
        let encoder = OnnxEncoder::load(&self.settings.checkpoint, &self.manifest)?;
        let split = PoseSplit::for_dataset(&self.dataset, self.settings.split_seed);
        progress("planning tables, 2 of 3: every eligible image of trained poses".to_owned());
        let (all_views, of_all) = self.views_table(&encoder, &split.views(PoseRole::Rest))?;
        progress("planning tables, 3 of 3: every eligible image of held-out poses".to_owned());
        let (unseen_views, of_unseen) = self.views_table(&encoder, &split.views(PoseRole::Unseen))?;
        encoder.finish()?;
        let (drives, free_drives) =
            if self.settings.free.is_some() { (None, Some(drives)) } else { (Some(drives), None) };
        let views = RunViews { all_views: of_all, unseen_views: of_unseen };
        Ok(RunPlanning {
            threshold: self.settings.threshold,
            live,
            drives,
            free_drives,
            all_views,
            unseen_views,
            views,
        })
    }

    /// Looks ahead from the posterior of a frame, with the random numbers of the run: with the run's number of samples,
    /// these are the samples of the run. `None` when no posterior was recorded.
    fn look_ahead(&self, probe: &mut FieldProbe, frame: &DecidedFrame, samples: usize) -> Option<Vec<Step>> {
        let RunSettings { sampling, feedback, horizon, seed, .. } = self.settings;
        let plan = Plan { samples, sampling, feedback, horizon, seed, frame: frame.frame };
        let remembered = match &self.remembered {
            Some(memory) => Some((memory, memory.of(frame.frame)?)),
            None => None,
        };
        let forecast = |input: &Gaussian, source| match (source, remembered) {
            (ForecastInput::Image, Some((_, remembered))) => remembered.forecast.clone(),
            _ => self.forecaster.forecast(input),
        };
        let image = frame.image.clone().map(|image| match remembered {
            Some((memory, remembered)) => {
                // The memory has counted the places of earlier images.
                let image = if self.settings.compares_late { image.with_places(&[]) } else { image };
                memory.weighed(image, remembered, probe.layout())
            }
            None => image,
        });
        Some(look_ahead(forecast, probe, &frame.posterior?, image.as_ref(), plan))
    }

    /// Every rule with the run's settings.
    fn policies(&self) -> [Policy; Rule::ALL.len()] {
        let RunSettings { threshold, ignores_unknown, .. } = self.settings;
        Policy::all(threshold).map(|policy| Policy { ignores_unknown, ..policy })
    }

    /// Every rule over the drives of the run, and the agreement of the run with the library.
    fn drives_table(&self, decisive: &[(DecidedFrame, DriveKind)]) -> (PlanningTable, LiveAgreement) {
        let mut probe = self.probe.clone();
        let mut table = PlanningTable::default();
        let mut live = LiveAgreement {
            rule: self.settings.rule.name().to_owned(),
            samples: self.settings.samples,
            ..LiveAgreement::default()
        };
        for (frame, kind) in decisive {
            for samples in SAMPLE_COUNTS {
                let Some(steps) = self.look_ahead(&mut probe, frame, samples) else { continue };
                let evidence = Evidence::of_steps(&steps);
                let believed = frame.evidence.filter(|_| samples == live.samples);
                for policy in self.policies() {
                    if let Some(believed) = &believed {
                        let rule = live.rules.entry(policy.rule.name().to_owned()).or_default();
                        rule.compared += 1;
                        rule.agrees_with_library += usize::from(policy.decide(believed) == policy.decide(&evidence));
                    }
                    let mut halted = policy.decide(&evidence).halt;
                    if policy.rule == self.settings.rule && samples == live.samples {
                        // The table counts the action of the graph, not the action of the library.
                        live.compared += 1;
                        live.agrees_with_library += usize::from(frame.halted == halted);
                        halted = frame.halted;
                    }
                    table.add(policy.rule, samples, *kind, halted == (*kind == DriveKind::Hazard));
                }
            }
        }
        (table, live)
    }

    /// Every rule over all eligible images of some poses, and the number of images.
    fn views_table(
        &self,
        encoder: &OnnxEncoder,
        views: &[usize],
    ) -> Result<(PlanningTable, RunViewCounts), EvaluationError> {
        let RunSettings { sampling, feedback, horizon, noise, seed, .. } = self.settings;
        let inputs = eligible_inputs(&self.dataset, views)?;
        let of = |kind| inputs.iter().filter(|i: &&EligibleInput| i.kind == kind).count();
        let counts = RunViewCounts {
            hazard: of(DriveKind::Hazard),
            clear: of(DriveKind::Clear),
            repeats: LEAST_TRIALS.div_ceil(inputs.len().max(1)).min(MOST_REPEATS),
        };
        let (probe, net) = (&self.probe, &self.forecaster);
        let known = self.known.as_ref().map(|known| KnownStates::new(known, probe, 1));
        let trials = Perception { encoder, noise, seed, known }.trials(&self.dataset, &inputs, counts.repeats)?;
        let (table, _) = Planner { net, probe, sampling, feedback, horizon }.table(&trials, &self.policies());
        Ok((table, counts))
    }
}

impl RunPlanning {
    /// The tables as text.
    ///
    /// ```
    /// use carff_dataset::drives::DriveKind;
    /// use carff_trials::run::RunPlanning;
    /// use carff_messages::Rule;
    /// let mut planning = RunPlanning::default();
    /// planning.all_views.add(Rule::Paper, 2, DriveKind::Clear, true);
    /// assert!(planning.text().contains("1/1 = 100.0 %"));
    /// ```
    pub fn text(&self) -> String {
        let times = |v: &RunViewCounts| {
            let (hazard, clear, repeats) = (v.hazard, v.clear, v.repeats);
            format!(" ({hazard} hazard and {clear} clear images, each {repeats} times with fresh sensor noise)")
        };
        let tables = [
            ("drives of this run", self.drives.as_ref(), String::new()),
            ("free drives of this run, from free poses", self.free_drives.as_ref(), String::new()),
            ("every eligible view of trained poses", Some(&self.all_views), times(&self.views.all_views)),
            ("every eligible view of held-out poses", Some(&self.unseen_views), times(&self.views.unseen_views)),
        ];
        let mut out = String::new();
        let _ = writeln!(out, "\nPlanning: correct actions out of trials, with 95 % interval of the rate");
        for (title, table, times) in tables {
            let Some(table) = table else { continue };
            let _ = writeln!(out, "\n  {title}{times}");
            let _ = writeln!(out, "  {:<15} {:>3}  {:<32} {:<32}", "rule", "n", "hazard: halts", "clear: advances");
            for (rule, by_samples) in table.rules() {
                for samples in SAMPLE_COUNTS {
                    let counts = by_samples.get(&samples).copied().unwrap_or_default();
                    let (hazard, clear) = (share(counts.hazard), share(counts.clear));
                    let _ = writeln!(out, "  {rule:<15} {samples:>3}  {hazard:<32} {clear}");
                }
            }
        }
        out
    }
}

/// One count of a table as text; a dash for no trials.
fn share(count: Option<Count>) -> String {
    let text = count.and_then(|c| {
        let [rate, low, high] = [c.rate()?, c.interval[0], c.interval[1]].map(|v| 100.0 * v);
        Some(format!("{}/{} = {rate:.1} % [{low:.1}, {high:.1}]", c.success, c.trials))
    });
    text.unwrap_or_else(|| "-".to_owned())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A frame of the first timestamp of a drive that hides the actor's place.
    pub(crate) fn frame() -> DecidedFrame {
        DecidedFrame {
            frame: 0,
            drive: 0,
            frame_in_drive: 0,
            branch: 0,
            timestamp: 0,
            view: Some(0),
            observability: Some(Observability::None),
            posterior: None,
            image: None,
            evidence: None,
            halted: true,
            hazard_probability: 0.5,
            other_reason: None,
        }
    }

    /// The last frame of the first timestamp with one correct action counts in each drive: hidden in a hazard branch,
    /// fully visible in another branch, and never the last timestamp.
    #[test]
    fn decisive_frames_are_those_with_one_right_answer() {
        let at = |frame, drive, timestamp, branch, observability| DecidedFrame {
            frame,
            branch,
            timestamp,
            drive,
            observability: Some(observability),
            ..super::tests::frame()
        };
        let frames = [
            at(0, 0, 0, 0, Observability::None),
            at(1, 0, 0, 0, Observability::None),
            at(3, 0, 1, 0, Observability::None),
            at(4, 1, 0, 1, Observability::None),
            at(5, 1, 1, 1, Observability::Full),
            at(6, 1, 2, 1, Observability::Full),
            at(7, 2, 0, 0, Observability::Full),
            at(8, 3, 2, 0, Observability::None),
        ];
        let scenario = ScenarioInfo {
            name: "test".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["hazard".into(), "clear".into()],
            timestamps: 3,
            step_s: None,
            bev_view: None,
            states: Vec::new(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        let found: Vec<_> = decisive_frames(frames, &scenario).iter().map(|(f, kind)| (f.frame, *kind)).collect();
        assert_eq!(found, [(1, DriveKind::Hazard), (5, DriveKind::Clear)]);
    }

    /// The text has each count with its interval, and a dash for no trials.
    #[test]
    fn tables_become_text() {
        let count = Count { success: 29, trials: 30, interval: [0.833, 0.994] };
        let mut drives = PlanningTable::default();
        drives.paper.entry(10).or_default().hazard = Some(count);
        let text = RunPlanning { drives: Some(drives), ..RunPlanning::default() }.text();
        let line = text.lines().find(|l| l.contains("29/30")).unwrap();
        assert_eq!(line.split_whitespace().collect::<Vec<_>>()[..2], ["paper", "10"]);
        assert!(line.contains("29/30 = 96.7 % [83.3, 99.4]") && line.trim_end().ends_with('-'), "{line}");
        assert!(!text.contains("free drives"), "{text}");
    }
}
