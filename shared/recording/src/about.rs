//! Metadata of a recorded run.

use std::collections::BTreeMap;

/// Version of the layout of recordings.
const FORMAT: &str = "1";
/// Prefix of the keys of the origin.
const ORIGIN: &str = "origin.";
/// Name of the metadata record.
pub(crate) const METADATA: &str = "carff";

/// Metadata of a recorded run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordingAbout {
    /// Name of the run.
    pub run: String,
    /// Id of the run.
    pub run_id: u64,
    /// Path of the graph file.
    pub graph: String,
    /// Contents of the graph file.
    pub graph_text: String,
    /// Folder of the dataset.
    pub dataset: String,
    /// Folder of the trained models.
    pub checkpoint: String,
    /// Difference of wall-clock time (nanoseconds since 1970) and monotonic time at the start of the recording.
    pub wall_offset_ns: u64,
    /// Names of the scenario's states, by state.
    pub states: Vec<String>,
    /// Origin of the recording: version and commit of the program, host, start of the run, hash of the checkpoint.
    pub origin: BTreeMap<String, String>,
}

impl RecordingAbout {
    pub(crate) fn to_metadata(&self) -> BTreeMap<String, String> {
        let known = [
            ("format", FORMAT.to_owned()),
            ("run", self.run.clone()),
            ("run_id", format!("{:016x}", self.run_id)),
            ("graph", self.graph.clone()),
            ("graph_text", self.graph_text.clone()),
            ("dataset", self.dataset.clone()),
            ("checkpoint", self.checkpoint.clone()),
            ("wall_offset_ns", self.wall_offset_ns.to_string()),
            ("states", self.states.join("\n")),
        ];
        let origin = self.origin.iter().map(|(key, value)| (format!("{ORIGIN}{key}"), value.clone()));
        known.map(|(key, value)| (key.to_owned(), value)).into_iter().chain(origin).collect()
    }

    /// Returns the run of the metadata; `None` for another version.
    pub(crate) fn from_metadata(map: &BTreeMap<String, String>) -> Option<Self> {
        let text = |key: &str| map.get(key).cloned();
        if map.get("format").map(String::as_str) != Some(FORMAT) {
            return None;
        }
        Some(Self {
            run: text("run")?,
            run_id: u64::from_str_radix(map.get("run_id")?, 16).ok()?,
            graph: text("graph")?,
            graph_text: text("graph_text")?,
            dataset: text("dataset")?,
            checkpoint: text("checkpoint")?,
            wall_offset_ns: map.get("wall_offset_ns")?.parse().ok()?,
            // Older recordings lack the rest.
            states: text("states").unwrap_or_default().lines().map(str::to_owned).collect(),
            origin: map.iter().filter_map(|(k, v)| Some((k.strip_prefix(ORIGIN)?.to_owned(), v.clone()))).collect(),
        })
    }
}
