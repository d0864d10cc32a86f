//! `carff schema`: the JSON Schema of each kind of file, generated from the structures that read the file. Editors use
//! it for completion and checks. `configs/schemas` contains the generated files. With `--python` or `--c`, the layouts of
//! the messages in shared memory.

use anyhow::Context;
use carff_config::{GraphConfig, SoakConfig};
use carff_scenes::config::ScenarioConfig;
use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde_json::Value;

/// Print the schema of a kind of file, or the layouts of the messages.
#[derive(Clone, Debug, clap::Args)]
#[group(required = true, multiple = false)]
pub struct SchemaArgs {
    /// Kind of file.
    pub kind: Option<FileKind>,
    /// Print the layouts of all messages as a Python module (python/carff/layouts.py).
    #[arg(long)]
    pub python: bool,
    /// Print the layouts of all messages as a header for C and C++ (examples/cpp/carff.h).
    #[arg(long)]
    pub c: bool,
}

/// A kind of file that a user writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum FileKind {
    /// A graph, as in configs/graphs.
    Graph,
    /// A world to render, as in configs/scenarios.
    Scenario,
    /// The training of models, as in configs/training.
    Training,
    /// Faults and the contract of a graph under them, as in configs/soak.
    Soak,
}

impl FileKind {
    /// Lists all kinds of files.
    pub const ALL: [Self; 4] = [Self::Graph, Self::Scenario, Self::Training, Self::Soak];

    /// Returns the folder of the shipped files, below `configs`.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Graph => "graphs",
            Self::Scenario => "scenarios",
            Self::Training => "training",
            Self::Soak => "soak",
        }
    }

    /// Returns the schema's file name, below `configs/schemas`.
    pub fn file(self) -> &'static str {
        match self {
            Self::Graph => "graph.schema.json",
            Self::Scenario => "scenario.schema.json",
            Self::Training => "training.schema.json",
            Self::Soak => "soak.schema.json",
        }
    }

    fn title(self) -> &'static str {
        match self {
            Self::Graph => "CARFF graph file",
            Self::Scenario => "CARFF scenario file",
            Self::Training => "CARFF training file",
            Self::Soak => "CARFF soak file",
        }
    }
}

/// Returns the schema of a kind of file; `None` for training files, whose structure only `carff-lab` has.
pub fn schema(kind: FileKind) -> Option<Value> {
    match kind {
        FileKind::Graph => Some(schema_of::<GraphConfig>(kind)),
        FileKind::Scenario => Some(schema_of::<ScenarioConfig>(kind)),
        FileKind::Training => None,
        FileKind::Soak => Some(schema_of::<SoakConfig>(kind)),
    }
}

/// Returns the schema of a structure that reads a kind of file: draft 7, which editors support best.
pub fn schema_of<T: JsonSchema>(kind: FileKind) -> Value {
    let mut schema = SchemaSettings::draft07().into_generator().into_root_schema_for::<T>();
    schema.insert("title".to_owned(), kind.title().into());
    let mut schema = schema.to_value();
    tidy(&mut schema);
    schema
}

/// Returns a schema as the text of its file.
pub fn text(schema: &Value) -> serde_json::Result<String> {
    Ok(serde_json::to_string_pretty(schema)? + "\n")
}

/// Prints the schema or the layouts.
pub fn run(args: &SchemaArgs) -> anyhow::Result<()> {
    let text = match args.kind {
        Some(kind) => text(&schema(kind).context("`carff schema` prints this schema")?)?,
        None if args.python => carff::layout::python(),
        None => carff::layout::c(),
    };
    print!("{text}");
    Ok(())
}

/// Puts descriptions on one line, and shortens single-precision defaults (0.02, not 0.019999999552965164).
fn tidy(value: &mut Value) {
    match value {
        Value::Object(map) => {
            for (key, inner) in map {
                match inner {
                    Value::String(text) if key == "description" => *text = text.replace('\n', " "),
                    _ => tidy(inner),
                }
            }
        }
        Value::Array(items) => items.iter_mut().for_each(tidy),
        Value::Number(number) => {
            if let Some(exact) = number.as_f64().filter(|v| number.is_f64() && f64::from(*v as f32) == *v)
                && let Ok(short) = (exact as f32).to_string().parse::<f64>()
            {
                *value = short.into();
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file's keys are in its schema with their descriptions, no other keys are allowed, and defaults are readable.
    #[test]
    fn schemas_say_what_keys_mean() {
        let graph = schema(FileKind::Graph).unwrap();
        assert_eq!(graph["title"], "CARFF graph file");
        assert_eq!(graph["additionalProperties"], false);
        assert_eq!(graph["required"], serde_json::json!(["run"]));
        let horizon = &graph["definitions"]["RunConfig"]["properties"]["horizon"];
        assert!(horizon["description"].as_str().is_some_and(|d| d.contains("1 to 8")), "{horizon}");
        assert_eq!(horizon["default"], 2);
        let gain = &graph["definitions"]["SensorNoise"]["properties"]["gain_sigma"];
        assert_eq!(gain["default"], 0.02, "{gain}");
        let scenario = schema(FileKind::Scenario).unwrap();
        let ground = &scenario["properties"]["ground_colour"];
        assert_eq!((&ground["type"], &ground["default"]), (&"string".into(), &"#5d8a3c".into()), "{ground}");
        assert!(scenario["properties"]["branches"]["items"]["type"] == "string", "{scenario}");
    }
}
