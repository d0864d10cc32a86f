//! The field's weights: safetensors in half precision, read without a tensor library.

use crate::{CheckpointError, Manifest, files, tensors::read_tensors};
use carff_field::{Field, FieldConfig};
use half::f16;
use safetensors::tensor::{Dtype, TensorView, serialize};
use std::path::Path;

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
    Field::from_tensors(config, rows).map_err(|source| CheckpointError::Field { path: dir.into(), source })
}

/// Writes the field atomically: weights in half precision, bit fields as bytes.
pub fn save_field(dir: &Path, field: &Field) -> Result<(), CheckpointError> {
    let path = dir.join(files::FIELD);
    let wrong =
        |what: String| CheckpointError::Weights { path: dir.into(), what: format!("{}: {what}", path.display()) };
    let file = |source| CheckpointError::File { path: path.clone(), source };
    let tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = field
        .tensors()
        .into_iter()
        .map(|t| {
            let (kind, data) = if t.name.ends_with(".bytes") {
                (Dtype::U8, t.data.iter().map(|&v| v as u8).collect())
            } else {
                (Dtype::F16, t.data.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect())
            };
            (t.name.into_owned(), kind, t.shape, data)
        })
        .collect();
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
