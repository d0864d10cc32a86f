//! Named tensors of a safetensors file, each taken once, with its shape checked.

use crate::InferenceError;
use ndarray::{ArrayD, IxDyn};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Tensors by name.
pub type Arrays = BTreeMap<String, ArrayD<f32>>;

/// The tensors of a file that no layer has taken yet.
#[derive(Debug)]
pub struct StoredWeights {
    path: PathBuf,
    tensors: Arrays,
}

impl StoredWeights {
    /// Reads a file. Counters of batch normalisation are left out.
    ///
    /// # Errors
    ///
    /// Names the file; values that are NaN or infinite are an error that names their tensor.
    pub fn read(path: &Path) -> Result<Self, InferenceError> {
        let wrong = |what: String| InferenceError::Weights { path: path.into(), what };
        let rows =
            carff_checkpoint::read_tensors(path, |name| !name.ends_with("num_batches_tracked")).map_err(wrong)?;
        let mut tensors = Arrays::new();
        for (name, shape, values) in rows {
            if values.iter().any(|v| !v.is_finite()) {
                return Err(wrong(format!("NaN or infinite values in `{name}`")));
            }
            let values = ArrayD::from_shape_vec(IxDyn(&shape), values).map_err(|e| wrong(format!("`{name}`: {e}")))?;
            tensors.insert(name, values);
        }
        Ok(Self { path: path.into(), tensors })
    }

    /// Changes the tensors, for example their names.
    pub fn change(&mut self, change: impl FnOnce(Arrays) -> Arrays) {
        self.tensors = change(std::mem::take(&mut self.tensors));
    }

    /// Returns the tensors whose names start with `prefix`, without it, and keeps the others.
    pub fn part(&mut self, prefix: &str) -> Self {
        let names: Vec<String> = self.tensors.keys().filter(|name| name.starts_with(prefix)).cloned().collect();
        let own = names.iter().filter_map(|name| Some((name[prefix.len()..].to_owned(), self.tensors.remove(name)?)));
        Self { path: self.path.clone(), tensors: own.collect() }
    }

    /// Takes a tensor of this shape.
    pub fn take(&mut self, name: &str, shape: &[i64]) -> Result<ArrayD<f32>, InferenceError> {
        let tensor = self.tensors.remove(name).ok_or_else(|| self.wrong(format!("`{name}` is missing")))?;
        if tensor.shape().iter().map(|&n| n as i64).eq(shape.iter().copied()) {
            Ok(tensor)
        } else {
            Err(self.wrong(format!("`{name}` is {:?}, the model wants {shape:?}", tensor.shape())))
        }
    }

    /// Returns an error that names a tensor which no layer has taken, if it is not `ignored`.
    pub fn finish(self, ignored: impl Fn(&str) -> bool) -> Result<(), InferenceError> {
        match self.tensors.keys().find(|name| !ignored(name)) {
            Some(name) => Err(self.wrong(format!("`{name}` has no place in this network"))),
            None => Ok(()),
        }
    }

    /// An error about this file.
    pub fn wrong(&self, what: String) -> InferenceError {
        InferenceError::Weights { path: self.path.clone(), what }
    }
}
