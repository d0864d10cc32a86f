//! The field's weights: safetensors in half precision, read without a tensor library.

use crate::{
    CheckpointError, Manifest, files,
    tensors::{StoredTensor, read_tensors},
};
use carff_field::{Field, FieldConfig};
use flate2::{Compression, read::DeflateDecoder, write::DeflateEncoder};
use half::f16;
use safetensors::tensor::{Dtype, TensorView, serialize};
use std::io::{Read as _, Write as _};
use std::path::Path;

/// Endings of the names of bit fields: as the field has them, and as the file stores them, compressed by DEFLATE (RFC
/// 1951). Files of earlier versions store them as the field has them.
const BYTES: &str = ".bytes";
const DEFLATED: &str = ".deflate";
/// Largest number of bytes of a bit field: 2^9 cells a side.
const MOST_BYTES: u64 = 1 << 24;

/// Reads the field of a checkpoint.
pub fn load_field(dir: &Path, manifest: &Manifest) -> Result<Field, CheckpointError> {
    let path = dir.join(files::FIELD);
    let missing = || CheckpointError::Missing { path: dir.into(), part: "field", phase: "nerf" };
    let config = manifest.field.clone().ok_or_else(missing)?;
    if !path.is_file() {
        return Err(missing());
    }
    read(dir, &path, config)
}

fn read(dir: &Path, path: &Path, config: FieldConfig) -> Result<Field, CheckpointError> {
    let wrong =
        |what: String| CheckpointError::Weights { path: dir.into(), what: format!("{}: {what}", path.display()) };
    let rows = read_tensors(path, |_| true).map_err(wrong)?;
    let rows = rows.into_iter().map(inflated).collect::<Result<Vec<_>, _>>().map_err(wrong)?;
    Field::from_tensors(config, rows).map_err(|source| CheckpointError::Field { path: dir.into(), source })
}

/// Returns a tensor with its bit field inflated, and any other tensor unchanged.
fn inflated((name, shape, values): StoredTensor) -> Result<StoredTensor, String> {
    let Some(part) = name.strip_suffix(DEFLATED) else { return Ok((name, shape, values)) };
    let stored: Vec<u8> = values.iter().map(|&v| v as u8).collect();
    let mut bytes = Vec::new();
    let read = DeflateDecoder::new(&stored[..]).take(MOST_BYTES).read_to_end(&mut bytes);
    read.map_err(|e| format!("`{name}` cannot be inflated ({e}); fetch or train the checkpoint again"))?;
    Ok((format!("{part}{BYTES}"), vec![bytes.len()], bytes.into_iter().map(f32::from).collect()))
}

fn deflated(bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes)?;
    encoder.finish()
}

