//! Named tensors on disk: safetensors in and out, with errors that list the keys that differ.

use crate::ModelError;
use std::{collections::BTreeMap, path::Path};
use tch::{Kind, Tensor, nn::VarStore};

/// Tensors by name, in a fixed order.
pub type Tensors = BTreeMap<String, Tensor>;

/// Reads every tensor of a safetensors file, as `f32` (integers stay what they are).
pub fn read(path: &Path) -> Result<Tensors, ModelError> {
    // Looked at first, since libtorch's own message would not say which file is missing.
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

/// Writes tensors to a safetensors file, floating point ones as `kind`; the file appears whole or not at all.
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

/// The variables of a store, by name.
pub fn of_store(store: &VarStore) -> Tensors {
    store.variables().into_iter().collect()
}

/// Copies `tensors` into a store's variables. Every key must be there with its shape, and none besides.
pub fn fill_store(store: &VarStore, tensors: &Tensors) -> Result<(), ModelError> {
    let variables = of_store(store);
    let mut faults = Vec::new();
    for (name, variable) in &variables {
        match tensors.get(name) {
            None => faults.push(format!("`{name}` is missing")),
            Some(t) if t.size() != variable.size() => {
                faults.push(format!("`{name}` is {:?}, the model wants {:?}", t.size(), variable.size()));
            }
            Some(_) => {}
        }
    }
    faults.extend(tensors.keys().filter(|k| !variables.contains_key(*k)).map(|k| format!("`{k}` is unknown")));
    if !faults.is_empty() {
        let more = faults.len().saturating_sub(8);
        faults.truncate(8);
        let tail = if more > 0 { format!("; and {more} more") } else { String::new() };
        return Err(ModelError::Mismatch(faults.join("; ") + &tail));
    }
    tch::no_grad(|| {
        for (name, mut variable) in variables {
            variable.copy_(&tensors[&name]);
        }
    });
    Ok(())
}

/// Takes one tensor of a given shape.
pub fn take(tensors: &Tensors, name: &str, shape: &[i64]) -> Result<Tensor, ModelError> {
    let t = tensors.get(name).ok_or_else(|| ModelError::Mismatch(format!("`{name}` is missing")))?;
    if t.size() == shape {
        Ok(t.shallow_clone())
    } else {
        Err(ModelError::Mismatch(format!("`{name}` is {:?}, the model wants {shape:?}", t.size())))
    }
}
