//! The world of closed-loop drives: it publishes the ego's camera and motion, and moves the ego by the actions.

use super::episode::Drive;
use super::occupancy::OccupancyCheck;
use super::results::EpisodeResult;
use super::truth::{MAX_ACTORS, TRUTH, WorldTruth};
use anyhow::Context;
use carff::terminal::Terminal;
use carff_base::random::Key;
use carff_dataset::sensor::{SensorNoise, apply_noise_into};
use carff_messages::{Action, DatasetView, EgoMotion, FrameMeta, Header, ImageMeta, Occupancy, Reason};
use carff_scenes::{ClosedLoop, Episode};
use carff_transport::{ImagePayload, Node, Publisher, Receiver, Run, Stop, Waiter, Woken, monotonic_now_ns, topics};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Longest wait for a frame's decision in lock-step, nanoseconds. The ego is then to halt.
const PATIENCE_NS: u64 = 5_000_000_000;
/// Frame numbers of an episode: its random draws then do not depend on the episodes before it.
const FRAMES_PER_EPISODE: u64 = 100_000;
/// Longest wait for the grids of a decided frame in lock-step, nanoseconds.
const GRID_PATIENCE_NS: u64 = 1_000_000_000;
/// Wait after the last frame, nanoseconds: its decision is still recorded.
const LINGER_NS: u64 = 200_000_000;

/// Episodes to drive.
pub(super) struct World {
    pub(super) drives: ClosedLoop,
    pub(super) episodes: std::ops::Range<u64>,
    pub(super) seed: u64,
    pub(super) actors: Option<u32>,
    pub(super) frame_rate_hz: f64,
    pub(super) is_real_time: bool,
    /// Steps of the look-ahead.
    pub(super) horizon: u32,
    /// True where a planner that knows the truth drives.
    pub(super) is_oracle: bool,
    pub(super) noise: SensorNoise,
    pub(super) results: Arc<Mutex<Vec<EpisodeResult>>>,
    pub(super) occupancy: Arc<Mutex<OccupancyCheck>>,
    pub(super) terminal: Arc<Terminal>,
}

/// The topics of the world.
struct Topics {
    frames: Publisher<ImagePayload<FrameMeta>>,
    motions: Publisher<EgoMotion>,
    truths: Publisher<WorldTruth>,
    actions: Receiver<Action>,
    grids: Receiver<Occupancy>,
    /// The newest action.
    action: Option<Action>,
    waiter: Waiter,
}

impl World {
    /// Drives all episodes, or until it is stopped.
    pub(super) fn run(self, run: &Run, stop: &Stop) -> anyhow::Result<()> {
        let node = Node::open(run, "world")?;
        let camera =
            self.drives.scenario().cameras().first().context("the scenario has no camera: add one to its file")?.camera;
        let bytes = (camera.width_px * camera.height_px) as usize * 3;
        let mut topics = Topics {
            frames: node.image_publisher(&topics::FRAME, bytes)?,
            motions: node.publisher(&topics::EGO_MOTION)?,
            truths: node.publisher(&TRUTH)?,
            actions: node.receiver(&topics::ACTION)?,
            grids: node.receiver(&topics::OCCUPANCY)?,
            action: None,
            waiter: Waiter::new(stop.clone()),
        };
        let mut collided = 0;
        for number in self.episodes.clone() {
            let episode = self.drives.episode(number, self.seed, self.actors);
            let Some(result) = self.drive(&mut topics, number, episode)? else { return Ok(()) };
            collided += u64::from(result.outcome == super::results::Outcome::Collided);
            let done = number + 1 - self.episodes.start;
            let all = self.episodes.end - self.episodes.start;
            self.terminal.status(format!("episode {done} of {all}: {collided} collisions"));
            self.results.lock().unwrap_or_else(PoisonError::into_inner).push(result);
        }
        topics.waiter.wait_until(&[], monotonic_now_ns() + LINGER_NS)?;
        Ok(())
    }

    /// Drives one episode; `None` if it is stopped.
    fn drive(&self, topics: &mut Topics, number: u64, episode: Episode) -> anyhow::Result<Option<EpisodeResult>> {
        let (take_start, frame_s) = (number * FRAMES_PER_EPISODE, 1.0 / self.frame_rate_hz);
        let mut frame_id = take_start;
        let mut drive = Drive::begin(&self.drives, number, episode);
        topics.action = None;
        self.check().begin();
        let mut next_ns = monotonic_now_ns();
        loop {
            let header = Header::of_frame(frame_id, monotonic_now_ns(), self.seed);
            self.publish(topics, &drive, header, (number, take_start))?;
            self.check().publish(frame_id, drive.time_s);
            // A late frame delays later ones, as with a camera.
            next_ns = (next_ns + (frame_s * 1e9) as u64).max(header.capture_time_ns);
            let action = if self.is_real_time {
                topics.newest_at(next_ns)?
            } else {
                topics.decision_on(frame_id, monotonic_now_ns() + PATIENCE_NS)?
            };
            let Ok(action) = action else { return Ok(None) };
            self.take_grids(topics, &drive.episode, action.filter(|_| !self.is_real_time))?;
            drive.missed += u64::from(action.is_none());
            let told_mps = action.map_or(0.0, |action| f64::from(action.target_speed_mps));
            let target_mps = if self.is_oracle { drive.oracle_mps() } else { told_mps };
            frame_id += 1;
            if let Some(result) = drive.step(target_mps, frame_s) {
                return Ok(Some(result));
            }
        }
    }

