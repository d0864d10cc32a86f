//! Evaluation of a trained scenario: accuracy, images and planning, as tables and as one page.
//!
//! Tables are computed with the library functions that the stages run. Every table gives its trials, and separates
//! held-out poses from trained ones. Nothing here trains a model of a checkpoint or chooses a setting; baselines are
//! fitted where a table needs them.
//!
//! | module | content |
//! |---|---|
//! | `posed`, `accuracy`, `decoded` | the labelled images, and what the models make of them |
//! | `segmentation` | localisation by segmentation of rendered views |
//! | `trials` | images with known answers, baselines, watches |
//! | `stats` | arithmetic on trials: recall curves, frequencies, support vector machine, SSIM |
//! | `tables`, `report` | the tables of `carff eval`, `results.json` and its page |

mod accuracy;
mod decoded;
mod posed;
mod report;
mod role;
mod segmentation;
mod stats;
mod subject;
mod tables;
mod trials;

pub use accuracy::{Centroids, state_accuracy};
pub use carff_trials::{
    Accuracy, BirdsEye, ByKind, ByObservability, BySamples, CheckpointFigures, Count, DecodedQuality, EvaluationError,
    FieldRenderer, KnownStates, Perception, Planner, PlanningFigures, PlanningTable, ProbingFigures, SAMPLE_COUNTS,
    SAMPLES, SampleAccuracy, SampleFigures, SampleInput, SampleTrials, Share, TakeMemories, TrainedAndUnseen, Trial,
    TrialOutcome, VaeFigures, ViewFigures, birds_eye, places, to_unit, trial_frame,
};
pub use decoded::{Decoding, changed_pixels};
pub use posed::{Label, PosedImages};
pub use report::{Gallery, Results, Table, Target, encoder_rows, evaluate};
pub use role::{ByRole, ROLES, role_name};
pub use segmentation::{MaskedView, occupants, view_camera};
pub use stats::{
    draws::{Curve, Frequencies, Frequency, expected_recall},
    pairs::PairMeans,
    ssim::ssim,
};
pub use subject::{CheckpointAbout, DecisiveImage, EvalOptions, Novelty, OtherPlace, Subject};
pub use tables::{
    encoder::{EncoderTable, SvmScore, SvmTable, encoder_table},
    field::{FieldImages, ImageTable, NovelViews},
    forecast::{ForecastTable, FrequencyTable, RoleCurves},
    horizon::{HorizonFigures, HorizonTable},
    localisation::{LocalisationFigures, LocalisationTable, MethodFigures},
    memory::{ByObserver, MemoryTable, ObserverFigures, RightFrames},
    planning::{OneImage, PlanningResults, PlanningViews, ViewCounts},
    robustness::{ByCorruption, CorruptionFigures, NoveltyFigures, Robustness},
    trials::{Baseline, ByPart},
    vehicles::{PlaceFigures, VehicleTable},
};
pub use trials::{
    Models,
    lane_images::{LaneImage, Visibility},
    views::{ByTrialKind, TrialFigures},
    watches::{Watch, WatchPlan, WatchedFrame, watches},
};

/// One line of progress.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress<'a> {
    /// Name of the work, for example a training phase or a table.
    pub phase: &'a str,
    /// Steps done.
    pub done: usize,
    /// Steps in all.
    pub total: usize,
    /// The figures as text.
    pub line: String,
}
