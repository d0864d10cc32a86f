//! Decisions on images that no training has seen: corrupted ones, unknown vehicles and objects, other places.

use crate::trials::views::{TrialView, free_views};
use crate::{Progress, Subject};
use carff_base::geometry::PinholeCamera;
use carff_base::random::Key;
use carff_checkpoint::CheckpointPlanning;
use carff_dataset::{Corruption, Image, drives::DriveKind};
use carff_decision::{Policy, Sampling};
use carff_messages::{Header, ImageCheck, Rule};
use carff_trials::{Count, SAMPLES};
use carff_unknown::{CameraCheck, Known, Measurement};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// First frame number of these images, which share no random draws with other trials.
const FIRST: u64 = 1 << 42;
/// First frame number of free drives.
const FIRST_DRIVE: u64 = FIRST + (1 << 32);
/// Time between two checked images, nanoseconds; the checks of an evaluation have no clock.
const APART_NS: u64 = 100_000_000;

/// Decisions on images with something unknown in sight.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoveltyFigures {
    /// True if training may not use it.
    pub held_out: bool,
    /// True next to the road, where it is harmless.
    pub beside: bool,
    /// Images answered with `advance`.
    pub advances: usize,
    /// Images answered with `advance` without the comparison with the known states.
    pub advances_without_comparison: usize,
    /// Images with a probability of hazard or unknown below 0.05.
    pub below_5_percent: usize,
    /// Images, each from a pose of its own.
    pub trials: usize,
}

/// Decisions on images that do not show the scenario's place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OtherPlaceFigures {
    /// Images answered with `advance`.
    pub advances: usize,
    /// Images answered with `advance` without the comparison with the known states.
    pub advances_without_comparison: usize,
    /// Images.
    pub trials: usize,
}

/// Decisions on free drives, against the bound that the threshold was chosen by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoundFigures {
    /// Largest share of advances where the hazard is there; absent for a threshold without a bound.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub level: Option<f64>,
    /// Share of the drives with the hazard that are answered with `advance`.
    pub found: f64,
    /// 95 % interval of that share.
    pub interval: [f64; 2],
    /// Drives with the hazard.
    pub drives: usize,
    /// Drives without it that are answered with `advance`.
    pub kept: usize,
    /// Drives without it.
    pub clear_drives: usize,
}

/// Decisions on images with one corruption.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CorruptionFigures {
    /// Hazard images answered with `advance`.
    pub r#unsafe: usize,
    /// Images with a hazard that is visible, in part or hidden.
    pub hazard_trials: usize,
    /// Clear images answered with `advance`.
    pub kept: usize,
    /// Clear images that would be answered with `advance` without the comparison with the known states.
    #[serde(default)]
    pub kept_without_comparison: usize,
    /// Clear images that the check of the camera refuses.
    #[serde(default)]
    pub refused: usize,
    /// Images of a visible clear place.
    pub clear_trials: usize,
}

/// Figures by corruption and severity; `clean` has severity 0.
pub type ByCorruption = BTreeMap<String, BTreeMap<u8, CorruptionFigures>>;

/// Decisions on what no training has seen.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Robustness {
    /// Corrupted images.
    pub corruptions: ByCorruption,
    /// Unknown vehicles and objects, by name.
    pub unknown: BTreeMap<String, NoveltyFigures>,
    /// Images of other places, by name.
    #[serde(default)]
    pub other_places: BTreeMap<String, OtherPlaceFigures>,
    /// Free drives against the bound.
    #[serde(default)]
    pub bound: BoundFigures,
}

/// An image to decide on.
struct Shot<'a> {
    image: Image,
    camera: &'a PinholeCamera,
    frame: u64,
}

/// The decision on one image.
struct Verdict {
    usable: bool,
    advances: bool,
    advances_without_comparison: bool,
    probability: f64,
}

/// Computes the table, or returns the reason why there is none.
pub fn robustness(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<Robustness, String> {
    super::planning::plannable(subject)?;
    if subject.free_poses.is_empty() {
        return Err("there are no free poses: the dataset has no scenario file".into());
    }
    let known = subject.known.as_ref().ok_or("the checkpoint has no known.json (`carff checkpoint known` makes it)")?;
    let threshold = subject.threshold.ok_or("the checkpoint has no threshold")?;
    let judge = Judge { subject, known, policy: Policy::new(Rule::Calibrated, threshold) };
    let mut table = Robustness::default();
    for novelty in &subject.novelties {
        let shots = novelty.views.iter().enumerate().map(|(i, view)| Shot {
            image: view.image.clone(),
            camera: &view.camera,
            frame: FIRST + i as u64,
        });
        let verdicts = judge.verdicts(&shots.collect::<Vec<_>>())?;
        let count = |holds: &dyn Fn(&Verdict) -> bool| verdicts.iter().filter(|v| holds(v)).count();
        let figures = NoveltyFigures {
            held_out: novelty.held_out,
            beside: novelty.beside,
            advances: count(&|v| v.advances),
            advances_without_comparison: count(&|v| v.advances_without_comparison),
            below_5_percent: count(&|v| v.probability < 0.05),
            trials: verdicts.len(),
        };
        table.unknown.insert(novelty.name.clone(), figures);
        let (done, total) = (table.unknown.len(), subject.novelties.len());
        on_progress(&Progress { phase: "unknown", done, total, line: novelty.name.clone() });
    }
    for other in &subject.other_places {
        let shots = other.images.iter().enumerate().map(|(i, (camera, image))| Shot {
            image: image.clone(),
            camera,
            frame: FIRST + i as u64,
        });
        let verdicts = judge.verdicts(&shots.collect::<Vec<_>>())?;
        let figures = OtherPlaceFigures {
            advances: verdicts.iter().filter(|v| v.advances).count(),
            advances_without_comparison: verdicts.iter().filter(|v| v.advances_without_comparison).count(),
            trials: verdicts.len(),
        };
        table.other_places.insert(other.name.clone(), figures);
    }
    table.bound = judge.bound()?;
    let views = free_views(&subject.free_poses, &subject.posed.scenario);
    let mut cells: Vec<(Option<Corruption>, u8)> = vec![(None, 0)];
    cells.extend(Corruption::ALL.into_iter().flat_map(|c| c.severities().map(move |s| (Some(c), s))));
    let total = cells.len();
    for (done, (corruption, severity)) in cells.into_iter().enumerate() {
        let name = corruption.map_or("clean", Corruption::name);
        let figures = judge.corrupted(&views, corruption, severity)?;
        table.corruptions.entry(name.to_owned()).or_default().insert(severity, figures);
        on_progress(&Progress { phase: "corruptions", done: done + 1, total, line: name.to_owned() });
    }
    Ok(table)
}

struct Judge<'a> {
    subject: &'a Subject,
    known: &'a Known,
    policy: Policy,
}

