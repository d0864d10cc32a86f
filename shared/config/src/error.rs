//! Errors that point at the line.

use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};

/// What is wrong with a graph or soak file.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the {what} file {path}: {source}{}", carff_nearest::beside(path))]
    Read {
        /// What kind of file it was to be.
        what: &'static str,
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is no TOML, has an unknown key, misses one, or has one of a wrong type.
    #[error("{path}:{line}: {}{message}", key.as_ref().map(|k| format!("`{k}`: ")).unwrap_or_default())]
    Syntax {
        /// Which file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// The dotted key, where one is at fault.
        key: Option<String>,
        /// What is wrong and what is allowed.
        message: String,
    },
    /// A value is out of range.
    #[error("{path}:{line}: `{key}` is {value}; allowed: {allowed}")]
    Range {
        /// Which file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// The dotted key.
        key: String,
        /// What was found.
        value: String,
        /// What is allowed.
        allowed: String,
    },
}

/// The text of a file, to find lines and keys in.
pub(crate) struct Source<'a> {
    pub(crate) path: &'a Path,
    pub(crate) text: &'a str,
}

/// Reads a file; `what` kind of file it is to be, errors say.
pub(crate) fn read(path: &Path, what: &'static str) -> Result<String, ConfigError> {
    std::fs::read_to_string(path).map_err(|source| ConfigError::Read { what, path: path.into(), source })
}

impl Source<'_> {
    pub(crate) fn syntax(&self, error: &toml::de::Error) -> ConfigError {
        let offset = error.span().map_or(0, |span| span.start);
        // The message's first line says what; the rest repeats the place, which is said in front already.
        let message = carff_nearest::explained(&error.message().lines().collect::<Vec<_>>().join(", "));
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
