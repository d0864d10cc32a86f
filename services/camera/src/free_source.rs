//! Renders the images of a moving ego during the run.

use crate::source::Source;
use anyhow::Context;
use carff_base::random::Key;
use carff_config::GraphConfig;
use carff_dataset::sensor::{SensorNoise, apply_noise_into};
use carff_messages::{DatasetView, FrameMeta, Observability, Stage};
use carff_scenes::{FreeDrive, FreeFrame, Scenario};

/// Free drives through a scenario; each is planned when the previous one has ended.
#[derive(Debug)]
pub struct FreeDriveSource {
    scenario: Scenario,
    noise: SensorNoise,
    seed: u64,
    frames_per_timestamp: usize,
    /// Number of drives; `None`: unlimited.
    drives: Option<u64>,
    /// Number of the next drive, and the current drive.
    next: u64,
    /// Frames so far.
    shown: u64,
    drive: Option<FreeDrive>,
    frame_in_drive: usize,
    current: Option<FreeFrame>,
    /// One thread: the other cores are for the stages that wait for the image.
    pool: rayon::ThreadPool,
}

impl FreeDriveSource {
    /// Loads the scenario and plans one drive of each kind, so that a scenario without drives is an error here.
    pub fn open(graph: &GraphConfig, drives: u32) -> anyhow::Result<Self> {
        let path = graph.scenario_path().context("`run.scenario` must name the scenario to render")?;
        let scenario = Scenario::load(&path)?;
        let frames_per_timestamp = graph.camera.frames_per_timestamp as usize;
        for number in 0..2 {
            scenario.free_drive(number, frames_per_timestamp, graph.run.seed)?;
        }
        Ok(Self {
            scenario,
            noise: graph.camera.noise,
            seed: graph.run.seed,
            frames_per_timestamp,
            drives: (!graph.camera.repeat).then_some(u64::from(drives)),
            next: 0,
            shown: 0,
            drive: None,
            frame_in_drive: 0,
            current: None,
            pool: rayon::ThreadPoolBuilder::new().num_threads(graph.stage(Stage::Camera).threads as usize).build()?,
        })
    }

    /// Renders the next frame, of the next drive if the current one has ended.
    fn render(&mut self) -> anyhow::Result<Option<FreeFrame>> {
        self.frame_in_drive += 1;
        if self.drive.as_ref().is_none_or(|drive| self.frame_in_drive >= drive.frame_count()) {
            if self.drives.is_some_and(|drives| self.next >= drives) {
                return Ok(None);
            }
            let (scenario, number, frames, seed) = (&self.scenario, self.next, self.frames_per_timestamp, self.seed);
            self.drive = Some(self.pool.install(|| scenario.free_drive(number, frames, seed))?);
            self.next += 1;
            self.frame_in_drive = 0;
        }
        let (scenario, frame) = (&self.scenario, self.frame_in_drive);
        let drive = self.drive.as_ref().context("no drive is planned: give the scenario room for a drive")?;
        Ok(Some(self.pool.install(|| scenario.free_frame(drive, frame))?))
    }
}

impl Source for FreeDriveSource {
    fn max_image_bytes(&self) -> usize {
        self.scenario.cameras().first().map_or(0, |c| (c.camera.width_px * c.camera.height_px) as usize * 3)
    }

    fn advance(&mut self) -> anyhow::Result<Option<FrameMeta>> {
        self.current = self.render()?;
        let Some(frame) = &self.current else { return Ok(None) };
        let dataset_view = DatasetView {
            known: 1,
            view: -1,
            branch: frame.branch as i32,
            timestamp: frame.timestamp as i32,
            drive: self.next as i32 - 1,
            frame_in_drive: self.frame_in_drive as i32,
            observability: Observability::code_of(frame.observability),
            last_of_timestamp: u32::from(frame.last_of_timestamp),
        };
        self.shown += 1;
        let take_start = self.shown - 1 - self.frame_in_drive as u64;
        Ok(Some(FrameMeta { take_start, ..FrameMeta::of_camera(&frame.camera, dataset_view) }))
    }

    fn write(&mut self, frame_id: u64, image: &mut [u8]) -> anyhow::Result<()> {
        let frame = self.current.as_ref().context("no frame is current: `advance` must come before `write`")?;
        let key = Key { seed: self.seed, frame: frame_id, step: 0, sample: 0 };
        Ok(apply_noise_into(&frame.image.rgb, image, &self.noise, key)?)
    }
}
