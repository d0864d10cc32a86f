//! Calibration of the occupancy grid in closed-loop drives: which cells of the others' lane were forecast as taken, and
//! which were taken.

use anyhow::Context;
use carff_base::geometry::OrientedBox;
use carff_checkpoint::{OccupancyRates, StepRates};
use carff_messages::{MAX_HORIZON, Occupancy};
use carff_scenes::{ClosedLoop, Episode};
use carff_trials::{RELIABILITY_BINS, Reliability, ReliabilitySums};
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};

/// Number of frames whose grids may still arrive.
const FRAMES: usize = 32;
/// Smallest probability in a logarithm.
const LEAST: f64 = 1e-3;

/// A frame, whose grids arrive later.
#[derive(Clone, Copy, Debug)]
struct Taken {
    frame_id: u64,
    time_s: f64,
}

/// Forecasts of one step of the look-ahead.
#[derive(Clone, Debug)]
struct OfStep {
    sums: ReliabilitySums,
    log_loss: f64,
    taken: u64,
    grids: u64,
    line: LineSums,
}

impl Default for OfStep {
    fn default() -> Self {
        let line = LineSums::default();
        Self { sums: ReliabilitySums::new(RELIABILITY_BINS), log_loss: 0.0, taken: 0, grids: 0, line }
    }
}

/// Sums for the line of least squares from the forecast probability of a cell to the truth.
#[derive(Clone, Copy, Debug, Default)]
struct LineSums {
    count: f64,
    forecast: f64,
    square: f64,
    taken: f64,
    product: f64,
}

impl LineSums {
    fn add(&mut self, forecast: f64, is_taken: bool) {
        let taken = f64::from(u8::from(is_taken));
        self.count += 1.0;
        self.forecast += forecast;
        self.square += forecast * forecast;
        self.taken += taken;
        self.product += forecast * taken;
    }

    /// Returns the rates of the line within 0..=1; `None` if all forecasts are equal.
    fn rates(&self) -> Option<OccupancyRates> {
        let (forecast, taken) = (self.forecast / self.count, self.taken / self.count);
        let variance = self.square / self.count - forecast * forecast;
        let slope = (self.product / self.count - forecast * taken) / variance;
        let at = |p: f64| (taken + slope.max(0.0) * (p - forecast)).clamp(0.0, 1.0);
        (self.count > 0.0 && variance > 1e-9).then(|| OccupancyRates { where_free: at(0.0), where_taken: at(1.0) })
    }
}

impl OfStep {
    fn add(&mut self, probability: f64, is_taken: bool) {
        let right = if is_taken { probability } else { 1.0 - probability };
        self.log_loss -= right.clamp(LEAST, 1.0 - LEAST).ln();
        self.sums.add(probability, is_taken);
        self.taken += u64::from(is_taken);
        self.line.add(probability, is_taken);
    }

    fn figures(&self) -> StepOccupancy {
        let reliability = self.sums.reliability();
        let cells = reliability.trials.max(1) as f64;
        let taken_share = self.taken as f64 / cells;
        let entropy = |p: f64| if p > 0.0 { -p * p.ln() } else { 0.0 };
        StepOccupancy {
            grids: self.grids,
            taken_share,
            log_loss: self.log_loss / cells,
            share_log_loss: entropy(taken_share) + entropy(1.0 - taken_share),
            reliability,
        }
    }
}

/// Agreement of the grids with the truth at one step of the look-ahead, over the cells of the others' lane.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct StepOccupancy {
    /// Number of grids.
    grids: u64,
    /// Share of the cells that were taken.
    taken_share: f64,
    /// Mean negative logarithm of the probability of what happened.
    log_loss: f64,
    /// The log loss of a forecast that only knows the share.
    share_log_loss: f64,
    /// Reliability of the cells' probabilities.
    reliability: Reliability,
}

/// Compares the grids of a drive with the truth.
#[derive(Debug, Default)]
pub(super) struct OccupancyCheck {
    /// Duration of a step, where the scenario has one.
    step_s: Option<f64>,
    frames: VecDeque<Taken>,
    steps: BTreeMap<u32, OfStep>,
}

impl OccupancyCheck {
    /// Creates the comparison for steps of a duration; without one nothing is compared.
    pub(super) fn new(step_s: Option<f64>) -> Self {
        Self { step_s, ..Self::default() }
    }

    /// Begins an episode.
    pub(super) fn begin(&mut self) {
        self.frames.clear();
    }

    /// Notes a published frame.
    pub(super) fn publish(&mut self, frame_id: u64, time_s: f64) {
        self.frames.push_back(Taken { frame_id, time_s });
        if self.frames.len() > FRAMES {
            self.frames.pop_front();
        }
    }

    /// Takes a grid, if it is about one of the noted frames.
    pub(super) fn take(&mut self, drives: &ClosedLoop, episode: &Episode, grid: &Occupancy) {
        let frame = self.frames.iter().find(|frame| frame.frame_id == grid.header.frame_id);
        let (Some(frame), Some(step_s)) = (frame, self.step_s) else { return };
        let others = drives.actor_boxes(episode, frame.time_s + f64::from(grid.header.step) * step_s);
        let of_step = self.steps.entry(grid.header.step).or_default();
        of_step.grids += 1;
        for ((row, column), &probability) in grid.grid().indexed_iter() {
            let middle_m = grid.middle_m([row, column]);
            if contains(drives.lane_boxes(), middle_m) {
                of_step.add(f64::from(probability), contains(&others, middle_m));
            }
        }
    }