    fn check(&self) -> MutexGuard<'_, OccupancyCheck> {
        self.occupancy.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the grids that have arrived. In lock-step it waits for those of the frame of `decision`, so that the figures
    /// do not depend on the machine's speed.
    fn take_grids(&self, topics: &mut Topics, episode: &Episode, decision: Option<Action>) -> anyhow::Result<()> {
        let believed = decision.filter(|action| action.reason() == Ok(Reason::Belief));
        let until_ns = monotonic_now_ns() + GRID_PATIENCE_NS;
        let mut is_waiting = believed.is_some();
        loop {
            while let Some(grid) = topics.grids.next()? {
                let is_last =
                    |action: Action| (action.based_on_frame, self.horizon) == (grid.header.frame_id, grid.header.step);
                is_waiting &= !believed.is_some_and(is_last);
                self.check().take(&self.drives, episode, &grid);
            }
            let is_over = monotonic_now_ns() >= until_ns;
            if !is_waiting || is_over || topics.waiter.wait_until(&[&topics.grids], until_ns)? == Woken::Stopped {
                return Ok(());
            }
        }
    }

    fn publish(
        &self,
        topics: &mut Topics,
        drive: &Drive,
        header: Header,
        (number, take_start): (u64, u64),
    ) -> anyhow::Result<()> {
        let (at_m, time_s, speed_mps) = (drive.vehicle.at_m, drive.time_s, drive.vehicle.speed_mps);
        let [x, y, heading_rad] = self.drives.ego_pose(at_m);
        topics.motions.send(EgoMotion {
            header,
            speed_mps,
            to_conflict_m: drive.to_conflict_m(),
            through_conflict_m: drive.through_conflict_m(),
            heading_rad,
            crossing_m: self.drives.crossing_m(),
            along_conflict_m: self.drives.along_conflict_m(),
        })?;
        let mut truth = WorldTruth {
            header,
            episode: number,
            time_s,
            ego: [x, y, heading_rad, speed_mps],
            ..WorldTruth::default()
        };
        let boxes = self.drives.actor_boxes(&drive.episode, time_s);
        truth.actor_count = boxes.len().min(MAX_ACTORS) as u64;
        for (to, from) in truth.actors.iter_mut().zip(&boxes) {
            *to = [from.center[0], from.center[1], from.yaw];
        }
        topics.truths.send(truth)?;
        let camera = self.drives.camera(&drive.episode, at_m);
        let image = self.drives.image(&drive.episode, at_m, time_s);
        let meta = FrameMeta { header, take_start, ..FrameMeta::of_camera(&camera, DatasetView::UNKNOWN) };
        let mut loan = topics.frames.loan(meta.image_bytes())?;
        let key = Key { seed: self.seed, frame: header.frame_id, step: 0, sample: 0 };
        apply_noise_into(&image.rgb, loan.bytes_mut(), &self.noise, key)?;
        Ok(topics.frames.send_image(loan, meta)?)
    }
}

/// The world was stopped.
struct Stopped;

/// An action to move by, if there is one.
type Moved = Result<Option<Action>, Stopped>;

impl Topics {
    /// Waits for the decision on a frame.
    fn decision_on(&mut self, frame_id: u64, until_ns: u64) -> anyhow::Result<Moved> {
        loop {
            while let Some(action) = self.actions.next()? {
                if action.is_decision() && action.based_on_frame == frame_id {
                    return Ok(Ok(Some(*action)));
                }
            }
            if self.waiter.wait_until(&[&self.actions], until_ns)? == Woken::Stopped {
                return Ok(Err(Stopped));
            }
            if monotonic_now_ns() >= until_ns {
                return Ok(Ok(None));
            }
        }
    }

    /// Waits until a time, and returns the newest action if it is still valid then.
    fn newest_at(&mut self, until_ns: u64) -> anyhow::Result<Moved> {
        if self.waiter.wait_until(&[], until_ns)? == Woken::Stopped {
            return Ok(Err(Stopped));
        }
        while let Some(action) = self.actions.next()? {
            self.action = Some(*action);
        }
        Ok(Ok(self.action.filter(|action| action.valid_until_ns > monotonic_now_ns())))
    }
}
