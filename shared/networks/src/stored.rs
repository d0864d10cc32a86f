//! Reads and writes the networks of a checkpoint.

use crate::{
    ModelError,
    decoder::Decoder,
    encoder::Encoder,
    mixture::MixtureNet,
    weights::{self, Tensors},
};
use carff_checkpoint::{CheckpointError, Manifest, files};
use std::path::Path;
use tch::{Device, Kind, nn::VarStore};

fn in_checkpoint(dir: &Path) -> impl Fn(ModelError) -> CheckpointError + '_ {
    move |e| CheckpointError::Weights { path: dir.into(), what: e.to_string() }
}

/// Reads the encoder.
pub fn load_encoder(dir: &Path, manifest: &Manifest) -> Result<Encoder, CheckpointError> {
    load_encoder_on(dir, manifest, Device::Cpu)
}

/// Reads the encoder onto a device.
pub fn load_encoder_on(dir: &Path, manifest: &Manifest, device: Device) -> Result<Encoder, CheckpointError> {
    let wrong = in_checkpoint(dir);
    let backbone = VarStore::new(device);
    let head = VarStore::new(device);
    let frozen = manifest.encoder.backbone.frozen;
    let file = dir.join(files::BACKBONE);
    let pretrained = (frozen && file.is_file()).then_some(file.as_path());
    let encoder =
        Encoder::new(&manifest.encoder, &(backbone.root() / "backbone"), &(head.root() / "encoder"), pretrained)
            .map_err(&wrong)?;
    let mut tensors = weights::read(&dir.join(files::ENCODER)).map_err(&wrong)?;
    if pretrained.is_none() {
        // The encoder's own file contains a trained backbone.
        let own: Tensors =
            weights::of_store(&backbone).into_keys().filter_map(|k| tensors.remove(&k).map(|t| (k, t))).collect();
        weights::fill_store(&backbone, &own).map_err(&wrong)?;
    }
    weights::fill_store(&head, &tensors).map_err(&wrong)?;
    Ok(encoder)
}

/// Reads the decoder.
pub fn load_decoder(dir: &Path, manifest: &Manifest) -> Result<Decoder, CheckpointError> {
    let wrong = in_checkpoint(dir);
    let store = VarStore::new(Device::Cpu);
    let decoder = Decoder::new(&(store.root() / "decoder"), &manifest.decoder, manifest.scenario.poses as i64);
    let tensors = weights::read(&dir.join(files::DECODER)).map_err(&wrong)?;
    weights::fill_store(&store, &tensors).map_err(&wrong)?;
    Ok(decoder)
}

/// Reads the mixture density network.
pub fn load_mixture(dir: &Path, manifest: &Manifest) -> Result<MixtureNet, CheckpointError> {
    let path = dir.join(files::MIXTURE);
    if !path.is_file() {
        return Err(CheckpointError::Missing { path: dir.into(), part: "mixture density network", phase: "mdn" });
    }
    let wrong = in_checkpoint(dir);
    let store = VarStore::new(Device::Cpu);
    let net = MixtureNet::new(&(store.root() / "mixture"), &manifest.mixture).map_err(&wrong)?;
    weights::fill_store(&store, &weights::read(&path).map_err(&wrong)?).map_err(&wrong)?;
    Ok(net)
}

/// Writes the weights of a part in half precision.
pub fn save_weights(dir: &Path, file: &str, tensors: &Tensors) -> Result<(), CheckpointError> {
    std::fs::create_dir_all(dir).map_err(|source| CheckpointError::File { path: dir.into(), source })?;
    weights::write(&dir.join(file), tensors, Kind::Half).map_err(in_checkpoint(dir))
}
