//! Test of stored weights: a network with read weights computes the same bits, if its numbers fit half precision.

use carff_checkpoint::{Manifest, files, shapes::BackboneKind};
use carff_messages::Gaussian;
use carff_networks::{
    decoder::Decoder,
    encoder::Encoder,
    mixture::MixtureNet,
    stored::{load_decoder, load_encoder, load_mixture, save_weights},
    weights::{Tensors, of_store},
};
use std::path::Path;
use tch::{Device, Kind, Tensor, nn::VarStore};

/// Rounds a store's variables to half precision.
fn round(store: &VarStore) -> Tensors {
    tch::no_grad(|| {
        for mut variable in store.variables().into_values() {
            let rounded = variable.to_kind(Kind::Half);
            variable.copy_(&rounded);
        }
    });
    of_store(store)
}

fn random(shape: &[i64]) -> Tensor {
    Tensor::rand(shape, (Kind::Float, Device::Cpu))
}

/// Encoder (with a frozen backbone in its own file, and with a trained backbone), decoder and mixture density network.
#[test]
fn networks_come_back_as_they_were() {
    tch::manual_seed(3);
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/checkpoints/toy");
    let mut manifest = Manifest::load(&shipped).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    std::fs::copy(shipped.join(files::BACKBONE), dir.join(files::BACKBONE)).unwrap();

    let image = random(&[2, 3, 128, 128]);
    for kind in [BackboneKind::EfficientNetLite0, BackboneKind::ConvNet] {
        manifest.encoder.backbone.kind = kind;
        manifest.encoder.backbone.frozen = kind == BackboneKind::EfficientNetLite0;
        let file = shipped.join(files::BACKBONE);
        let pretrained = manifest.encoder.backbone.frozen.then_some(file.as_path());
        let [backbone, head] = [(); 2].map(|()| VarStore::new(Device::Cpu));
        let (path, head_path) = (backbone.root() / "backbone", head.root() / "encoder");
        let encoder = Encoder::new(&manifest.encoder, &path, &head_path, pretrained).unwrap();
        let mut kept = round(&head);
        if !manifest.encoder.backbone.frozen {
            kept.extend(round(&backbone));
        }
        save_weights(dir, files::ENCODER, &kept).unwrap();
        let read: Vec<Gaussian> = load_encoder(dir, &manifest).unwrap().encode(&image);
        assert_eq!(read, encoder.encode(&image), "{kind:?}");
    }

    let store = VarStore::new(Device::Cpu);
    let decoder = Decoder::new(&(store.root() / "decoder"), &manifest.decoder, manifest.scenario.poses as i64);
    save_weights(dir, files::DECODER, &round(&store)).unwrap();
    let (latents, poses) = (random(&[3, 8]), Tensor::from_slice(&[0_i64, 7, 99]));
    let read = load_decoder(dir, &manifest).unwrap();
    assert_eq!(read.forward(&latents, &poses), decoder.forward(&latents, &poses));

    let store = VarStore::new(Device::Cpu);
    let mixture = MixtureNet::new(&(store.root() / "mixture"), &manifest.mixture).unwrap();
    save_weights(dir, files::MIXTURE, &round(&store)).unwrap();
    let posterior = Gaussian { mean: [0.3; 8], log_variance: [-1.0; 8] };
    assert_eq!(load_mixture(dir, &manifest).unwrap().forecast(&posterior), mixture.forecast(&posterior));
}
