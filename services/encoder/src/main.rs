//! The encoder stage.
fn main() {}
