//! Typed look-ups in a transforms file, with errors that name file, place and key.

use std::path::Path;

use serde_json::{Map, Value};

use crate::error::DatasetError;

/// Place in a file, for errors and typed look-ups.
pub(crate) struct Place<'a> {
    pub path: &'a Path,
    pub place: String,
}

impl<'a> Place<'a> {
    pub fn error(&self, key: &str, problem: impl Into<String>) -> DatasetError {
        DatasetError::Key {
            path: self.path.to_owned(),
            place: self.place.clone(),
            key: key.to_owned(),
            problem: problem.into(),
        }
    }

    pub fn within(&self, place: String) -> Place<'a> {
        Place { path: self.path, place }
    }

    pub fn object<'v>(&self, value: &'v Value) -> Result<&'v Map<String, Value>, DatasetError> {
        value.as_object().ok_or_else(|| self.error("{}", format!("must be an object, found {}", kind(value))))
    }

    pub fn array<'v>(&self, map: &'v Map<String, Value>, key: &str) -> Result<&'v Vec<Value>, DatasetError> {
        let value = present(map, key).ok_or_else(|| self.error(key, "is missing"))?;
        value.as_array().ok_or_else(|| self.error(key, format!("must be a list, found {}", kind(value))))
    }

    pub fn number(&self, map: &Map<String, Value>, key: &str) -> Result<Option<f64>, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(None) };
        match value.as_f64() {
            Some(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(self.error(key, format!("must be a finite number, found {}", kind(value)))),
        }
    }

    /// Returns a whole number below `limit`. `3.0` is accepted, because other tools write sizes that way.
    pub fn index(&self, map: &Map<String, Value>, key: &str, limit: usize) -> Result<Option<usize>, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(None) };
        let number = value.as_f64().filter(|n| n.fract() == 0.0 && *n >= 0.0 && *n < limit as f64);
        match number {
            Some(number) => Ok(Some(number as usize)),
            None => Err(self.error(key, format!("must be a whole number from 0 to {}, found {value}", limit - 1))),
        }
    }

    pub fn text<'v>(&self, map: &'v Map<String, Value>, key: &str) -> Result<Option<&'v str>, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(None) };
        value.as_str().map(Some).ok_or_else(|| self.error(key, format!("must be a text, found {}", kind(value))))
    }

    /// Returns a flag; a missing one is false. Tools write `true`, or 1.
    pub fn flag(&self, map: &Map<String, Value>, key: &str) -> Result<bool, DatasetError> {
        let Some(value) = present(map, key) else { return Ok(false) };
        let flag = value.as_bool().or_else(|| value.as_f64().map(|number| number != 0.0));
        flag.ok_or_else(|| self.error(key, format!("must be true or false, found {}", kind(value))))
    }

    pub fn vector(&self, map: &Map<String, Value>, key: &str) -> Result<[f64; 3], DatasetError> {
        let value = present(map, key).ok_or_else(|| self.error(key, "is missing"))?;
        numbers::<3>(value).ok_or_else(|| self.error(key, "must be a list of 3 finite numbers"))
    }
}

/// Returns the value of a key that exists and is not null.
pub(crate) fn present<'v>(map: &'v Map<String, Value>, key: &str) -> Option<&'v Value> {
    map.get(key).filter(|value| !value.is_null())
}

pub(crate) fn numbers<const N: usize>(value: &Value) -> Option<[f64; N]> {
    let list: Vec<f64> = value.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?;
    let list: [f64; N] = list.try_into().ok()?;
    list.iter().all(|v| v.is_finite()).then_some(list)
}

pub(crate) fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "a number",
        Value::String(_) => "a text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}
