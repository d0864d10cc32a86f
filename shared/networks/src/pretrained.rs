//! Backbone weights that others published.
//!
//! Reads a Python package, a state dict of `torch` or safetensors (also sharded), recognises the network, and writes the weights that the
//! network needs into a file that a training file can name.

use crate::{
    ModelError,
    backbone::{EfficientNetLite0, VisionTransformer},
    weights::{self, Tensors},
};
use carff_checkpoint::shapes::{BackboneConfig, BackboneKind};
use pytorch_reader::{DType, PytorchReader};
use serde_json::Value;
use std::{
    borrow::Cow,
    collections::BTreeMap,
    ffi::OsStr,
    fs::File,
    io::{self, BufReader},
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
    /// Names of the file's tensors outside of the network.
    pub outside: Vec<String>,
}

/// File extensions of weights in a package.
const WEIGHT_FILES: [&str; 5] = ["pth", "pt", "bin", "ckpt", "safetensors"];

/// Reads all tensors of a file: safetensors, a state dict of `torch.save` (in any of its containers; no code in it is
/// executed), the index of a sharded file (`model.safetensors.index.json`), or a package (wheel or other ZIP archive)
/// with one such file. Floating point tensors become `f32`.
///
/// # Errors
///
/// Names the file, and the tensor if its values are NaN or infinite.
pub fn read(path: &Path) -> Result<Tensors, PretrainedError> {
    match container(path)? {
        Container::Index => sharded(path),
        Container::Package(archive) => {
            let scratch =
                tempfile::NamedTempFile::new().map_err(|source| PretrainedError::File { path: path.into(), source })?;
            let name = unpack(path, archive, scratch.as_file())?;
            let named = |e: &PretrainedError| e.to_string().replace(&scratch.path().display().to_string(), &name);
            one_file(scratch.path()).map_err(|e| format(path, &named(&e)))
        }
        _ => one_file(path),
    }
}

/// Reads safetensors or a state dict.
fn one_file(path: &Path) -> Result<Tensors, PretrainedError> {
    match container(path)? {
        Container::Safetensors => Ok(weights::read(path)?),
        Container::StateDict => state_dict(path),
        Container::Package(_) => Err(format(path, "an archive inside an archive; unpack it first")),
        Container::Index => {
            Err(format(path, "the index of a sharded file; pass it without a package, with its shards"))
        }
    }
}

/// Reads the shards that an index lists; they are in its folder.
fn sharded(index: &Path) -> Result<Tensors, PretrainedError> {
    let json: Value = File::open(index)
        .map_err(|source| PretrainedError::File { path: index.into(), source })
        .and_then(|file| serde_json::from_reader(BufReader::new(file)).map_err(|e| format(index, &e.to_string())))?;
    let map =
        json["weight_map"].as_object().ok_or_else(|| format(index, "has no `weight_map`, which lists the shards"))?;
    let mut shards: BTreeMap<&str, Tensors> = BTreeMap::new();
    let mut tensors = Tensors::new();
    for (name, shard) in map {
        // Only files in the index's own folder are read.
        let shard = shard.as_str().filter(|shard| Path::new(shard).file_name() == Some(OsStr::new(shard)));
        let shard =
            shard.ok_or_else(|| format(index, &format!("`{name}`: a shard is a file name without a folder")))?;
        if !shards.contains_key(shard) {
            shards.insert(shard, one_file(&index.with_file_name(shard))?);
        }
        let tensor =
            shards[shard].get(name).ok_or_else(|| format(index, &format!("{shard} has no tensor `{name}`")))?;
        tensors.insert(name.clone(), tensor.shallow_clone());
    }
    // A tensor that the index does not list must not be dropped in silence.
    for (shard, own) in &shards {
        if let Some(name) = own.keys().find(|name| !tensors.contains_key(*name)) {
            return Err(format(index, &format!("`weight_map` does not list `{name}`, which {shard} has")));
        }
    }
    Ok(tensors)
}

/// Identifies the backbone of the tensors and selects its tensors. Names may have a common prefix, as in
/// `state_dict._conv_stem.weight`. A classifier is omitted.
///
/// # Errors
///
/// [`ModelError::Mismatch`] if no backbone or several match, or if tensors are missing, unknown or of another shape.
pub fn backbone(tensors: &Tensors) -> Result<Published, ModelError> {
    for stem in ["_conv_stem.weight", "conv_stem.weight"] {
        if let Some((own, outside)) = without_prefix(tensors, stem)? {
            let config = BackboneConfig { kind: BackboneKind::EfficientNetLite0, ..BackboneConfig::default() };
            return Ok(Published { config, tensors: EfficientNetLite0::select(&own)?, outside });
        }
    }
    for token in ["embeddings.cls_token", "cls_token"] {
        if let Some((own, outside)) = without_prefix(tensors, token)? {
            let (vit, input_px) = VisionTransformer::shape_of(&own)?;
            let store = VarStore::new(Device::Cpu);
            VisionTransformer::new(&store.root(), &vit, Some(&own), input_px)?;
            let config = BackboneConfig { kind: BackboneKind::Vit, input_px, vit, ..BackboneConfig::default() };
            return Ok(Published { config, tensors: weights::of_store(&store), outside });
        }
    }
    Err(ModelError::Mismatch(format!(
        "neither EfficientNet-Lite0 (`_conv_stem.weight`) nor a vision transformer (`cls_token`); there are {}: {}",
        tensors.len(),
        weights::first_of(tensors.keys().map(|k| format!("`{k}`")).collect(), ", ")
    )))
}

