//! Training of the three models, from images to a checkpoint.
//!
//! ```no_run
//! use carff_training::{Phases, Training, TrainingConfig, TrainingRun};
//! use std::{path::Path, sync::atomic::AtomicBool};
//! # fn main() -> Result<(), carff_training::TrainingError> {
//! let config = TrainingConfig::load(Path::new("configs/training/toy.toml"))?;
//! let stop = AtomicBool::new(false);
//! let run = TrainingRun { dir: "runs/toy".into(), on_progress: &|p| println!("{}", p.line), stop: &stop };
//! let (dataset, out, device) = (config.dataset.as_path(), config.out.as_path(), tch::Device::Cpu);
//! let training = Training { config: &config, dataset, free_poses: &[], scenario: None, out, device };
//! println!("{}", training.run(Phases::All, &run)?.summary());
//! # Ok(())
//! # }
//! ```
//!
//! | module | content |
//! |---|---|
//! | `config`, `augmentation` | the training file |
//! | `alignment` | errors of the recorded poses, and gains of the images, which a field finds |
//! | `pipeline`, `calibrate` | from images to a checkpoint |
//! | `run` | the loop of all phases, and the folder of a run |
//! | `vae`, `field`, `mixture` | the training phases |
//! | `one_stage` | encoder and field trained together, for comparison |
//! | `features`, `records`, `curves` | files of a run: backbone features, metrics, curves |
//! | `free_poses` | images from free poses for a dataset without a scenario file |
//! | [`ablation`] | the encoder ablation |

pub mod ablation;
mod alignment;
mod augmentation;
mod bound;
mod calibrate;
mod config;
mod curves;
mod error;
mod features;
mod field;
mod free_poses;
mod known;
mod memory;
mod mixture;
mod one_stage;
mod pipeline;
mod records;
mod run;
mod unambiguous;
mod vae;

pub use augmentation::Augmentation;
pub use bound::{BoundInput, ChosenBound, bound_threshold};
pub use carff_evaluation::{Progress, places};
pub use config::{CalibrationConfig, FieldTraining, FreePoses, MdnTraining, TrainingConfig, VaeTraining};
pub use curves::training_curves;
pub use error::TrainingError;
pub use features::FEATURES;
pub use free_poses::render_free_poses;
pub use known::{KnownInput, calibrate_known};
pub use memory::{LearnedMemory, MemoryInput, learn_memory};
pub use pipeline::{Phases, Training};
pub use run::{TrainingRun, forget_run};
pub use vae::losses;
