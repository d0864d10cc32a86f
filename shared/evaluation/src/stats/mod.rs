//! Arithmetic on trials.

pub mod draws;
pub mod pairs;
pub mod ssim;
pub mod svm;