/// Writes the field atomically: weights in half precision, bit fields compressed.
pub fn save_field(dir: &Path, field: &Field) -> Result<(), CheckpointError> {
    let path = dir.join(files::FIELD);
    let wrong =
        |what: String| CheckpointError::Weights { path: dir.into(), what: format!("{}: {what}", path.display()) };
    let file = |source| CheckpointError::File { path: path.clone(), source };
    let tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = field
        .tensors()
        .into_iter()
        .map(|t| {
            if let Some(part) = t.name.strip_suffix(BYTES) {
                let data = deflated(&t.data.iter().map(|&v| v as u8).collect::<Vec<_>>())?;
                Ok((format!("{part}{DEFLATED}"), Dtype::U8, vec![data.len()], data))
            } else {
                let data = t.data.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect();
                Ok((t.name.into_owned(), Dtype::F16, t.shape, data))
            }
        })
        .collect::<Result<_, _>>()
        .map_err(file)?;
    let views = tensors
        .iter()
        .map(|(name, kind, shape, data)| {
            let view = TensorView::new(*kind, shape.clone(), data).map_err(|e| wrong(format!("`{name}`: {e}")))?;
            Ok((name.as_str(), view))
        })
        .collect::<Result<Vec<_>, CheckpointError>>()?;
    let bytes = serialize(views, &None).map_err(|e| wrong(e.to_string()))?;
    let partial = path.with_extension("partial");
    std::fs::create_dir_all(dir).map_err(file)?;
    std::fs::write(&partial, bytes).map_err(file)?;
    std::fs::rename(&partial, &path).map_err(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensors::values;

    fn config() -> FieldConfig {
        FieldConfig {
            levels: 2,
            log2_table_size: 8,
            max_resolution: 32,
            hidden_width: 32,
            occupancy_resolution: 32,
            ..FieldConfig::default()
        }
    }

    /// A written field is read back, rounded to half precision as training rounds the evaluated weights.
    #[test]
    fn weights_come_back_in_half_precision() {
        let folder = tempfile::tempdir().unwrap();
        let mut field = Field::new(config(), 7).unwrap();
        save_field(folder.path(), &field).unwrap();
        let path = folder.path().join(files::FIELD);
        let loaded = read(folder.path(), &path, config()).unwrap();
        assert_ne!(loaded.tensors(), field.tensors());
        field.round_to_f16();
        assert_eq!(loaded.tensors(), field.tensors());
        // A second round trip changes nothing.
        let bytes = std::fs::read(&path).unwrap();
        save_field(folder.path(), &loaded).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), bytes);
    }

    /// Bit fields are stored compressed; a file that stores them as bytes is read too. Broken ones, and ones of another
    /// length, are refused by name.
    #[test]
    fn bit_fields_are_compressed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(files::FIELD);
        let field = Field::new(config(), 7).unwrap();
        save_field(folder.path(), &field).unwrap();
        let stored = read_tensors(&path, |_| true).unwrap();
        let loaded = read(folder.path(), &path, config()).unwrap().tensors().len();
        let save = |ending: &str, bits: &[u8]| {
            let tensors: Vec<_> = stored
                .iter()
                .map(|(name, shape, values)| {
                    if let Some(part) = name.strip_suffix(DEFLATED) {
                        (format!("{part}{ending}"), Dtype::U8, vec![bits.len()], bits.to_vec())
                    } else {
                        let data = values.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect();
                        (name.clone(), Dtype::F16, shape.clone(), data)
                    }
                })
                .collect();
            let views = tensors.iter().map(|(n, k, s, d)| (n.as_str(), TensorView::new(*k, s.clone(), d).unwrap()));
            std::fs::write(&path, serialize(views, &None).unwrap()).unwrap();
            read(folder.path(), &path, config()).map(|field| field.tensors().len()).map_err(|e| e.to_string())
        };
        let bytes = 32 * 32 * 32 / 8;
        assert_eq!(save(BYTES, &vec![255; bytes]), Ok(loaded));
        let deflate = |n: usize| deflated(&vec![255; n]).unwrap();
        assert_eq!(save(DEFLATED, &deflate(bytes)), Ok(loaded));
        for bits in [deflate(bytes + 1), deflate(1 << 26), vec![255; 9], Vec::new()] {
            let error = save(DEFLATED, &bits).unwrap_err();
            assert!(error.contains("`occupancy.") || error.contains("`changing."), "{error}");
        }
    }

    /// Each known type of weights is read with its values; another type is refused by its name.
    #[test]
    fn types_of_numbers() {
        let numbers = [0.5_f32, -2.0, 96.0];
        let of = |kind, data: Vec<u8>| values(&TensorView::new(kind, vec![3], &data).unwrap());
        assert_eq!(of(Dtype::F32, numbers.iter().flat_map(|v| v.to_le_bytes()).collect()).unwrap(), numbers);
        let halves = numbers.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect();
        assert_eq!(of(Dtype::F16, halves).unwrap(), numbers);
        let brains = numbers.iter().flat_map(|&v| half::bf16::from_f32(v).to_le_bytes()).collect();
        assert_eq!(of(Dtype::BF16, brains).unwrap(), numbers);
        assert_eq!(of(Dtype::U8, vec![0, 7, 255]).unwrap(), [0.0, 7.0, 255.0]);

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(files::FIELD);
        let view = TensorView::new(Dtype::I64, vec![1], &[0; 8]).unwrap();
        std::fs::write(&path, serialize([("grid.table", view)], &None).unwrap()).unwrap();
        let error = read(folder.path(), &path, config()).unwrap_err().to_string();
        assert!(error.contains("`grid.table` is of type I64") && error.contains(files::FIELD), "{error}");
    }
}
