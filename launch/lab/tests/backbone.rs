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
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let shipped = root.join("configs/checkpoints/backbones/efficientnet-lite0.safetensors");
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("folder/weights.safetensors");
    let import = |more: &[&str]| -> Output {
        Command::new(env!("CARGO_BIN_EXE_carff-lab"))
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

/// A file without weights, and weights that the network has no place for, end the command with the reason.
#[test]
fn unfit_weights_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |name: &str, more: &[&str]| {
        let out = Command::new(env!("CARGO_BIN_EXE_carff-lab"))
            .args(["backbone", "import", name, "--out", "weights.safetensors"])
            .args(more)
            .current_dir(dir.path())
            .output()
            .unwrap();
        assert_eq!(out.status.code(), Some(1));
        assert!(!dir.path().join("weights.safetensors").exists());
        String::from_utf8(out.stderr).unwrap()
    };
    std::fs::write(dir.path().join("pointer.safetensors"), "version https://git-lfs.github.com/spec/v1\n").unwrap();
    assert!(refused("pointer.safetensors", &[]).contains("pointer.safetensors: a Git LFS pointer, not the data"));
    std::fs::write(dir.path().join("page.safetensors"), "<!doctype html><html></html>").unwrap();
    assert!(refused("page.safetensors", &[]).contains("page.safetensors: a web page or an XML reply, not the data"));

    let shipped = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../configs/checkpoints/backbones/efficientnet-lite0.safetensors");
    let mut tensors = weights::read(&shipped).unwrap();
    weights::write(&dir.path().join("whole.safetensors"), &tensors, tch::Kind::Half).unwrap();
    let error = refused("whole.safetensors", &["--imagenet-normalised"]);
    assert!(error.contains("only a vision transformer's first layer can be converted"), "{error}");
    tensors.insert("_blocks.1._se_reduce.weight".into(), tch::Tensor::from(0.5_f32));
    weights::write(&dir.path().join("b0.safetensors"), &tensors, tch::Kind::Half).unwrap();
    let error = refused("b0.safetensors", &[]);
    assert!(error.contains("`_blocks.1._se_reduce.weight` has no place in this network"), "{error}");
}
