//! The record of a running launcher. This is the only module that uses bincode: for control, never for data.

use bincode::{Decode, Encode};
use std::path::{Path, PathBuf};

/// Maximum length of a record.
const MAX_BYTES: usize = 64 * 1024;

/// Launcher, graph and folders of a run. Paths are absolute.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct RunRecord {
    /// Process id of the launcher.
    pub pid: u32,
    /// Id of the run.
    pub run_id: u64,
    /// Path of the graph file.
    pub graph: String,
    /// Folder of the dataset.
    pub dataset: String,
    /// Folder of the trained models.
    pub checkpoint: String,
    /// Start time: seconds since 1970.
    pub started_unix_s: u64,
}

impl RunRecord {
    /// Returns the file of a run's record, in the folder of all runs. Its launcher holds a lock on it during the run.
    pub fn path(folder: &Path, run: &str) -> PathBuf {
        folder.join(format!("{run}.run"))
    }

    /// Converts the record to bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, bincode::error::EncodeError> {
        bincode::encode_to_vec(self, bincode::config::standard())
    }

    /// Converts bytes to a record; `None` if they are invalid (empty, cut off, or of another version).
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let config = bincode::config::standard().with_limit::<MAX_BYTES>();
        bincode::decode_from_slice(bytes, config).ok().map(|(record, _)| record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A record is converted to bytes and back unchanged; any prefix of it is refused, and garbage does not panic.
    #[test]
    fn round_trip_and_garbage() {
        let record = RunRecord {
            pid: 7,
            run_id: u64::MAX,
            graph: "configs/x.toml".into(),
            dataset: "data/x".into(),
            checkpoint: "checkpoints/x".into(),
            started_unix_s: 1 << 40,
        };
        let bytes = record.to_bytes().unwrap();
        assert_eq!(RunRecord::from_bytes(&bytes), Some(record));
        for cut in 0..bytes.len() {
            assert_eq!(RunRecord::from_bytes(&bytes[..cut]), None);
        }
        for byte in 0..=255 {
            let _ = RunRecord::from_bytes(&[byte; 40]);
        }
    }
}
