//! What a recording says of its run.

use std::collections::BTreeMap;

/// Version of the layout of recordings.
const FORMAT: &str = "1";
/// Name of the metadata record.
pub(crate) const METADATA: &str = "carff";

/// The run that was recorded.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct About {
    /// Its name.
    pub run: String,
    /// Its id.
    pub run_id: u64,
    /// Path of the graph file.
    pub graph: String,
    /// The graph file itself.
    pub graph_text: String,
    /// Folder of the dataset.
    pub dataset: String,
    /// Folder of the trained models.
    pub checkpoint: String,
    /// Wall-clock time (nanoseconds since 1970) less monotonic time, when the recording began.
    pub wall_offset_ns: u64,
}

impl About {
    pub(crate) fn to_metadata(&self) -> BTreeMap<String, String> {
        [
            ("format", FORMAT.to_owned()),
            ("run", self.run.clone()),
            ("run_id", format!("{:016x}", self.run_id)),
            ("graph", self.graph.clone()),
            ("graph_text", self.graph_text.clone()),
            ("dataset", self.dataset.clone()),
            ("checkpoint", self.checkpoint.clone()),
            ("wall_offset_ns", self.wall_offset_ns.to_string()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// What the metadata says; `None` for another version.
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
        })
    }
}
