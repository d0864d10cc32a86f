//! The latent-conditioned radiance field: native kernels, rendering, training.
//!
//! A multi-resolution hash grid and small networks (Müller et al. 2022) conditioned on an 8-d scene latent (CARFF,
//! section 3.2), in plain Rust on the processor: no tensor library. Each kernel is one generic body, compiled for every
//! instruction set and chosen at run time.
//!
//! In layers, each of which only uses those before it: `config`; `space` (contraction, occupancy grid, step sizes);
//! `kernels` (inner loops over blocks of samples); `model` (networks, field, tensors); `march` (samples along rays);
//! `render` and `train`.

#![deny(unsafe_code)]
#![allow(
    clippy::inline_always,
    reason = "a body that is not inlined into its version for an instruction set is compiled for the wrong one"
)]

mod config;
mod kernels;
mod march;
mod model;
mod pool;
mod render;
mod space;
mod train;

pub use config::{FieldConfig, FieldError, LATENT_DIM, RenderOptions, TrainerConfig};
pub use kernels::dispatch::InstructionSet;
pub use march::ray_samples::RaySamples;
pub use march::samples::RayLimits;
pub use model::field::Field;
pub use model::points::PreparedPoints;
pub use model::tensors::NamedTensor;
pub use render::buffers::{HypothesisBuffer, RenderBuffer, to_byte, to_bytes};
pub use space::contraction::Contraction;
pub use space::occupancy::OccupancyGrid;
pub use train::batch::{RayBatch, StepReport};
pub use train::sampler::{Correction, Displacement, RAYS_PER_GROUP, RaySampler, TrainingView, changed_pixels};
pub use train::state::TrainerState;
pub use train::trainer::FieldTrainer;
