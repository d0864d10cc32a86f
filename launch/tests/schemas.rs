//! Tests of the shipped schemas: they are up to date, and the shipped files name them and have only their keys.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_launch::schema::{FileKind, schema};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn configs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs")
}

/// The files in configs/schemas equal the output of `carff schema`. (That of training files is tested in `carff-lab`.)
#[test]
fn the_shipped_schemas_are_up_to_date() {
    for kind in FileKind::ALL {
        let Some(schema) = schema(kind) else { continue };
        let path = configs().join("schemas").join(kind.file());
        let there: Value =
            std::fs::read_to_string(&path).ok().and_then(|t| serde_json::from_str(&t).ok()).unwrap_or_default();
        assert!(there == schema, "run `carff schema {} > {}`", format!("{kind:?}").to_lowercase(), path.display());
    }
}

/// Every shipped file names its schema for editors, and has only keys of the schema.
#[test]
fn schemas_know_the_keys_of_shipped_files() {
    for kind in FileKind::ALL {
        let path = configs().join("schemas").join(kind.file());
        let schema: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
        let mut files = 0;
        for entry in std::fs::read_dir(configs().join(kind.folder())).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            let named = format!("#:schema ../schemas/{}", kind.file());
            assert_eq!(text.lines().next(), Some(named.as_str()), "the first line of {}", path.display());
            let mut value: Value = toml::from_str(&text).unwrap();
            assert_eq!(unknown(&value, &schema, &schema), Vec::<String>::new(), "{}", path.display());
            value["no_such_key"] = Value::from(1);
            assert_eq!(unknown(&value, &schema, &schema), ["no_such_key"], "{}", path.display());
            files += 1;
        }
        assert!(files > 0, "no {kind:?} files");
    }
}

/// Returns the keys of a value, at any depth, that its schema does not contain.
fn unknown(value: &Value, schema: &Value, root: &Value) -> Vec<String> {
    let branches = branches(schema, root);
    match value {
        Value::Object(map) => map
            .iter()
            .flat_map(|(key, inner)| match branches.iter().find_map(|branch| branch["properties"].get(key)) {
                Some(property) => unknown(inner, property, root),
                None => vec![key.clone()],
            })
            .collect(),
        Value::Array(items) => {
            let of_items = branches.iter().find_map(|branch| branch.get("items")).unwrap_or(&Value::Null);
            items.iter().flat_map(|item| unknown(item, of_items, root)).collect()
        }
        _ => Vec::new(),
    }
}

/// Returns a schema with all schemas that it refers to or combines.
fn branches<'a>(schema: &'a Value, root: &'a Value) -> Vec<&'a Value> {
    let referred = schema["$ref"].as_str().and_then(|path| root.pointer(path.trim_start_matches('#')));
    let combined = ["allOf", "anyOf", "oneOf"].into_iter().filter_map(|key| schema[key].as_array()).flatten();
    let mut all = vec![schema];
    all.extend(referred.into_iter().chain(combined).flat_map(|inner| branches(inner, root)));
    all
}
