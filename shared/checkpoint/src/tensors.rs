//! Reads safetensors without a tensor library.

use half::f16;
use safetensors::{
    SafeTensors,
    tensor::{Dtype, TensorView},
};
use std::path::Path;

/// Name, shape and values of a tensor.
pub type StoredTensor = (String, Vec<usize>, Vec<f32>);

/// Reads the tensors of a safetensors file whose names are `wanted`, as `f32`. The error does not name the file.
pub fn read_tensors(path: &Path, wanted: impl Fn(&str) -> bool) -> Result<Vec<StoredTensor>, String> {
    let bytes = std::fs::read(path).map_err(|e| e.to_string())?;
    if let Some(what) = carff_base::errors::stand_in(&bytes[..bytes.len().min(64)]) {
        return Err(what.into());
    }
    let tensors = SafeTensors::deserialize(&bytes)
        .map_err(|e| format!("not a readable safetensors file ({e}); fetch or train the checkpoint again"))?;
    let rows = tensors.tensors().into_iter().filter(|(name, _)| wanted(name));
    rows.map(|(name, tensor)| match values(&tensor) {
        Some(values) => Ok((name, tensor.shape().to_vec(), values)),
        None => Err(format!("`{name}` is of type {:?}; known are F16, BF16, F32, F64 and U8", tensor.dtype())),
    })
    .collect()
}

/// Returns a tensor's values as `f32`; `None` for an unknown type.
pub(crate) fn values(tensor: &TensorView<'_>) -> Option<Vec<f32>> {
    let data = tensor.data();
    let pairs = || data.as_chunks::<2>().0.iter();
    Some(match tensor.dtype() {
        Dtype::U8 => data.iter().map(|&b| f32::from(b)).collect(),
        Dtype::F16 => pairs().map(|&b| f16::from_le_bytes(b).to_f32()).collect(),
        Dtype::BF16 => pairs().map(|&b| half::bf16::from_le_bytes(b).to_f32()).collect(),
        Dtype::F32 => data.as_chunks::<4>().0.iter().map(|&b| f32::from_le_bytes(b)).collect(),
        Dtype::F64 => data.as_chunks::<8>().0.iter().map(|&b| f64::from_le_bytes(b) as f32).collect(),
        _ => return None,
    })
}
