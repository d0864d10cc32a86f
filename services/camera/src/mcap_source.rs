//! Images of an MCAP recording of another tool.

use crate::recorded::Recorded;
use carff_config::GraphConfig;
use carff_dataset::{CameraCalibration, RawImage};
use carff_recording::ImageReader;
use std::path::Path;

/// Images of one channel.
#[derive(Debug)]
pub struct McapSource {
    reader: ImageReader,
}

impl McapSource {
    /// Opens the recording and finds the channel of the images.
    pub fn open(path: &Path, graph: &GraphConfig) -> anyhow::Result<Self> {
        let reader = ImageReader::open(path, graph.camera.topic.as_deref())?;
        tracing::info!(topic = reader.topic(), "images of {}", path.display());
        Ok(Self { reader })
    }
}

impl Recorded for McapSource {
    fn calibration(&mut self) -> anyhow::Result<Option<CameraCalibration>> {
        Ok(self.reader.calibration()?)
    }

    fn next(&mut self) -> anyhow::Result<Option<u64>> {
        Ok(self.reader.next()?)
    }

    fn with_image(&mut self, each: &mut dyn FnMut(&RawImage<'_>) -> anyhow::Result<()>) -> anyhow::Result<()> {
        self.reader.with_image(each)?
    }

    fn rewind(&mut self) -> anyhow::Result<()> {
        Ok(self.reader.rewind()?)
    }
}
