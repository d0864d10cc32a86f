//! Tests of `carff backbone import`: the written tensors equal the input, and existing files are replaced only on
//! request.

use carff_networks::weights;
use std::{
    path::Path,
    process::{Command, Output},
};

/// The shipped weights under their published names are imported as equal tensors. A second import is refused without
/// `--force`.
#[test]
fn the_shipped_weights_are_imported() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let shipped = root.join("configs/checkpoints/backbones/efficientnet-lite0.safetensors");
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("folder/weights.safetensors");
    let import = |more: &[&str]| -> Output {
        Command::new(env!("CARGO_BIN_EXE_carff-launch"))
            .args(["backbone", "import"])
            .args([&shipped, Path::new("--out"), &out])
            .args(more)
            .output()
            .unwrap()
    };
    let first = import(&[]);
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let told = String::from_utf8(first.stdout).unwrap();
    assert!(told.contains(&format!("pretrained_backbone = {:?}", out.display().to_string())), "{told}");
    assert!(told.contains("kind = \"efficientnet-lite0\""), "{told}");
    assert_eq!(weights::read(&out).unwrap(), weights::read(&shipped).unwrap());

    let again = import(&[]);
    assert_eq!(again.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&again.stderr).contains("--force"));
    assert!(import(&["--force"]).status.success());
}
