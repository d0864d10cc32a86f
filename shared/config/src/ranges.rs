//! Checks a file's numbers and lists against the limits of its JSON Schema.

use crate::ConfigError;
use crate::error::Source;
use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use toml::Value;

/// Reads a file's text, and checks each value against `minimum`, `maximum` and `minItems` in the schema of `T`.
pub(crate) fn read<T: DeserializeOwned + JsonSchema>(source: &Source<'_>) -> Result<T, ConfigError> {
    let config = toml::from_str(source.text).map_err(|e| source.syntax(&e))?;
    let values = toml::from_str(source.text).map_err(|e| source.syntax(&e))?;
    let schema = schemars::schema_for!(T);
    Walk { source, definitions: &schema.as_value()["$defs"] }.check(schema.as_value(), &values, "")?;
    Ok(config)
}

struct Walk<'a> {
    source: &'a Source<'a>,
    definitions: &'a Json,
}

impl Walk<'_> {
    fn check(&self, schema: &Json, value: &Value, key: &str) -> Result<(), ConfigError> {
        if let Some(name) = schema["$ref"].as_str().and_then(|path| path.rsplit('/').next()) {
            self.check(&self.definitions[name], value, key)?;
        }
        for choice in ["anyOf", "oneOf", "allOf"].iter().filter_map(|kind| schema[kind].as_array()).flatten() {
            self.check(choice, value, key)?;
        }
        match value {
            Value::Integer(number) => self.number(schema, *number as f64, key),
            Value::Float(number) => self.number(schema, *number, key),
            Value::Array(items) => {
                if schema["minItems"].as_u64().is_some_and(|least| (items.len() as u64) < least) {
                    return Err(self.source.range(key, value.to_string(), "at least one entry".to_owned()));
                }
                items.iter().try_for_each(|item| self.check(&schema["items"], item, key))
            }
            Value::Table(table) => table.iter().try_for_each(|(name, value)| {
                let dotted = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
                self.check(&schema["properties"][name], value, &dotted)
            }),
            _ => Ok(()),
        }
    }

    fn number(&self, schema: &Json, number: f64, key: &str) -> Result<(), ConfigError> {
        let (Some(min), Some(max)) = (schema["minimum"].as_f64(), schema["maximum"].as_f64()) else { return Ok(()) };
        if (min..=max).contains(&number) {
            return Ok(());
        }
        Err(self.source.range(key, number.to_string(), format!("{min} to {max}")))
    }
}
