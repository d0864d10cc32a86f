//! The forecaster stage.
fn main() {}
