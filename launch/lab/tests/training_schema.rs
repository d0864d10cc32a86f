//! Test of the schema of training files, whose structure is part of this crate.

use std::path::Path;
use std::process::Command;

/// The file in configs/schemas equals the output of `carff schema training`.
#[test]
fn the_shipped_schema_is_up_to_date() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/schemas/training.schema.json");
    let printed = Command::new(env!("CARGO_BIN_EXE_carff-lab")).args(["schema", "training"]).output().unwrap();
    let there = std::fs::read(&path).unwrap();
    assert!(printed.stdout == there, "run `carff schema training > {}`", path.display());
}
