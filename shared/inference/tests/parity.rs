//! Parity of the networks on the decision path with the reference in tch.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::random::Key;
use carff_checkpoint::{
    Manifest, files,
    shapes::{BackboneConfig, BackboneKind, MixtureConfig, VitConfig},
};
use carff_inference::{Encoder, MixtureNet};
use carff_messages::Gaussian;
use carff_networks::{borrow, encoder::Encoder as Reference, stored, weights};
use carff_scenes::{Detail, Scenario};
use ndarray::{Array3, ArrayView3};
use rand::Rng;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor, nn::VarStore};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap().to_owned()
}

fn shipped() -> (PathBuf, Manifest) {
    let dir = root().join("configs/checkpoints/approaching-intersection");
    let manifest = Manifest::load(&dir).unwrap();
    (dir, manifest)
}

/// Returns the largest distance of the means, in standard deviations, and of the log-variances.
fn distance(a: &Gaussian, b: &Gaussian) -> f32 {
    let off = |i: usize| ((a.mean[i] - b.mean[i]) / (0.5 * b.log_variance[i]).exp()).abs();
    let spread = |i: usize| (a.log_variance[i] - b.log_variance[i]).abs();
    (0..a.mean.len()).flat_map(|i| [off(i), spread(i)]).fold(0.0, f32::max)
}

fn in_tch(encoder: &Reference, image: ArrayView3<'_, u8>) -> Gaussian {
    borrow::with_image(image, |image| encoder.encode_bytes(image)).flatten().unwrap()
}

/// An image of random bytes.
fn noise(height: usize, width: usize) -> Array3<u8> {
    let mut state = 1_u64;
    Array3::from_shape_simple_fn((height, width, 3), || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    })
}

/// On images of every state of the shipped scenario, the mean moves by at most a thousandth of its deviation. Twenty runs give
/// equal bits, on one thread and on two.
#[test]
fn images_of_the_shipped_scenario() {
    let (dir, manifest) = shipped();
    let scenario = Scenario::load(&root().join("configs/scenarios/approaching-intersection.toml")).unwrap();
    let reference = stored::load_encoder(&dir, &manifest).unwrap();
    let mut encoder = Encoder::load(&dir, &manifest, 1).unwrap();
    let mut parallel = Encoder::load(&dir, &manifest, 2).unwrap();
    let mut count = 0;
    for branch in 0..scenario.info().branches.len() {
        for timestamp in 0..scenario.info().timestamps {
            // Every sixth pose: rendering takes most of the time.
            for camera in scenario.cameras().iter().step_by(6) {
                let image = scenario.render(branch, timestamp, &camera.camera, Detail::default()).unwrap().image;
                let shape = (image.height_px as usize, image.width_px as usize, 3);
                let pixels = ArrayView3::from_shape(shape, &image.rgb).unwrap();
                let posterior = encoder.encode(pixels).unwrap();
                let off = distance(&posterior, &in_tch(&reference, pixels));
                assert!(off <= 1e-3, "branch {branch}, time step {timestamp}, {}: {off}", camera.view_kind);
                for _ in 0..if count % 50 == 0 { 20 } else { 0 } {
                    assert_eq!(encoder.encode(pixels).unwrap(), posterior);
                    assert_eq!(parallel.encode(pixels).unwrap(), posterior);
                }
                count += 1;
            }
        }
    }
    assert!(count >= 100, "{count}");
}

/// Every image size gives the reference's posterior: smaller and larger than the backbone's input, of one pixel, not
/// square; and bytes that are not in order, as in a part of an image. An empty image is refused.
#[test]
fn every_size_of_image() {
    let (dir, manifest) = shipped();
    let reference = stored::load_encoder(&dir, &manifest).unwrap();
    let mut encoder = Encoder::load(&dir, &manifest, 1).unwrap();
    for (height, width) in [(1, 1), (7, 5), (128, 128), (224, 224), (200, 300), (720, 1280), (3, 1000)] {
        let image = noise(height, width);
        let off = distance(&encoder.encode(image.view()).unwrap(), &in_tch(&reference, image.view()));
        assert!(off <= 1e-3, "{height} x {width}: {off}");
    }
    let image = noise(40, 60);
    let part = image.slice(ndarray::s![..;2, 10..50, ..]);
    assert!(distance(&encoder.encode(part).unwrap(), &in_tch(&reference, part)) <= 1e-3);
    for shape in [(0, 4, 3), (4, 0, 3), (4, 4, 0), (4, 4, 1), (4, 4, 4)] {
        let error = encoder.encode(Array3::zeros(shape).view()).unwrap_err().to_string();
        assert!(error.contains("cannot be encoded"), "{error}");
    }
}

