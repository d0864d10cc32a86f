//! Cross-process tests: their shared helpers.
