//! The controller stage.
fn main() {}
