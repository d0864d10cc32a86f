//! Tensors by name: the exchange format of fields and trainers with checkpoints.

use std::borrow::Cow;

use super::layout::Layout;
use crate::config::FieldError;

/// A named array of numbers, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTensor<'a> {
    /// Key in a checkpoint.
    pub name: Cow<'static, str>,
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
    /// Numbers, row-major.
    pub data: Cow<'a, [f32]>,
}

/// Returns a hash table, or its gradient or moments, as a tensor.
pub(crate) fn table_tensor<'a>(
    name: impl Into<Cow<'static, str>>,
    layout: &Layout,
    table: impl Into<Cow<'a, [f32]>>,
) -> NamedTensor<'a> {
    let (data, f) = (table.into(), layout.grid.features_per_level);
    NamedTensor { name: name.into(), shape: vec![data.len() / f, f], data }
}

/// Returns the layers of a flat network buffer (weights, gradients or moments) in the layout of `torch.nn.Linear`.
pub(crate) fn network_tensors(layout: &Layout, networks: &[f32], prefix: &str) -> Vec<NamedTensor<'static>> {
    let mut tensors = Vec::new();
    for (name, layer) in layout.named_layers() {
        let weight = (0..layer.outputs_used)
            .flat_map(|o| (0..layer.rows()).map(move |k| networks[layer.weight + k * layer.outputs + o]))
            .collect();
        tensors.push(NamedTensor {
            name: format!("{prefix}{name}.weight").into(),
            shape: vec![layer.outputs_used, layer.rows()],
            data: Cow::Owned(weight),
        });
        tensors.push(NamedTensor {
            name: format!("{prefix}{name}.bias").into(),
            shape: vec![layer.outputs_used],
            data: Cow::Owned(networks[layer.bias..layer.bias + layer.outputs_used].to_vec()),
        });
    }
    tensors
}

/// Writes one tensor of [`network_tensors`], whose shape has been checked, to a flat network buffer.
pub(crate) fn set_network_tensor(layout: &Layout, networks: &mut [f32], name: &str, data: &[f32]) {
    for (layer_name, layer) in layout.named_layers() {
        match name.strip_prefix(layer_name) {
            Some(".weight") => {
                for (i, v) in data.iter().enumerate() {
                    networks[layer.weight + (i % layer.rows()) * layer.outputs + i / layer.rows()] = *v;
                }
            }
            Some(".bias") => networks[layer.bias..layer.bias + data.len()].copy_from_slice(data),
            _ => {}
        }
    }
}

/// Passes `tensors` to `set` after checking that they have the names and shapes of `wanted` and finite values. `set`
/// may refuse a tensor with a sentence. The error lists all differences.
pub(crate) fn load_tensors(
    wanted: &[(String, Vec<usize>)],
    tensors: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
    mut set: impl FnMut(&str, Vec<f32>) -> Result<(), String>,
) -> Result<(), FieldError> {
    let mut found = vec![false; wanted.len()];
    let mut differences = Vec::new();
    for (name, shape, data) in tensors {
        let Some(at) = wanted.iter().position(|(n, _)| *n == name) else {
            differences.push(format!("`{name}` is not known"));
            continue;
        };
        found[at] = true;
        let wanted = &wanted[at].1;
        if shape != *wanted || data.len() != shape.iter().product::<usize>() {
            let count = data.len();
            differences.push(format!("`{name}` has shape {shape:?} and {count} values, wanted shape {wanted:?}"));
        } else if data.iter().any(|v| !v.is_finite()) {
            differences.push(format!("`{name}` holds values that are not finite"));
        } else if let Err(difference) = set(&name, data) {
            differences.push(difference);
        }
    }
    let missing = wanted.iter().zip(&found).filter(|(_, found)| !**found);
    differences.extend(missing.map(|((name, _), _)| format!("`{name}` is missing")));
    if differences.is_empty() { Ok(()) } else { Err(FieldError::Tensors { differences }) }
}

/// Returns the names and shapes of tensors.
pub(crate) fn names_and_shapes(tensors: Vec<NamedTensor<'_>>) -> Vec<(String, Vec<usize>)> {
    tensors.into_iter().map(|t| (t.name.into_owned(), t.shape)).collect()
}
