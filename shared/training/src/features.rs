//! Backbone features on disk, from which an interrupted training resumes without computing them again.

use crate::TrainingError;
use std::{
    fs::{File, OpenOptions},
    io::{BufReader, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};
use tch::{Device, Kind, Tensor};

/// Name of the file in the run's folder: consecutive rows in half precision.
pub const FEATURES: &str = "features.f16";

/// Rows that are read at a time.
const READ_ROWS: usize = 64;

/// Features file of one run.
pub struct FeatureFile {
    path: PathBuf,
    file: File,
    row: Vec<i64>,
}

impl FeatureFile {
    /// Opens the file in the run's folder `dir`, empty or with the rows of an earlier call. `row` is the shape of one
    /// image's features.
    pub fn open(dir: &Path, row: &[i64]) -> Result<Self, TrainingError> {
        let path = dir.join(FEATURES);
        let file = OpenOptions::new().create(true).truncate(false).read(true).write(true).open(&path);
        let file = file.map_err(|source| TrainingError::File { path: path.clone(), source })?;
        Ok(Self { path, file, row: row.to_vec() })
    }

    /// Reads the file into the first rows of `features`, and returns their number. Only whole batches, of `batches`
    /// rows each, are kept; the rest of the file is truncated.
    pub fn read(&mut self, features: &Tensor, batches: impl Iterator<Item = usize>) -> Result<usize, TrainingError> {
        let there = self.file.metadata().map_err(|e| self.failed(e))?.len() / self.row_bytes() as u64;
        let mut rows = 0;
        for batch in batches {
            if (rows + batch) as u64 > there {
                break;
            }
            rows += batch;
        }
        self.file.seek(SeekFrom::Start(0)).map_err(|e| self.failed(e))?;
        let mut reader = BufReader::new(&self.file);
        let mut bytes = vec![0; READ_ROWS * self.row_bytes()];
        for first in (0..rows).step_by(READ_ROWS) {
            let count = READ_ROWS.min(rows - first);
            let part = &mut bytes[..count * self.row_bytes()];
            reader.read_exact(part).map_err(|e| self.failed(e))?;
            let mut shape = vec![count as i64];
            shape.extend(&self.row);
            let part = Tensor::f_from_data_size(part, &shape, Kind::Half)?;
            features.narrow(0, first as i64, count as i64).copy_(&part);
        }
        let end = (rows * self.row_bytes()) as u64;
        self.file.set_len(end).and_then(|()| self.file.seek(SeekFrom::Start(end))).map_err(|e| self.failed(e))?;
        Ok(rows)
    }

    /// Adds the rows of one batch, in half precision.
    pub fn append(&mut self, rows: &Tensor) -> Result<(), TrainingError> {
        let rows = rows.to_kind(Kind::Half).to_device(Device::Cpu).contiguous();
        let mut bytes = vec![0; rows.numel() * Kind::Half.elt_size_in_bytes()];
        rows.f_copy_data_u8(&mut bytes, rows.numel())?;
        self.file.write_all(&bytes).map_err(|e| self.failed(e))
    }

    fn row_bytes(&self) -> usize {
        self.row.iter().product::<i64>() as usize * Kind::Half.elt_size_in_bytes()
    }

    fn failed(&self, source: std::io::Error) -> TrainingError {
        TrainingError::File { path: self.path.clone(), source }
    }
}

/// Removes the file from the folder of a run.
pub fn remove(dir: &Path) -> Result<(), TrainingError> {
    let path = dir.join(FEATURES);
    match std::fs::remove_file(&path) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => Err(TrainingError::File { path, source }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whole batches are read bit for bit; a partial batch is truncated and can be written again.
    #[test]
    fn whole_batches_come_back() {
        tch::manual_seed(1);
        let dir = tempfile::tempdir().unwrap();
        let half = (Kind::Half, Device::Cpu);
        let all = Tensor::randn([80, 3, 2, 2], (Kind::Float, Device::Cpu)).to_kind(Kind::Half);
        // 70 rows, then five; of the last five a part.
        let batches = || [70_usize, 5, 5].into_iter();
        let mut file = FeatureFile::open(dir.path(), &[3, 2, 2]).unwrap();
        assert_eq!(file.read(&Tensor::zeros([80, 3, 2, 2], half), batches()).unwrap(), 0);
        file.append(&all.narrow(0, 0, 70)).unwrap();
        file.append(&all.narrow(0, 70, 5)).unwrap();
        file.append(&all.narrow(0, 75, 2)).unwrap();
        file.file.write_all(b"torn").unwrap();

        let read = Tensor::zeros([80, 3, 2, 2], half);
        let mut file = FeatureFile::open(dir.path(), &[3, 2, 2]).unwrap();
        assert_eq!(file.read(&read, batches()).unwrap(), 75);
        assert_eq!(read.narrow(0, 0, 75), all.narrow(0, 0, 75));
        file.append(&all.narrow(0, 75, 5)).unwrap();
        let mut file = FeatureFile::open(dir.path(), &[3, 2, 2]).unwrap();
        assert_eq!(file.read(&read, batches()).unwrap(), 80);
        assert_eq!(read, all);
        remove(dir.path()).unwrap();
        remove(dir.path()).unwrap();
        assert!(!dir.path().join(FEATURES).exists());
    }
}
