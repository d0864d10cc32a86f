//! The decision path as pure arithmetic: draw, probe, resolve, look ahead, decide.
//!
//! The stages wrap these functions in topics, and evaluations call them in a loop: a report therefore shows what a
//! running graph would have published, bit for bit. The crate holds no network, no field, no file and no clock; the
//! field enters as a [`Localiser`].
//!
//! | module | content |
//! |---|---|
//! | `mixture` | mixtures over the scene latent, and draws from them |
//! | `layout`, `calibration` | from densities at the places of a scenario to the state that a latent shows |
//! | `look_ahead`, `feedback` | one step of the belief, and the autoregressive loop |
//! | `memory`, `take` | the belief over the frames of a take |
//! | `image_evidence` | the known states weighed by how well they explain the image |
//! | `evidence`, `rule`, `threshold` | from the steps of a frame to an action |
//! | `approach`, `look` | from an action to the speed of a vehicle that moves by it, and what it can see from further on |
//! | `convert` | steps as messages, and back |

mod approach;
mod calibration;
mod convert;
mod evidence;
mod feedback;
mod image_evidence;
mod layout;
mod look;
mod look_ahead;
mod memory;
mod mixture;
mod rule;
mod take;
mod threshold;

pub use approach::{ActionAndSpeed, Approach, Look, Motion, Speeds, stopping_mps};
pub use calibration::{ProbeCalibration, Reading, Resolved, resolve};
pub use convert::{mixture_and_draws, set_mixture_and_draws};
pub use evidence::{Evidence, SampleEvidence};
pub use feedback::{Feedback, ForecastInput, continue_samples};
pub use image_evidence::ImageEvidence;
pub use layout::{Place, ProbeLayout, ProbingError};
pub use look::look_gain_bits;
pub use look_ahead::{Localiser, Plan, Probed, SceneProbe, Step, look_ahead, path_probability};
pub use memory::{Memory, MemorySettings, RememberedStates};
pub use mixture::{Draw, Mixture, Sampling};
pub use rule::{Decision, Policy, is_likely};
pub use take::{Remembered, StepLength, TakeFrame, TakeMemory};
pub use threshold::{CalibrationTrial, bounded_threshold, choose_threshold, unchosen_threshold};
