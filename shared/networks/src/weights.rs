//! Named tensors in safetensors files, with errors that list the keys that differ.

use crate::ModelError;
use std::{collections::BTreeMap, path::Path};
use tch::{Kind, Tensor, nn::VarStore};

/// Tensors by name, in a fixed order.
pub type Tensors = BTreeMap<String, Tensor>;

/// Reads every tensor of a safetensors file, as `f32` (integers are unchanged).
pub fn read(path: &Path) -> Result<Tensors, ModelError> {
    // Checked first, because libtorch's own message does not name a missing file.
    std::fs::metadata(path).map_err(|source| ModelError::File { path: path.into(), source })?;
    let tensors = Tensor::read_safetensors(path).map_err(|e| ModelError::Format {
        path: path.into(),
        what: format!("not a readable safetensors file ({e}); fetch or train the checkpoint again"),
    })?;
    Ok(tensors
        .into_iter()
        .map(|(name, t)| (name, if t.is_floating_point() { t.to_kind(Kind::Float) } else { t }))
        .collect())
}

/// Writes tensors to a safetensors file atomically, floating point tensors as `kind`.
pub fn write(path: &Path, tensors: &Tensors, kind: Kind) -> Result<(), ModelError> {
    let list: Vec<(String, Tensor)> = tensors
        .iter()
        .map(|(name, t)| {
            let t = t.detach().to_device(tch::Device::Cpu);
            (name.clone(), if t.is_floating_point() { t.to_kind(kind) } else { t }.contiguous())
        })
        .collect();
    let partial = path.with_extension("partial");
    Tensor::write_safetensors(&list, &partial)?;
    std::fs::rename(&partial, path).map_err(|source| ModelError::File { path: path.into(), source })
}

/// Returns the variables of a store, by name.
pub fn of_store(store: &VarStore) -> Tensors {
    store.variables().into_iter().collect()
}

/// Copies `tensors` into a store's variables. The keys and shapes must match exactly.
pub fn fill_store(store: &VarStore, tensors: &Tensors) -> Result<(), ModelError> {
    let variables = of_store(store);
    let wanted: Vec<(String, Vec<i64>)> = variables.iter().map(|(name, v)| (name.clone(), v.size())).collect();
    let mut faults = faults(tensors, &wanted);
    faults.extend(tensors.keys().filter(|k| !variables.contains_key(*k)).map(|k| format!("`{k}` is unknown")));
    none_of(faults)?;
    tch::no_grad(|| {
        for (name, mut variable) in variables {
            variable.copy_(&tensors[&name]);
        }
    });
    Ok(())
}

/// Returns the tensors of these names and shapes; the error lists missing tensors and tensors of another shape.
pub fn select(tensors: &Tensors, wanted: &[(String, Vec<i64>)]) -> Result<Tensors, ModelError> {
    none_of(faults(tensors, wanted))?;
    Ok(wanted.iter().filter_map(|(name, _)| Some((name.clone(), tensors.get(name)?.shallow_clone()))).collect())
}

/// Returns descriptions of missing tensors and tensors of another shape.
fn faults(tensors: &Tensors, wanted: &[(String, Vec<i64>)]) -> Vec<String> {
    let fault = |(name, shape): &(String, Vec<i64>)| match tensors.get(name) {
        None => Some(format!("`{name}` is missing")),
        Some(t) if t.size() != *shape => Some(format!("`{name}` is {:?}, the model wants {shape:?}", t.size())),
        Some(_) => None,
    };
    wanted.iter().filter_map(fault).collect()
}

/// Returns an error with the first faults and the number of further ones; `Ok` without faults.
fn none_of(mut faults: Vec<String>) -> Result<(), ModelError> {
    if faults.is_empty() {
        return Ok(());
    }
    let more = faults.len().saturating_sub(8);
    faults.truncate(8);
    let tail = if more > 0 { format!("; and {more} more") } else { String::new() };
    Err(ModelError::Mismatch(faults.join("; ") + &tail))
}
