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

    /// Returns the numbers before and after the first "to" of a description, such as 1 and 60000 of "1 to 60000".
    fn documented_range(description: &str) -> Option<[f64; 2]> {
        let words: Vec<&str> = description.split_whitespace().collect();
        let number = |word: &str| word.trim_matches([',', '.', ';', '(', ')']).replace('_', "").parse::<f64>().ok();
        words.windows(3).filter(|w| w[1] == "to").find_map(|w| Some([number(w[0])?, number(w[2])?]))
    }

    /// Collects the numbers of a schema whose descriptions promise another range than the schema has.
    fn contradictions(schema: &Value, found: &mut Vec<String>) {
        let Some(map) = schema.as_object() else { return };
        for (key, property) in map.get("properties").and_then(Value::as_object).into_iter().flatten() {
            let is_number = property["type"] == "integer" || property["type"] == "number";
            let range = property["description"].as_str().and_then(documented_range).filter(|_| is_number);
            let bound = |names: [&str; 2]| names.iter().find_map(|name| property[name].as_f64());
            let held = [bound(["minimum", "exclusiveMinimum"]), bound(["maximum", "exclusiveMaximum"])];
            if range.is_some_and(|range| range.map(Some) != held) {
                found.push(format!("{key}: {held:?}, documented: {range:?}"));
            }
        }
        map.get("definitions")
            .and_then(Value::as_object)
            .into_iter()
            .flatten()
            .for_each(|(_, of)| contradictions(of, found));
    }

    /// The documented range of each number of a file is the range in its schema.
    #[test]
    fn documented_ranges_hold() {
        assert_eq!(documented_range("Age, milliseconds, 1 to 60000. Default 150."), Some([1.0, 60_000.0]));
        assert_eq!(documented_range("from here to there"), None);
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/schemas");
        for kind in FileKind::ALL {
            let text = std::fs::read_to_string(folder.join(kind.file())).unwrap();
            let mut found = Vec::new();
            contradictions(&serde_json::from_str(&text).unwrap(), &mut found);
            assert_eq!(found, Vec::<String>::new(), "{}", kind.file());
        }
    }
}