impl Judge<'_> {
    fn bound(&self) -> Result<BoundFigures, String> {
        let drives = &self.subject.free_drives;
        let shots = drives.iter().enumerate().map(|(i, drive)| Shot {
            image: drive.image.clone(),
            camera: &drive.camera,
            frame: FIRST_DRIVE + i as u64,
        });
        let verdicts = self.verdicts(&shots.collect::<Vec<_>>())?;
        let (mut hazard, mut clear) = (Count::default(), Count::default());
        for (drive, verdict) in drives.iter().zip(&verdicts) {
            let of_kind = if drive.kind == DriveKind::Hazard { &mut hazard } else { &mut clear };
            of_kind.add(verdict.advances);
        }
        let planning = CheckpointPlanning::load(&self.subject.checkpoint).map_err(|e| e.to_string())?;
        Ok(BoundFigures {
            level: planning.bound.map(|bound| bound.level),
            found: hazard.rate().unwrap_or_default(),
            interval: hazard.interval,
            drives: hazard.trials,
            kept: clear.success,
            clear_drives: clear.trials,
        })
    }

    fn corrupted(
        &self,
        views: &[TrialView],
        corruption: Option<Corruption>,
        severity: u8,
    ) -> Result<CorruptionFigures, String> {
        let counts = |view: &&TrialView| view.hazard || view.kind == "clear_visible";
        let mut shots = Vec::new();
        for view in views.iter().filter(counts) {
            let key = Key::named("corr", self.subject.options.seed, view.frame);
            let image = match corruption {
                Some(corruption) => corruption.apply(view.image, severity, key).map_err(|e| e.to_string())?,
                None => view.image.clone(),
            };
            shots.push(Shot { image, camera: view.camera, frame: FIRST + view.frame });
        }
        let mut figures = CorruptionFigures::default();
        for (view, verdict) in views.iter().filter(counts).zip(self.verdicts(&shots)?) {
            if view.hazard {
                figures.hazard_trials += 1;
                figures.r#unsafe += usize::from(verdict.advances);
            } else {
                figures.clear_trials += 1;
                figures.kept += usize::from(verdict.advances);
                figures.kept_without_comparison += usize::from(verdict.advances_without_comparison);
                figures.refused += usize::from(!verdict.usable);
            }
        }
        Ok(figures)
    }

    /// Decides on images behind a camera with sensor noise, as the graph does: the check of the camera, the encoder's
    /// path, and the comparison with the known states.
    fn verdicts(&self, shots: &[Shot]) -> Result<Vec<Verdict>, String> {
        let planner = self.subject.planner(Sampling::Stratified)?;
        let perception = self.subject.perception();
        let (mut trials, mut usable) = (Vec::new(), Vec::new());
        for shot in shots {
            let taken = perception.noisy_trial((shot.camera, &shot.image), DriveKind::Hazard, shot.frame);
            let (trial, noisy) = taken.ok_or_else(|| "an image cannot be encoded".to_owned())?;
            usable.push(self.is_usable(&noisy, shot.camera));
            trials.push(trial);
        }
        let with = planner.evidence(&trials, SAMPLES);
        for trial in &mut trials {
            trial.image = None;
        }
        let without = planner.evidence(&trials, SAMPLES);
        let verdict = |((with, without), usable): ((_, _), bool)| {
            let advances = |evidence| usable && !self.policy.decide(evidence).halt;
            Verdict {
                usable,
                advances: advances(with),
                advances_without_comparison: advances(without),
                probability: if usable { with.hazard_or_unknown_probability() } else { 1.0 },
            }
        };
        Ok(with.iter().zip(&without).zip(usable).map(verdict).collect())
    }

    /// The check of the camera, of a single image.
    fn is_usable(&self, image: &Image, camera: &PinholeCamera) -> bool {
        let mut check = ImageCheck::of_frame(Header::default());
        let frame = Measurement {
            capture_time_ns: APART_NS,
            now_ns: APART_NS,
            field_of_view_deg: camera.field_of_view_deg(),
            has_pose: true,
        };
        if let Some(view) = image.view() {
            CameraCheck::new(Some(self.known.camera), None).check(view, frame, &mut check);
        }
        check.is_usable()
    }
}
