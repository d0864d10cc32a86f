//! Errors that point at the line.

use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};

/// An error in a graph or soak file.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the {what} file {path}: {source}{}", carff_base::names::beside(path))]
    Read {
        /// Kind of file.
        what: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file is not valid TOML, or has an unknown, missing or wrongly typed key.
    #[error("{path}:{line}: {}{message}", key.as_ref().map(|k| format!("`{k}`: ")).unwrap_or_default())]
    Syntax {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// The dotted key, if the error has one.
        key: Option<String>,
        /// The problem, and the allowed values.
        message: String,
    },
    /// A key of an earlier version is in the file.
    #[error("{path}:{line}: `{key}` is now called `{now}`")]
    Moved {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// The dotted key.
        key: String,
        /// Current name of the key.
        now: String,
    },
    /// A setting of the command line cannot be applied.
    #[error("`{setting}` sets nothing: wanted is `key=value`, such as `run.samples=35`")]
    Setting {
        /// The setting.
        setting: String,
    },
    /// A value is out of range.
    #[error("{path}:{line}: `{key}` is {value}; allowed: {allowed}")]
    Range {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// The dotted key.
        key: String,
        /// The value found.
        value: String,
        /// The allowed values.
        allowed: String,
    },
}

/// The text of a file, in which lines and keys are found.
pub(crate) struct Source<'a> {
    pub(crate) path: &'a Path,
    pub(crate) text: &'a str,
}

/// Reads a file; errors name the kind of file, `what`.
pub(crate) fn read(path: &Path, what: &'static str) -> Result<String, ConfigError> {
    std::fs::read_to_string(path).map_err(|source| ConfigError::Read { what, path: path.into(), source })
}

impl Source<'_> {
    /// Refuses the first key that has a new name. `moved` pairs old names with new ones; a part `*` stands for any
    /// name, which the new name repeats.
    pub(crate) fn refuse_moved(&self, moved: &[(&str, &str)]) -> Result<(), ConfigError> {
        let Ok(table) = self.text.parse::<toml::Table>() else { return Ok(()) };
        for key in dotted_keys(&table, "") {
            let Some(now) = moved.iter().find_map(|(old, new)| renamed(&key, old, new)) else { continue };
            let line = self.offset_of(&key).map_or(1, |offset| self.line(offset));
            return Err(ConfigError::Moved { path: self.path.into(), line, key, now });
        }
        Ok(())
    }

    pub(crate) fn syntax(&self, error: &toml::de::Error) -> ConfigError {
        let offset = error.span().map_or(0, |span| span.start);
        // The lines after the first one repeat the place, which this error states itself.
        let message = carff_base::names::explained(&error.message().lines().collect::<Vec<_>>().join(", "));
        ConfigError::Syntax { path: self.path.into(), line: self.line(offset), key: self.key_at(offset), message }
    }

    /// An error about the value at a dotted key. A key that is not in the file (a default) is reported for line 1.
    pub(crate) fn range(&self, key: &str, value: String, allowed: String) -> ConfigError {
        let line = self.offset_of(key).map_or(1, |offset| self.line(offset));
        ConfigError::Range { path: self.path.into(), line, key: key.into(), value, allowed }
    }

    fn line(&self, offset: usize) -> usize {
        self.text.bytes().take(offset).filter(|&b| b == b'\n').count() + 1
    }

    fn offset_of(&self, dotted: &str) -> Option<usize> {
        let document = DeTable::parse(self.text).ok()?;
        let mut table = document.get_ref();
        let mut keys = dotted.split('.').peekable();
        while let Some(key) = keys.next() {
            let (found, value) = table.iter().find(|(k, _)| k.get_ref() == key)?;
            if keys.peek().is_none() {
                return Some(found.span().start);
            }
            match value.get_ref() {
                DeValue::Table(inner) => table = inner,
                _ => return Some(found.span().start),
            }
        }
        None
    }

    /// The dotted key whose name or value covers this place in the text.
    fn key_at(&self, offset: usize) -> Option<String> {
        fn search(table: &DeTable<'_>, offset: usize, prefix: &str) -> Option<String> {
            for (key, value) in table {
                let dotted = format!("{prefix}{}", key.get_ref());
                if let DeValue::Table(inner) = value.get_ref()
                    && let Some(found) = search(inner, offset, &format!("{dotted}."))
                {
                    return Some(found);
                }
                if key.span().contains(&offset) || value.span().contains(&offset) {
                    return Some(dotted);
                }
            }
            None
        }
        search(DeTable::parse(self.text).ok()?.get_ref(), offset, "")
    }
}

/// The dotted keys of a table and of the tables in it.
fn dotted_keys(table: &toml::Table, prefix: &str) -> Vec<String> {
    let mut keys = Vec::new();
    for (name, value) in table {
        let key = format!("{prefix}{name}");
        if let toml::Value::Table(inner) = value {
            keys.extend(dotted_keys(inner, &format!("{key}.")));
        }
        keys.push(key);
    }
    keys
}

/// The new name of a key, where it matches the old one.
fn renamed(key: &str, old: &str, new: &str) -> Option<String> {
    let (parts, pattern): (Vec<_>, Vec<_>) = (key.split('.').collect(), old.split('.').collect());
    let matches = parts.len() == pattern.len() && parts.iter().zip(&pattern).all(|(part, p)| *p == "*" || part == p);
    let any = pattern.iter().position(|p| *p == "*").map_or("*", |i| parts.get(i).copied().unwrap_or("*"));
    matches.then(|| new.replace('*', any))
}
