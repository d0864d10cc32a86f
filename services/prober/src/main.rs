//! The prober stage.
fn main() {}
