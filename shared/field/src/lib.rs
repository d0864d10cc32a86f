//! The latent-conditioned radiance field: native kernels, rendering, training.
//!
//! A multi-resolution hash grid and small networks (Müller et al. 2022) conditioned on an 8-d scene latent (CARFF,
//! section 3.2), in plain Rust on the processor: no tensor library. Kernels are one generic body each, compiled for
//! every instruction set and chosen at run time.

#![deny(unsafe_code)]
// Bodies must be inlined into each instruction set's version of them, or they would be compiled for the wrong one.
#![allow(clippy::inline_always)]

mod bf16;
mod config;
mod dispatch;
mod field;
mod kernels;
mod layout;
mod march;
mod math;
mod points;
mod render;
mod sampler;
mod space;
mod train;
mod walk;

pub use config::{FieldConfig, FieldError, LATENT_DIM, RenderOptions, TrainerConfig};
pub use dispatch::InstructionSet;
pub use field::{Field, NamedTensor};
pub use march::{RayLimits, RaySamples};
pub use points::PreparedPoints;
pub use render::{HypothesisBuffer, RenderBuffer};
pub use sampler::{RAYS_PER_GROUP, RaySampler, TrainingView, changed_pixels};
pub use space::{Contraction, OccupancyGrid};
pub use train::{FieldTrainer, RayBatch, StepReport, TrainerState};
