//! Named tensors in safetensors files, with errors that list the keys that differ.

use crate::ModelError;
use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::Read,
    path::Path,
};
use tch::{Kind, Tensor, nn::VarStore};

/// Tensors by name, in a fixed order.
pub type Tensors = BTreeMap<String, Tensor>;

/// Reads every tensor of a safetensors file, as `f32` (integers are unchanged).
///
/// # Errors
///
/// Names the file; values that are NaN or infinite are an error that names their tensor.
pub fn read(path: &Path) -> Result<Tensors, ModelError> {
    let format = |what| ModelError::Format { path: path.into(), what };
    // Read first, because libtorch's own message does not name a missing file.
    if let Some(what) = carff_base::errors::stand_in(&head(path)?) {
        return Err(format(what.into()));
    }
    let tensors = Tensor::read_safetensors(path)
        .map_err(|e| format(format!("not a readable safetensors file ({e}); fetch or train the checkpoint again")))?;
    let tensors = tensors.into_iter().map(|(name, t)| (name, as_float(t))).collect();
    finite(&tensors).map_err(format)?;
    Ok(tensors)
}

/// Returns the first 64 bytes of a file, or all bytes of a shorter one.
pub(crate) fn head(path: &Path) -> Result<Vec<u8>, ModelError> {
    let mut head = Vec::new();
    let read = File::open(path).and_then(|file| file.take(64).read_to_end(&mut head));
    read.map(|_| head).map_err(|source| ModelError::File { path: path.into(), source })
}

pub(crate) fn as_float(tensor: Tensor) -> Tensor {
    if tensor.is_floating_point() { tensor.to_kind(Kind::Float) } else { tensor }
}

/// Returns an error that lists the tensors with a value that is NaN or infinite.
pub(crate) fn finite(tensors: &Tensors) -> Result<(), String> {
    let finite = |t: &Tensor| !t.is_floating_point() || t.isfinite().all().int64_value(&[]) == 1;
    let faults: Vec<String> = tensors.iter().filter(|(_, t)| !finite(t)).map(|(name, _)| format!("`{name}`")).collect();
    if faults.is_empty() { Ok(()) } else { Err(format!("NaN or infinite values in {}", first_of(faults, ", "))) }
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

/// Returns the tensors of these names and shapes. Other tensors are omitted if `omitted` accepts their names.
///
/// # Errors
///
/// Lists missing tensors, tensors of another shape, and tensors that are neither wanted nor omitted.
pub fn select(
    tensors: &Tensors,
    wanted: &[(String, Vec<i64>)],
    omitted: impl Fn(&str) -> bool,
) -> Result<Tensors, ModelError> {
    let mut faults = faults(tensors, wanted);
    let names: BTreeSet<&str> = wanted.iter().map(|(name, _)| name.as_str()).collect();
    let foreign = tensors.keys().filter(|k| !names.contains(k.as_str()) && !omitted(k));
    faults.extend(foreign.map(|k| format!("`{k}` has no place in this network")));
    none_of(faults)?;
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
fn none_of(faults: Vec<String>) -> Result<(), ModelError> {
    if faults.is_empty() { Ok(()) } else { Err(ModelError::Mismatch(first_of(faults, "; "))) }
}

/// Joins the first eight entries and the number of further ones.
pub(crate) fn first_of(mut entries: Vec<String>, between: &str) -> String {
    let more = entries.len().saturating_sub(8);
    entries.truncate(8);
    let tail = if more > 0 { format!("{between}and {more} more") } else { String::new() };
    entries.join(between) + &tail
}
