//! What a running launcher writes down about itself. The only place that uses bincode: control plane, never data path.

use bincode::{Decode, Encode};
use std::path::{Path, PathBuf};

/// A record is longer than this only by mistake.
const MAX_BYTES: usize = 64 * 1024;

/// Who runs a run, on what. Paths are absolute.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct RunRecord {
    /// The launcher's process id.
    pub pid: u32,
    /// The run's id.
    pub run_id: u64,
    /// The graph file.
    pub graph: String,
    /// Folder of the dataset.
    pub dataset: String,
    /// Folder of the trained models.
    pub checkpoint: String,
    /// When it was started: seconds since 1970.
    pub started_unix_s: u64,
}

impl RunRecord {
    /// The file of a run's record, in the folder of all runs. Its launcher holds a lock on it while the run runs.
    pub fn path(folder: &Path, run: &str) -> PathBuf {
        folder.join(format!("{run}.run"))
    }

    /// As bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, bincode::error::EncodeError> {
        bincode::encode_to_vec(self, bincode::config::standard())
    }

    /// From bytes; `None` when they are no record (empty, cut off, or of another version).
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let config = bincode::config::standard().with_limit::<MAX_BYTES>();
        bincode::decode_from_slice(bytes, config).ok().map(|(record, _)| record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A record survives the way there and back; any prefix of it is refused, and garbage does not panic.
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
