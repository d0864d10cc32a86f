//! Posed image datasets: reading, writing, checking, splitting.
//!
//! A dataset is a folder with `transforms.json` and its PNG or JPEG images. The file has the format of instant-ngp and
//! nerfstudio, with additional keys for the branch and time step of each image. This crate contains no models and no
//! rendering.
//!
//! ```no_run
//! use carff_dataset::{Dataset, Equivalence, PoseSplit};
//! # fn main() -> Result<(), carff_dataset::DatasetError> {
//! let dataset = Dataset::open("data/approaching-intersection".as_ref())?;
//! let images = dataset.load_all_images()?;
//! let split = PoseSplit::for_dataset(&dataset, 7);
//! let equivalence = Equivalence::from_dataset(&dataset, &images);
//! # Ok(())
//! # }
//! ```

mod calibration;
mod camera;
mod comparison;
mod corruptions;
mod dataset;
mod degrade;
pub mod drives;
mod equivalence;
mod error;
mod folder;
mod image;
mod import;
mod jpeg;
mod lens;
mod place;
mod raw;
mod rectify;
mod report;
mod scenario;
mod scenario_keys;
mod seen;
pub mod sensor;
mod split;
mod transforms;
mod unique;
mod views;
mod writer;

pub use calibration::{CalibrationError, CameraCalibration, DistortionModel};
pub use carff_messages::Observability;
pub use comparison::ImageComparison;
pub use corruptions::{Corruption, CorruptionError};
pub use dataset::Dataset;
pub use degrade::{Degradation, degrade};
pub use equivalence::Equivalence;
pub use error::DatasetError;
pub use folder::image_files;
pub use image::{Image, MAX_DIFFERENT_PIXELS, MAX_IMAGE_SIDE_PX, PIXEL_TOLERANCE, looks_same, looks_same_where};
pub use import::{ImportOptions, Imported, import};
pub use raw::{PixelFormat, RawError, RawImage};
pub use rectify::Rectifier;
pub use report::{ContactSheet, DatasetReport, HiddenPair, SheetOptions, contact_sheet};
pub use scenario::{Candidate, Frame, MAX_FRAMES, NamedBox, ScenarioInfo, StateInfo};
pub use split::{PoseRole, PoseSplit};
pub use transforms::MAX_TRANSFORMS_BYTES;
pub use writer::{DatasetWriter, FrameRecord};
