//! One closed-loop drive: the ego moves by target speeds, everyone else by themselves; collisions are judged by boxes.

use super::results::{EpisodeResult, Outcome};
use super::vehicle::Vehicle;
use carff_scenes::{ClosedLoop, Episode};

/// Longest time over which accelerations are constant, seconds.
const SUBSTEP_S: f64 = 0.02;
/// Speed below which the ego stands, m/s.
const STANDS_MPS: f64 = 0.05;
/// Space that the planner that knows the truth keeps to the place where others drive, and to each of them, metres.
const ORACLE_SPACE_M: f64 = 0.6;
const ORACLE_GAP_M: f64 = 0.6;

/// A drive in progress.
#[derive(Clone)]
pub(super) struct Drive<'a> {
    drives: &'a ClosedLoop,
    pub(super) episode: Episode,
    number: u64,
    pub(super) vehicle: Vehicle,
    pub(super) time_s: f64,
    halted_s: f64,
    least_gap_m: f64,
    frames: u64,
    pub(super) missed: u64,
}

impl<'a> Drive<'a> {
    /// Begins a drive.
    pub(super) fn begin(drives: &'a ClosedLoop, number: u64, episode: Episode) -> Self {
        let least_gap_m = drives.gap_m(&episode, 0.0, 0.0);
        let vehicle = Vehicle::at_start(drives.config().speed_mps);
        Self { drives, episode, number, vehicle, time_s: 0.0, halted_s: 0.0, least_gap_m, frames: 0, missed: 0 }
    }

    /// Way until the ego would be in the way of others, metres; negative within and behind that place.
    pub(super) fn to_conflict_m(&self) -> f64 {
        self.drives.conflict_m()[0] - self.vehicle.at_m
    }

    /// Way until the ego has left that place, metres.
    pub(super) fn through_conflict_m(&self) -> f64 {
        self.drives.conflict_m()[1] - self.vehicle.at_m
    }

    /// Moves everyone for a frame's time, the ego towards a target speed. Returns the result at the drive's end.
    pub(super) fn step(&mut self, target_mps: f64, frame_s: f64) -> Option<EpisodeResult> {
        self.frames += 1;
        let substeps = (frame_s / SUBSTEP_S - 1e-9).ceil().max(1.0);
        for _ in 0..substeps as u64 {
            if let Some(outcome) = self.substep(target_mps, frame_s / substeps) {
                return Some(self.result(outcome));
            }
        }
        None
    }

    fn substep(&mut self, target_mps: f64, time_s: f64) -> Option<Outcome> {
        self.vehicle.substep(target_mps.clamp(0.0, self.drives.config().speed_mps), time_s);
        self.time_s += time_s;
        if self.vehicle.speed_mps < STANDS_MPS {
            self.halted_s += time_s;
        }
        self.least_gap_m = self.least_gap_m.min(self.drives.gap_m(&self.episode, self.vehicle.at_m, self.time_s));
        if self.least_gap_m <= 0.0 {
            Some(Outcome::Collided)
        } else if self.vehicle.at_m >= self.drives.length_m() {
            Some(Outcome::Arrived)
        } else if self.time_s >= self.drives.config().limit_s {
            Some(Outcome::Stuck)
        } else {
            None
        }
    }

    /// The target speed of a planner that knows the truth: it drives on where it then keeps clear of everyone, else it
    /// stops ahead of the place where others drive.
    pub(super) fn oracle_mps(&self) -> f64 {
        let (fast_mps, to_conflict_m) = (self.drives.config().speed_mps, self.to_conflict_m());
        let mut ahead = Self { least_gap_m: f64::INFINITY, ..self.clone() };
        while ahead.substep(fast_mps, SUBSTEP_S).is_none() {}
        let passes = ahead.least_gap_m >= ORACLE_GAP_M;
        let stop_mps = carff_decision::stopping_mps(to_conflict_m - ORACLE_SPACE_M);
        if passes || to_conflict_m <= 0.0 { fast_mps } else { fast_mps.min(stop_mps) }
    }

    fn result(&self, outcome: Outcome) -> EpisodeResult {
        EpisodeResult {
            episode: self.number,
            outcome,
            actors: self.episode.actor_count(),
            time_s: self.time_s,
            halted_s: self.halted_s,
            least_gap_m: self.least_gap_m.is_finite().then_some(self.least_gap_m),
            frames: self.frames,
            missed_frames: self.missed,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_scenes::Scenario;
    use std::path::Path;

    /// Time passes as the frames show it, at any frame rate: a vehicle at its speed limit is as far after a second.
    #[test]
    fn time_passes_at_any_frame_rate() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/scenarios/approaching-intersection.toml");
        let drives = ClosedLoop::new(Scenario::load(&file).unwrap(), None).unwrap();
        let speed_mps = drives.config().speed_mps;
        for frame_rate_hz in [1.0, 7.0, 10.0, 30.0, 60.0, 100.0] {
            let mut drive = Drive::begin(&drives, 0, drives.episode(0, 1, Some(0)));
            for _ in 0..frame_rate_hz as u32 {
                assert!(drive.step(speed_mps, 1.0 / frame_rate_hz).is_none());
            }
            assert!((drive.time_s - 1.0).abs() < 1e-9, "{frame_rate_hz}: {}", drive.time_s);
            assert!((drive.vehicle.at_m - speed_mps).abs() < 1e-6, "{frame_rate_hz}: {}", drive.vehicle.at_m);
        }
    }

    /// The planner that knows the truth never collides, and drives on at once where nobody comes.
    #[test]
    fn the_oracle_does_not_collide() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/scenarios/approaching-intersection.toml");
        let drives = ClosedLoop::new(Scenario::load(&file).unwrap(), None).unwrap();
        for number in 0..40 {
            let mut drive = Drive::begin(&drives, number, drives.episode(number, 9, None));
            let result = loop {
                if let Some(result) = drive.step(drive.oracle_mps(), 0.1) {
                    break result;
                }
            };
            assert_eq!(result.outcome, Outcome::Arrived, "{number}");
            assert!(result.actors > 0 || result.time_s < 3.8, "{number}: {}", result.time_s);
        }
    }
}