/// A checkpoint with an encoder of random weights.
struct Random {
    dir: tempfile::TempDir,
    manifest: Manifest,
    backbone: VarStore,
}

/// Fills all weights from a random stream of its own: tests of one process share that of libtorch. Layers keep the scale of
/// their input.
fn fill(store: &VarStore, seed: u64) {
    let variables: BTreeMap<_, _> = store.variables().into_iter().collect();
    for (number, (name, mut tensor)) in (0..).zip(variables) {
        let mut rng = carff_base::random::stream(Key { seed, frame: number, step: 0, sample: 0 });
        let fan_in: i64 = tensor.size().iter().skip(1).product();
        let (middle, half) = match name.rsplit('.').next() {
            _ if tensor.dim() > 1 => (0.0, (3.0 / fan_in as f32).sqrt()),
            Some("weight" | "running_var") => (1.0, 0.5),
            _ => (0.0, 0.1),
        };
        let values: Vec<f32> = (0..tensor.numel()).map(|_| middle + half * (2.0 * rng.random::<f32>() - 1.0)).collect();
        tch::no_grad(|| tensor.copy_(&Tensor::from_slice(&values).view_as(&tensor)));
    }
}

fn random(backbone: BackboneConfig, stem_channels: i64) -> Random {
    let (_, mut manifest) = shipped();
    manifest.encoder.backbone = backbone;
    manifest.encoder.stem_channels = stem_channels;
    let [backbone, head] = [(); 2].map(|()| VarStore::new(Device::Cpu));
    let paths = (backbone.root() / "backbone", head.root() / "encoder");
    Reference::new(&manifest.encoder, &paths.0, &paths.1, None).unwrap();
    fill(&backbone, 1);
    fill(&head, 2);
    let dir = tempfile::tempdir().unwrap();
    let mut tensors = weights::of_store(&head);
    tensors.extend(weights::of_store(&backbone));
    stored::save_weights(dir.path(), files::ENCODER, &tensors).unwrap();
    Random { dir, manifest, backbone }
}

impl Random {
    /// Moves the backbone to a file of its own, with changed names.
    fn publish(&self, file: &weights::Tensors) {
        let mut tensors = weights::read(&self.dir.path().join(files::ENCODER)).unwrap();
        tensors.retain(|name, _| !name.starts_with("backbone."));
        stored::save_weights(self.dir.path(), files::ENCODER, &tensors).unwrap();
        stored::save_weights(self.dir.path(), files::BACKBONE, file).unwrap();
    }

    #[track_caller]
    fn assert_parity(&self) {
        let reference = stored::load_encoder(self.dir.path(), &self.manifest).unwrap();
        let mut encoder = Encoder::load(self.dir.path(), &self.manifest, 1).unwrap();
        for image in [noise(64, 64), noise(48, 48), noise(100, 160)] {
            let (found, wanted) = (encoder.encode(image.view()).unwrap(), in_tch(&reference, image.view()));
            // Random layers make narrow posteriors with large means, so that deviations measure rounding here.
            let parts = |g: &Gaussian| g.mean.into_iter().chain(g.log_variance);
            let off =
                parts(&found).zip(parts(&wanted)).map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f32::max);
            assert!(off <= 1e-4, "{off}: {found:?}, in tch {wanted:?}");
        }
    }
}

fn vit(registers: i64) -> BackboneConfig {
    let vit = VitConfig { patch_px: 16, width: 24, depth: 3, heads: 3, registers };
    BackboneConfig { kind: BackboneKind::Vit, frozen: false, input_px: 64, vit }
}

/// Every backbone and the stem, trained: their weights are in the encoder's file.
#[test]
fn every_trained_backbone() {
    let of = |kind, input_px| BackboneConfig { kind, frozen: false, input_px, ..BackboneConfig::default() };
    for (backbone, stem) in [
        (of(BackboneKind::EfficientNetLite0, 224), 0),
        (of(BackboneKind::EfficientNetLite0, 96), 4),
        (of(BackboneKind::ConvNet, 64), 0),
        (vit(0), 6),
        (vit(4), 0),
    ] {
        random(backbone, stem).assert_parity();
    }
}

