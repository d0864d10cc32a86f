//! The camera stage.
fn main() {}
