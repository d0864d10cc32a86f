//! Arithmetic on trials.

pub mod draws;
pub mod pairs;
pub mod reliability;
pub mod ssim;
pub mod svm;