/// Vision transformers with the names of timm and of Hugging Face, with `LayerScale`, and without a position of the
/// class token; EfficientNet-Lite0 with the names of timm. Tensors beyond the features are ignored.
#[test]
fn published_backbones() {
    let frozen = BackboneConfig { frozen: true, ..vit(2) };
    let random = random(frozen, 0);
    let timm: weights::Tensors = weights::of_store(&random.backbone)
        .into_iter()
        .map(|(name, t)| (name.trim_start_matches("backbone.").to_owned(), t))
        .collect();
    let mut file: weights::Tensors = timm.iter().map(|(name, t)| (name.clone(), t.shallow_clone())).collect();
    let ones = |n: i64| Tensor::ones([n], (Kind::Float, Device::Cpu));
    file.insert("head.weight".into(), ones(3));
    file.insert("blocks.1.ls1.gamma".into(), ones(24) * 0.5);
    file.insert("blocks.2.ls2.gamma".into(), ones(24) * 1.5);
    let positions = file["pos_embed"].narrow(1, 1, 16);
    file.insert("pos_embed".into(), positions);
    random.publish(&file);
    random.assert_parity();

    let mut hugging = weights::Tensors::new();
    for (name, t) in &file {
        let renamed = name
            .replace("patch_embed.proj.", "embeddings.patch_embeddings.projection.")
            .replace("pos_embed", "embeddings.position_embeddings")
            .replace("cls_token", "embeddings.cls_token")
            .replace("reg_token", "embeddings.register_tokens")
            .replace("blocks.", "encoder.layer.")
            .replace(".norm1.", ".layernorm_before.")
            .replace(".norm2.", ".layernorm_after.")
            .replace(".attn.proj.", ".attention.output.dense.")
            .replace(".mlp.fc1.", ".intermediate.dense.")
            .replace(".mlp.fc2.", ".output.dense.")
            .replace(".ls1.gamma", ".layer_scale1.lambda1")
            .replace(".ls2.gamma", ".layer_scale2.lambda1");
        let renamed = if renamed.starts_with("norm.") { renamed.replace("norm.", "layernorm.") } else { renamed };
        match renamed.split_once(".attn.qkv.") {
            Some((block, part)) => {
                for (q, chunk) in ["query", "key", "value"].iter().zip(t.chunk(3, 0)) {
                    hugging.insert(format!("vit.{block}.attention.attention.{q}.{part}"), chunk);
                }
            }
            None => drop(hugging.insert(format!("vit.{renamed}"), t.shallow_clone())),
        }
    }
    hugging.insert("classifier.weight".into(), ones(3));
    hugging.remove("vit.head.weight");
    random.publish(&hugging);
    random.assert_parity();

    let (dir, manifest) = shipped();
    let published = weights::read(&dir.join(files::BACKBONE)).unwrap();
    let first: weights::Tensors = published
        .iter()
        .map(|(name, t)| {
            let name = match name.strip_prefix("_blocks.0.") {
                Some(rest) => format!(
                    "blocks.0.0.{}",
                    rest.replace("_bn1", "bn1")
                        .replace("_bn2", "bn2")
                        .replace("_depthwise_conv", "conv_dw")
                        .replace("_project_conv", "conv_pw")
                ),
                None => name
                    .replace("_conv_stem", "conv_stem")
                    .replace("_bn0", if name.starts_with("_bn0") { "bn1" } else { "_bn0" }),
            };
            (name, t.shallow_clone())
        })
        .collect();
    let copy = tempfile::tempdir().unwrap();
    std::fs::copy(dir.join(files::ENCODER), copy.path().join(files::ENCODER)).unwrap();
    stored::save_weights(copy.path(), files::BACKBONE, &first).unwrap();
    let image = noise(128, 128);
    let [found, wanted] =
        [copy.path(), &dir].map(|dir| Encoder::load(dir, &manifest, 1).unwrap().encode(image.view()).unwrap());
    assert_eq!(found, wanted);
}

