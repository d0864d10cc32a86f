//! Evaluation of a trained scenario: accuracy, images and planning, as tables and as one page.
//!
//! Tables are computed with the library functions that the stages run. Every table gives its trials, and separates
//! held-out poses from trained ones. Nothing here trains a model of a checkpoint or chooses a setting; baselines are
//! fitted where a table needs them.
//!
//! | module | content |
//! |---|---|
//! | `posed`, `accuracy`, `decoded`, `render` | the labelled images, and what the models make of them |
//! | `segmentation` | localisation by segmentation of rendered views |
//! | `trials` | trials of decision rules and samples, and the images from above |
//! | `stats` | arithmetic on trials: recall curves, frequencies, reliability, support vector machine, SSIM |
//! | `tables`, `report` | the tables of `carff eval`, `results.json` and its page |
//! | `run` | planning tables and the filmstrip of a run of the graph |
//! | `figures` | the figures in a checkpoint's manifest |

mod accuracy;
mod decoded;
mod error;
mod figures;
mod posed;
mod render;
mod report;
mod role;
pub mod run;
mod segmentation;
mod stats;
mod subject;
mod tables;
mod trials;

pub use accuracy::{Accuracy, ByObservability, Centroids, Share, state_accuracy};
pub use decoded::{DecodedQuality, Decoding, changed_pixels};
pub use error::EvaluationError;
pub use figures::{
    CheckpointFigures, PlanningFigures, ProbingFigures, SampleFigures, TrainedAndUnseen, VaeFigures, ViewFigures,
};
pub use posed::{Label, PosedImages};
pub use render::{FieldRenderer, to_bytes, to_unit};
pub use report::{Gallery, Results, Table, Target, encoder_rows, evaluate};
pub use role::{ByRole, ROLES, role_name};
pub use segmentation::{MaskedView, occupants, view_camera};
pub use stats::{
    draws::{Curve, Frequencies, Frequency, expected_recall},
    pairs::PairMeans,
    reliability::{Reliability, ReliabilityBin, reliability},
    ssim::ssim,
};
pub use subject::{About, DecisiveImage, EvalOptions, Novelty, OtherPlace, Subject};
pub use tables::{
    encoder::{EncoderTable, SvmScore, SvmTable, encoder_table},
    field::{FieldPictures, NovelViews, PictureTable},
    forecast::{ForecastTable, FrequencyTable, RoleCurves},
    localisation::{LocalisationFigures, LocalisationTable, MethodFigures},
    memory::{ByObserver, MemoryTable, ObserverFigures, RightFrames},
    planning::{OneImage, PlanningResults, PlanningViews, ViewCounts},
    robustness::{ByCorruption, CorruptionFigures, NoveltyFigures, Robustness},
    trials::{Baseline, ByPart},
};
pub use trials::{
    Models,
    birds_eye::{BirdsEye, birds_eye},
    looks::{ByTrialKind, TrialFigures},
    planning::{
        ByKind, BySamples, Count, KnownStates, Perception, Planner, PlanningTable, SAMPLE_COUNTS, TakeMemories, Trial,
        TrialOutcome, trial_frame,
    },
    samples::{Input, SampleAccuracy, SampleTrials},
    watches::{Watch, WatchPlan, Watched, watches},
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
