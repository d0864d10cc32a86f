//! Forms as indented text.

use serde_json::Value;
use std::fmt::Write;

/// Formats a JSON value as lines of `key: value`, like YAML; lists of plain values stay on one line.
pub fn as_text(value: &Value) -> String {
    let mut text = String::new();
    write(&mut text, value, 0);
    text
}

fn write(text: &mut String, value: &Value, indent: usize) {
    let pad = "  ".repeat(indent);
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                // Writing to a string does not fail.
                if is_plain(value) {
                    let _ = writeln!(text, "{pad}{key}: {}", plain(value));
                } else {
                    let _ = writeln!(text, "{pad}{key}:");
                    write(text, value, indent + 1);
                }
            }
        }
        Value::Array(list) => {
            for value in list {
                let mut entry = String::new();
                write(&mut entry, value, indent + 1);
                // The first key follows the dash.
                let _ = write!(text, "{pad}- {}", entry.trim_start());
            }
        }
        value => {
            let _ = writeln!(text, "{pad}{}", plain(value));
        }
    }
}

fn is_plain(value: &Value) -> bool {
    match value {
        Value::Array(list) => list.iter().all(|v| !v.is_object() && !v.is_array()),
        Value::Object(_) => false,
        _ => true,
    }
}

fn plain(value: &Value) -> String {
    match value {
        Value::Null => "none".to_owned(),
        Value::Bool(true) => "yes".to_owned(),
        Value::Bool(false) => "no".to_owned(),
        Value::String(text) => text.clone(),
        Value::Array(list) => format!("[{}]", list.iter().map(plain).collect::<Vec<_>>().join(", ")),
        // Numbers are printed with the precision of the messages.
        Value::Number(number) if number.is_f64() => {
            number.as_f64().map_or_else(String::new, |v| (v as f32).to_string())
        }
        value => value.to_string(),
    }
}
