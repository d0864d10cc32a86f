//! The carff command.
fn main() {}
