//! Tables as Markdown.

use std::fmt::Write;

/// A head row with its rule.
pub fn head(page: &mut String, cells: &[&str]) {
    let _ = writeln!(page, "| {} |\n|{}", cells.join(" | "), "---|".repeat(cells.len()));
}

/// A row.
pub fn row(page: &mut String, cells: &[String]) {
    let _ = writeln!(page, "| {} |", cells.join(" | "));
}

/// A level in dB, or a dash.
pub fn db(value: Option<f64>) -> String {
    value.map_or_else(|| "-".into(), |v| format!("{v:.1}"))
}

/// A share in percent.
pub fn percent(value: f64) -> String {
    // No minus before a zero.
    format!("{:.1}", 100.0 * value + 0.0)
}