/// Means and deviations of `ImageNet`'s channels, by which many networks normalise their images.
const IMAGENET: [[f64; 3]; 2] = [[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]];

impl Published {
    /// Converts the first layer of a vision transformer that was trained on images with `ImageNet`'s normalisation: the
    /// built network gets values in -1..1.
    ///
    /// # Errors
    ///
    /// [`ModelError::Setting`] for another kind of network.
    pub fn take_imagenet_normalised(&mut self) -> Result<(), ModelError> {
        let names = ["patch_embed.proj.weight", "patch_embed.proj.bias"];
        let [Some(weight), Some(bias)] = names.map(|name| self.tensors.get(name)) else {
            let allowed = "only a vision transformer's first layer can be converted";
            return Err(ModelError::Setting { key: "imagenet-normalised", value: "true".into(), allowed });
        };
        // (x - mean) / deviation, with x = (y + 1) / 2 for y in -1..1.
        let [mean, deviation] = IMAGENET.map(|v| Tensor::from_slice(&v).to_kind(Kind::Float).view([1, 3, 1, 1]));
        let shift: Tensor = weight * ((0.5 - mean) / &deviation);
        let bias = bias + shift.sum_dim_intlist([1_i64, 2, 3].as_slice(), false, Kind::Float);
        let weight = weight / (deviation * 2.0);
        self.tensors.extend(names.map(str::to_owned).into_iter().zip([weight, bias]));
        Ok(())
    }
}

/// Writes a backbone's tensors to a safetensors file in half precision, as in checkpoints.
///
/// # Errors
///
/// [`ModelError::Mismatch`] names tensors with values beyond half precision.
pub fn write(path: &Path, published: &Published) -> Result<(), ModelError> {
    let half = published.tensors.iter().map(|(name, t)| (name.clone(), t.to_kind(Kind::Half))).collect();
    weights::finite(&half).map_err(|what| ModelError::Mismatch(format!("in half precision: {what}")))?;
    weights::write(path, &published.tensors, Kind::Half)
}

/// Type of a file by its first bytes.
enum Container {
    Safetensors,
    StateDict,
    Index,
    Package(zip::ZipArchive<File>),
}

fn container(path: &Path) -> Result<Container, PretrainedError> {
    let file = |source| PretrainedError::File { path: path.into(), source };
    let head = weights::head(path)?;
    if let Some(what) = carff_base::errors::stand_in(&head) {
        return Err(format(path, what));
    }
    if head.get(8) == Some(&b'{') {
        return Ok(Container::Safetensors);
    }
    if head.starts_with(b"{") {
        return Ok(Container::Index);
    }
    if head.starts_with(b"PK") {
        // `torch.save` also writes ZIP archives: those contain a `data.pkl`.
        let archive = File::open(path).and_then(|f| zip::ZipArchive::new(f).map_err(io::Error::other)).map_err(file)?;
        if !archive.file_names().flatten().any(|name| name == "data.pkl" || name.ends_with("/data.pkl")) {
            return Ok(Container::Package(archive));
        }
    }
    // The reader of state dicts reports any other file.
    Ok(Container::StateDict)
}

/// Extracts the single weight file of a package, and returns its name.
fn unpack(path: &Path, mut archive: zip::ZipArchive<File>, mut to: &File) -> Result<String, PretrainedError> {
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
    Ok(name.clone())
}

/// Reads a state dict that `torch.save` wrote.
fn state_dict(path: &Path) -> Result<Tensors, PretrainedError> {
    let reader = PytorchReader::new(path)
        .map_err(|e| format(path, &format!("not a readable state dict ({e}); safetensors are read as well")))?;
    let tensors = reader
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
            Ok((name, weights::as_float(tensor)))
        })
        .collect::<Result<_, PretrainedError>>()?;
    weights::finite(&tensors).map_err(|what| format(path, &what))?;
    Ok(tensors)
}

/// Tensors of a network without their prefix, and the names of all others.
type Parted = (Tensors, Vec<String>);

/// Returns the tensors with the same prefix as the name that ends in `end`; `None` if there is no such name.
fn without_prefix(tensors: &Tensors, end: &str) -> Result<Option<Parted>, ModelError> {
    let prefixes: Vec<&str> = tensors
        .keys()
        .filter_map(|k| k.strip_suffix(end))
        .filter(|prefix| prefix.is_empty() || prefix.ends_with('.'))
        .collect();
    let prefix = match prefixes[..] {
        [] => return Ok(None),
        [prefix] => prefix,
        _ => {
            let names = prefixes.iter().map(|prefix| format!("`{prefix}{end}`")).collect();
            let names = weights::first_of(names, ", ");
            return Err(ModelError::Mismatch(format!("several networks: {names}; write one to a file of its own")));
        }
    };
    let own = tensors.iter().filter_map(|(k, t)| Some((k.strip_prefix(prefix)?.to_owned(), t.shallow_clone())));
    let outside = tensors.keys().filter(|k| !k.starts_with(prefix)).cloned();
    Ok(Some((own.collect(), outside.collect())))
}

fn format(path: &Path, what: &str) -> PretrainedError {
    PretrainedError::Format { path: path.into(), what: what.into() }
}
