//! Trials of the decision path, the drives of a run, and the figures of a checkpoint. No tensor library.
//!
//! Networks are used through [`carff_checkpoint::Encodes`] and [`carff_checkpoint::Forecasts`]: the trials of training
//! and evaluation run with those in libtorch, the trials of a run with those of the stages.
//!
//! | module | content |
//! |---|---|
//! | `planning` | trials of decision rules, and their table |
//! | `samples` | state accuracy of probed samples |
//! | `accuracy`, `birds_eye`, `render` | counts of correct answers, and images of the field |
//! | `reliability` | agreement of forecast probabilities with events |
//! | `hypotheses`, `places` | names of states and groups of samples, and the places that are probed |
//! | `run` | planning tables and the filmstrip of a run of the graph |
//! | `figures` | the figures in a checkpoint's manifest |

mod accuracy;
mod birds_eye;
mod error;
mod figures;
pub mod hypotheses;
mod onnx;
mod places;
mod planning;
mod reliability;
pub mod render;
pub mod run;
mod samples;

pub use accuracy::{Accuracy, ByObservability, Share};
pub use birds_eye::{BirdsEye, birds_eye};
pub use error::EvaluationError;
pub use figures::{
    CheckpointFigures, DecodedQuality, PlanningFigures, ProbingFigures, SampleFigures, TrainedAndUnseen, VaeFigures,
    ViewFigures,
};
pub use places::places;
pub use planning::{
    ByKind, BySamples, Compared, Count, KnownStates, LEAST_TRIALS, MOST_REPEATS, Perception, Planner, PlanningTable,
    SAMPLE_COUNTS, SAMPLES, TakeMemories, Trial, TrialOutcome, trial_frame,
};
pub use reliability::{RELIABILITY_BINS, Reliability, ReliabilityBin, ReliabilitySums, reliability};
pub use render::{FieldRenderer, to_unit};
pub use samples::{SampleAccuracy, SampleInput, SampleTrials};
