//! What the model does not know: things that no known state explains, images of another place, or of a bad camera.
//!
//! | module | content |
//! |---|---|
//! | `compare` | every known state, rendered from the camera's own pose and compared with the image |
//! | `residuals` | how far each pixel of an image is from what a state renders there |
//! | `align` | errors of pose and lens, and veils: a comparison takes them out of an image, and a training out of its rays |
//! | `fit` | robust fits of an image to a rendered one |
//! | `lanes` | the ground on which something unknown counts |
//! | `blobs` | connected residuals: their size, and the place on the ground where they stand |
//! | `places` | what an image shows of the places of the known states |
//! | `known` | the limits of the known, calibrated on images without anything unknown, and their file |
//! | `sighting` | how far an image shows a lane clear |
//! | `track` | the speed of a vehicle on a lane, by its places in the last images |
//! | `sight` | which of the known states would look the same from a pose ahead |
//! | `camera` | the condition of a camera, from its images |
//! | `alike` | whether two images of a camera from one pose show the same |

mod align;
mod alike;
mod blobs;
mod camera;
mod compare;
mod fit;
mod known;
mod lanes;
mod places;
mod residuals;
mod sight;
mod sighting;
mod track;

pub use align::{displacement, reduced};
pub use alike::shows_same;
pub use blobs::Blob;
pub use camera::{CameraCheck, CameraLimits, Measured, Measurement};
pub use compare::{Comparer, Comparison, KnownScene};
pub use fit::Fit;
pub use known::{KindLimits, Known, KnownError, KnownLimits, Seen};
pub use lanes::{ErrorMap, Ground, Lanes, OwnBox};
pub use places::PlaceViews;
pub use residuals::ResidualKind;
pub use sight::Sight;
pub use sighting::{Crossing, LaneVehicle, Sighting};
pub use track::Track;
