//! Replays the views of a dataset as drives.

use crate::source::Source;
use anyhow::Context;
use carff_base::random::Key;
use carff_checkpoint::CheckpointPlanning;
use carff_config::{GraphConfig, PoseChoice};
use carff_dataset::drives::{Drive, plan_drives};
use carff_dataset::sensor::{SensorNoise, apply_noise_into};
use carff_dataset::{Dataset, Image, PoseRole, PoseSplit};
use carff_messages::{DatasetView, FrameMeta, Observability};
use std::collections::HashMap;
use std::path::Path;

/// Drives with all their images in memory.
#[derive(Debug)]
pub struct DriveSource {
    dataset: Dataset,
    drives: Vec<Drive>,
    images: HashMap<usize, Image>,
    noise: SensorNoise,
    seed: u64,
    frames_per_timestamp: usize,
    repeat: bool,
    /// Number of shown frames, over all repetitions.
    shown: usize,
    current: usize,
}

impl DriveSource {
    /// Plans the drives and loads their images.
    pub fn open(dataset: &Path, checkpoint: &Path, graph: &GraphConfig, count: u32) -> anyhow::Result<Self> {
        let dataset = Dataset::open(dataset)?;
        let split_seed = match graph.camera.split_seed {
            Some(seed) => seed,
            None => {
                CheckpointPlanning::load(checkpoint)
                    .context("unknown training poses: set `camera.split_seed`, or use a checkpoint that records it")?
                    .split_seed
            }
        };
        let role = match graph.camera.poses {
            PoseChoice::Trained => PoseRole::Rest,
            PoseChoice::Unseen => PoseRole::Unseen,
        };
        let views = PoseSplit::for_dataset(&dataset, split_seed).views(role);
        let drives = plan_drives(&dataset, &views, count as usize, graph.run.seed)?;
        if drives.iter().any(|d| d.kind.is_none()) {
            tracing::warn!(
                poses = views.len(),
                "no pose has a right answer (a hidden hazard, or a fully visible place without one): no drive counts"
            );
        }
        let mut images = HashMap::new();
        for &frame in drives.iter().flat_map(|d| &d.frames) {
            if let std::collections::hash_map::Entry::Vacant(entry) = images.entry(frame) {
                entry.insert(dataset.load_image(frame)?);
            }
        }
        tracing::info!(drives = drives.len(), poses = views.len(), images = images.len(), "planned");
        Ok(Self {
            dataset,
            drives,
            images,
            noise: graph.camera.noise,
            seed: graph.run.seed,
            frames_per_timestamp: graph.camera.frames_per_timestamp as usize,
            repeat: graph.camera.repeat,
            shown: 0,
            current: 0,
        })
    }

    /// Returns the drives in order.
    pub fn drives(&self) -> &[Drive] {
        &self.drives
    }
}

impl Source for DriveSource {
    fn max_image_bytes(&self) -> usize {
        self.images.values().map(|i| i.rgb.len()).max().unwrap_or(0)
    }

    fn advance(&mut self) -> anyhow::Result<Option<FrameMeta>> {
        let frames_of = |drive: &Drive| drive.frames.len() * self.frames_per_timestamp;
        let total: usize = self.drives.iter().map(frames_of).sum();
        if total == 0 || (self.shown >= total && !self.repeat) {
            return Ok(None);
        }
        let mut frame_in_drive = self.shown % total;
        let mut drive = 0;
        while frame_in_drive >= frames_of(&self.drives[drive]) {
            frame_in_drive -= frames_of(&self.drives[drive]);
            drive += 1;
        }
        self.shown += 1;
        let planned = &self.drives[drive];
        let timestamp = frame_in_drive / self.frames_per_timestamp;
        self.current = planned.frames[timestamp];
        let frame = &self.dataset.frames()[self.current];
        let dataset_view = DatasetView {
            known: 1,
            view: planned.view as i32,
            branch: planned.branch as i32,
            timestamp: timestamp as i32,
            drive: drive as i32,
            frame_in_drive: frame_in_drive as i32,
            observability: Observability::code_of(frame.observability),
            last_of_timestamp: u32::from((frame_in_drive + 1).is_multiple_of(self.frames_per_timestamp)),
        };
        let start = self.shown as u64 - 1 - frame_in_drive as u64;
        Ok(Some(FrameMeta { take_start: start, ..FrameMeta::of_camera(&frame.camera, dataset_view) }))
    }

    fn write(&mut self, frame_id: u64, pixels: &mut [u8]) -> anyhow::Result<()> {
        let image =
            self.images.get(&self.current).context("no frame is current: `advance` must come before `write`")?;
        let key = Key { seed: self.seed, frame: frame_id, step: 0, sample: 0 };
        Ok(apply_noise_into(&image.rgb, pixels, &self.noise, key)?)
    }
}