/// Files that do not fit are errors that name the file and the tensor.
#[test]
fn what_does_not_fit_is_named() {
    let random = random(vit(0), 0);
    let path = random.dir.path().join(files::ENCODER);
    let whole = weights::read(&path).unwrap();
    let refused = |change: &dyn Fn(&mut weights::Tensors)| {
        let mut tensors: weights::Tensors = whole.iter().map(|(name, t)| (name.clone(), t.shallow_clone())).collect();
        change(&mut tensors);
        stored::save_weights(random.dir.path(), files::ENCODER, &tensors).unwrap();
        Encoder::load(random.dir.path(), &random.manifest, 1).unwrap_err().to_string()
    };
    let zeros = |n: i64| Tensor::zeros([n], (Kind::Float, Device::Cpu));
    for (error, text) in [
        (refused(&|t| drop(t.remove("backbone.blocks.1.mlp.fc2.weight"))), "`blocks.1.mlp.fc2.weight` is missing"),
        (refused(&|t| drop(t.insert("encoder.head.mean.bias".into(), zeros(3)))), "is [3], the model wants [8]"),
        (refused(&|t| drop(t.insert("encoder.more".into(), zeros(3)))), "`more` has no place"),
        (refused(&|t| drop(t.insert("more".into(), zeros(3)))), "`more` has no place"),
        (refused(&|t| drop(t.insert("encoder.head.mean.bias".into(), zeros(8) / 0.0))), "NaN or infinite"),
    ] {
        assert!(error.contains(text) && error.contains(files::ENCODER), "{error}");
    }
    std::fs::write(&path, b"version https://git-lfs.github.com/spec/v1\n").unwrap();
    let error = Encoder::load(random.dir.path(), &random.manifest, 1).unwrap_err().to_string();
    assert!(error.contains("Git LFS") && error.contains(files::ENCODER), "{error}");
    std::fs::remove_file(&path).unwrap();
    assert!(Encoder::load(random.dir.path(), &random.manifest, 1).unwrap_err().to_string().contains(files::ENCODER));
    let settings = VitConfig { heads: 5, ..random.manifest.encoder.backbone.vit.clone() };
    let mut manifest = random.manifest.clone();
    manifest.encoder.backbone.vit = settings;
    stored::save_weights(random.dir.path(), files::ENCODER, &whole).unwrap();
    let error = Encoder::load(random.dir.path(), &manifest, 1).unwrap_err().to_string();
    assert!(error.contains("`backbone.vit.heads` = 5"), "{error}");
}

/// Forecasts of every shipped network, and of one with two layers in each head, agree with tch to a ten thousandth, and
/// repeat bit by bit.
#[test]
fn forecasts_agree() {
    let shipped = std::fs::read_dir(root().join("configs/checkpoints")).unwrap().flatten().map(|e| e.path());
    let mut networks: Vec<_> = shipped.filter_map(|dir| Some((dir.clone(), Manifest::load(&dir).ok()?))).collect();
    let deep = tempfile::tempdir().unwrap();
    let (_, mut manifest) = networks[0].clone();
    manifest.mixture = MixtureConfig { head_hidden: 48, ..manifest.mixture };
    let store = VarStore::new(Device::Cpu);
    carff_networks::mixture::MixtureNet::new(&(store.root() / "mixture"), &manifest.mixture).unwrap();
    stored::save_weights(deep.path(), files::MIXTURE, &weights::of_store(&store)).unwrap();
    networks.push((deep.path().into(), manifest));
    for (folder, manifest) in networks {
        let (native, reference) =
            (MixtureNet::load(&folder, &manifest).unwrap(), stored::load_mixture(&folder, &manifest).unwrap());
        let wide = Gaussian { mean: [3.0, -3.0, 2.0, 0.0, 1.0, -1.0, 0.5, -0.5], log_variance: [4.0; 8] };
        for posterior in manifest.states.iter().chain([&wide, &Gaussian::standard()]) {
            let (found, wanted) = (native.forecast(posterior), reference.forecast(posterior));
            assert_eq!(found, native.forecast(posterior));
            let numbers = |m: &carff_decision::Mixture| -> Vec<f32> {
                let parts = m.components.iter().flat_map(|c| c.mean.iter().chain(&c.log_variance));
                m.weights.iter().chain(parts).copied().collect()
            };
            let (found, wanted) = (numbers(&found), numbers(&wanted));
            assert_eq!(found.len(), wanted.len());
            for (found, wanted) in found.iter().zip(&wanted) {
                // Sums of 512 terms of both signs: near zero, their rounding counts against the terms.
                let off = (found - wanted).abs() / wanted.abs().max(0.1);
                assert!(off <= 1e-4, "{found} in place of {wanted} ({})", folder.display());
            }
        }
    }
}