    /// Returns the rates of each step that make the grids of these drives calibrated, where the grids had the rates `old`.
    /// Steps beyond the look-ahead have those of the last one.
    ///
    /// # Errors
    ///
    /// No grid has been compared, or all of them are equal.
    pub(super) fn rates(&self, old: Option<StepRates>) -> anyhow::Result<StepRates> {
        let mut last = None;
        let mut all = old.unwrap_or([OccupancyRates::EXACT; MAX_HORIZON as usize]);
        for (step, rates) in (1_u32..).zip(&mut all) {
            last = self.steps.get(&step).and_then(|of_step| of_step.line.rates()).or(last);
            let line = last.context("no grid of these drives has probabilities that differ: drive more episodes")?;
            *rates = OccupancyRates { where_free: line.of(rates.where_free), where_taken: line.of(rates.where_taken) };
        }
        Ok(all)
    }

    /// Returns the figures of each step.
    pub(super) fn figures(&self) -> BTreeMap<u32, StepOccupancy> {
        self.steps.iter().map(|(step, of_step)| (*step, of_step.figures())).collect()
    }
}

/// Reports whether a point of the ground is in one of the boxes.
fn contains(boxes: &[OrientedBox], [x, y]: [f64; 2]) -> bool {
    boxes.iter().any(|of| of.contains([x, y, of.center[2]]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Header;
    use carff_scenes::Scenario;
    use std::path::Path;

    /// A grid that knows where the others will be a step later has no error; one that takes the lane for free has the
    /// error of the taken share. Grids of unknown frames, and cells off the lane, do not count.
    #[test]
    fn grids_are_compared_with_the_truth() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/scenarios/approaching-intersection.toml");
        let drives = ClosedLoop::new(Scenario::load(&file).unwrap(), None).unwrap();
        let (episode, step_s) = (drives.episode(1, 5, Some(2)), 0.6);
        let grid_at = |time_s: f64| {
            let mut grid = Occupancy::empty(Header::of_frame(7, 1, 1).at_step(2));
            (grid.columns, grid.rows, grid.cell_m, grid.low_corner_m) = (32, 32, 1.25, [-20.0, -20.0]);
            let others = drives.actor_boxes(&episode, time_s);
            let cells = grid.grid();
            let taken: Vec<bool> = cells
                .indexed_iter()
                .map(|((row, column), _)| contains(&others, grid.middle_m([row, column])))
                .collect();
            for (to, taken) in grid.probability.iter_mut().zip(taken) {
                *to = f32::from(u8::from(taken));
            }
            grid
        };
        // A time at which somebody is on the grid.
        let on_grid = |time_s: &f64| grid_at(time_s + 2.0 * step_s).cells().contains(&1.0);
        let time_s = (0..200).map(|i| f64::from(i) * 0.1).find(on_grid).unwrap();
        let mut check = OccupancyCheck::new(Some(step_s));
        check.publish(7, time_s);
        check.take(&drives, &episode, &grid_at(time_s + 2.0 * step_s));
        let known = check.figures()[&2].clone();
        assert_eq!(known.reliability.expected_calibration_error, 0.0);
        let (cells, share) = (known.reliability.trials, known.taken_share);
        assert!(cells > 20 && cells < 400 && share > 0.0 && share < 0.5, "{known:?}");

        let mut free = OccupancyCheck::new(Some(step_s));
        free.publish(7, time_s);
        let nothing = Occupancy { probability: Occupancy::empty(Header::default()).probability, ..grid_at(0.0) };
        free.take(&drives, &episode, &nothing);
        free.take(&drives, &episode, &Occupancy { header: Header { frame_id: 8, ..nothing.header }, ..nothing });
        let free = free.figures()[&2].clone();
        assert_eq!((free.grids, free.taken_share), (1, share));
        let error = free.reliability.expected_calibration_error;
        assert!((error - share).abs() < 1e-12 && free.log_loss > free.share_log_loss, "{free:?}");
        assert!(OccupancyCheck::new(None).figures().is_empty());
    }

    /// Forecasts of 0.2 and 0.8 that come true in 20 and 50 of 100 cells give the line through both points. With these
    /// rates the grid's probabilities are the shares. Steps without grids take those of the step before; equal forecasts
    /// are refused.
    #[test]
    fn rates_make_grids_calibrated() {
        let mut check = OccupancyCheck::new(Some(0.6));
        assert!(check.rates(None).is_err());
        let of_step = check.steps.entry(1).or_default();
        for cell in 0..100 {
            of_step.add(0.2, cell < 20);
        }
        assert!(check.rates(None).is_err());
        let of_step = check.steps.entry(1).or_default();
        for cell in 0..100 {
            of_step.add(0.8, cell < 50);
        }
        let rates = check.rates(None).unwrap();
        let near = |rates: OccupancyRates, free: f64, taken: f64| {
            assert!((rates.where_free - free).abs() < 1e-9 && (rates.where_taken - taken).abs() < 1e-9, "{rates:?}");
        };
        near(rates[0], 0.1, 0.6);
        assert_eq!(rates[7], rates[0]);
        // Grids with these rates have the shares as probabilities, so they keep their rates.
        let mut later = OccupancyCheck::new(Some(0.6));
        let of_step = later.steps.entry(1).or_default();
        for cell in 0..100 {
            of_step.add(rates[0].of(0.2), cell < 20);
            of_step.add(rates[0].of(0.8), cell < 50);
        }
        near(later.rates(Some(rates)).unwrap()[0], 0.1, 0.6);
    }
}
