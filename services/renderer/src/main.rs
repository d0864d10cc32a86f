//! The renderer stage.
fn main() {}
