//! Figures by key: written as JSON, and compared with an earlier run.

use anyhow::Context;
use serde_json::{Map, Value, json};
use std::fmt::Write;
use std::path::Path;

/// The figures of a benchmark. Keys are dotted paths that begin with the benchmark's name.
#[derive(Clone, Debug, Default)]
pub struct Report {
    figures: Map<String, Value>,
}

impl Report {
    /// Records a figure under a path such as `field.render_fps`. A value that is not finite becomes null.
    pub fn set(&mut self, key: &str, value: f64) {
        // No figure is more precise than six digits.
        let rounded = format!("{value:.6e}").parse().unwrap_or(value);
        self.set_value(key, json!(rounded));
    }

    /// Records any other value.
    pub fn set_value(&mut self, key: &str, value: Value) {
        let mut parts: Vec<&str> = key.split('.').collect();
        let Some(last) = parts.pop() else { return };
        let mut map = &mut self.figures;
        for part in parts {
            let entry = map.entry(part).or_insert_with(|| json!({}));
            if !entry.is_object() {
                *entry = json!({});
            }
            let Some(below) = entry.as_object_mut() else { return };
            map = below;
        }
        map.insert(last.to_owned(), value);
    }

    /// Writes figures and machine. Other benchmarks' figures in the file are kept if they are of this machine.
    pub fn write(&self, path: &Path, machine: &Value) -> anyhow::Result<()> {
        let hardware = |machine: &Value| {
            let mut machine = machine.clone();
            if let Some(map) = machine.as_object_mut() {
                map.retain(|key, _| !["date", "libtorch"].contains(&key.as_str()));
            }
            machine
        };
        let mut machine = machine.clone();
        let mut all = Map::new();
        if path.is_file()
            && let Value::Object(old) = read(path)?
        {
            if let Some(there) = old.get("machine").filter(|there| hardware(there) == hardware(&machine)) {
                // A benchmark without libtorch keeps the version of the others.
                if machine["libtorch"].is_null() {
                    machine["libtorch"] = there["libtorch"].clone();
                }
                all = old;
            } else {
                println!("{} is of another machine; its figures are replaced", path.display());
            }
        }
        all.insert("machine".to_owned(), machine);
        all.extend(self.figures.clone());
        let context = || format!("cannot write {}", path.display());
        if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).with_context(context)?;
        }
        std::fs::write(path, serde_json::to_string_pretty(&all)? + "\n").with_context(context)
    }

    /// Returns a table of all common figures with their ratios, new over old.
    pub fn compared_with(&self, baseline: &Value) -> String {
        let mut rows = vec![["figure", "before", "now", "now / before"].map(str::to_owned)];
        let (mut now, mut then) = (Vec::new(), Vec::new());
        flatten("", &Value::Object(self.figures.clone()), &mut now);
        flatten("", baseline, &mut then);
        for (key, value) in &now {
            if let Some((_, before)) = then.iter().find(|(k, _)| k == key) {
                rows.push([key.clone(), number(*before), number(*value), format!("{:.3}", value / before)]);
            }
        }
        if rows.len() == 1 {
            return "the baseline has none of these figures\n".to_owned();
        }
        table(&rows)
    }
}

/// Reads the figures of a file.
pub fn read(path: &Path) -> anyhow::Result<Value> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_str(&text)
        .with_context(|| format!("{} does not contain figures that `--json` wrote", path.display()))
}

/// Collects all numbers below a value by their paths.
fn flatten(path: &str, value: &Value, out: &mut Vec<(String, f64)>) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                let below = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                flatten(&below, value, out);
            }
        }
        Value::Number(number) => out.extend(number.as_f64().map(|n| (path.to_owned(), n))),
        _ => {}
    }
}

/// Formats a number with three significant digits.
pub fn number(value: f64) -> String {
    match value.abs() {
        a if !a.is_finite() => "-".to_owned(),
        a if a >= 100.0 => format!("{value:.0}"),
        a if a >= 10.0 => format!("{value:.1}"),
        a if a >= 1.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

/// Formats columns: the first is left-aligned, the others are right-aligned. The first row is the heading.
pub fn table<const N: usize>(rows: &[[String; N]]) -> String {
    let widths: [usize; N] =
        std::array::from_fn(|c| rows.iter().map(|row| row[c].chars().count()).max().unwrap_or_default());
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        let mut line = String::new();
        for (c, cell) in row.iter().enumerate() {
            let width = widths[c];
            // Writing to a string cannot fail.
            let _ = if c == 0 { write!(line, "{cell:<width$}") } else { write!(line, "  {cell:>width$}") };
        }
        text.push_str(line.trim_end());
        text.push('\n');
        if i == 0 {
            text.push_str(&"-".repeat(widths.iter().sum::<usize>() + 2 * (N - 1)));
            text.push('\n');
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(fps: f64) -> Report {
        let mut report = Report::default();
        report.set("field.render_fps", fps);
        report.set("field.limit.gflops", 200.0);
        report.set_value("field.instruction_set", json!("avx2"));
        report
    }

    /// Keys are nested. Another benchmark's figures are kept on the same machine at any date, and dropped on another
    /// one. A benchmark without libtorch keeps its version.
    #[test]
    fn files_are_merged_by_machine() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/figures.json");
        let machine = |name: &str, date: &str| json!({ "cpu": name, "date": date });
        let with_libtorch = json!({ "cpu": "a", "date": "Monday", "libtorch": "2.11.0" });
        report(30.0).write(&path, &with_libtorch).unwrap();
        let mut other = Report::default();
        other.set("loop.p50_ms", f64::NAN);
        other.write(&path, &machine("a", "Tuesday")).unwrap();
        let value = read(&path).unwrap();
        assert_eq!(value["field"]["render_fps"], json!(30.0));
        assert_eq!(value["field"]["limit"]["gflops"], json!(200.0));
        assert_eq!(value["loop"]["p50_ms"], Value::Null);
        assert_eq!(value["machine"], json!({ "cpu": "a", "date": "Tuesday", "libtorch": "2.11.0" }));
        other.write(&path, &machine("b", "Tuesday")).unwrap();
        assert_eq!(read(&path).unwrap().get("field"), None);
        std::fs::write(&path, "{").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("figures.json"));
    }

    /// Common figures are compared as new over old; other figures are left out.
    #[test]
    fn comparison_is_a_ratio() {
        let baseline = json!({ "field": { "render_fps": 20.0, "gone": 1.0 }, "machine": { "cores": 2 } });
        let text = report(30.0).compared_with(&baseline);
        let row: Vec<&str> = text.lines().nth(2).unwrap().split_whitespace().collect();
        assert_eq!(row, ["field.render_fps", "20.0", "30.0", "1.500"]);
        assert_eq!(text.lines().count(), 3);
        assert!(report(1.0).compared_with(&json!({})).contains("none"));
    }

    /// Columns are aligned.
    #[test]
    fn tables_line_up() {
        let rows = [["a", "bb"], ["long", "1"]].map(|row| row.map(str::to_owned));
        assert_eq!(table(&rows), "a     bb\n--------\nlong   1\n");
    }
}
