//! Publishes recorded images at their recorded or a given rate.

use anyhow::Context;
use carff_config::FramePace;
use carff_dataset::{CameraCalibration, RawImage};
use carff_runtime::{FrameOutput, StageContext};
use carff_transport::{Woken, monotonic_now_ns};

/// Longest gap between two images that is waited for, nanoseconds: a clock that was set forward while recording does not
/// stop the camera.
const MAX_GAP_NS: u64 = 5_000_000_000;

/// Recorded images, one after the other.
pub trait Recorded {
    /// Returns the calibration that was recorded with the images.
    fn calibration(&mut self) -> anyhow::Result<Option<CameraCalibration>>;

    /// Advances to the next image. Returns the time at which it was recorded, nanoseconds; `None` at the end. After an
    /// error nothing more can be read.
    fn next(&mut self) -> anyhow::Result<Option<u64>>;

    /// Calls a function with the current image. An error concerns only this image.
    fn with_image(&mut self, each: &mut dyn FnMut(&RawImage<'_>) -> anyhow::Result<()>) -> anyhow::Result<()>;

    /// Starts again at the first image.
    fn rewind(&mut self) -> anyhow::Result<()>;
}

/// The schedule of the frames.
#[allow(clippy::struct_field_names, reason = "the unit is part of each name")]
struct Schedule {
    /// Period of a given rate; `None` for the recorded one.
    period_ns: Option<u64>,
    recorded_ns: Option<u64>,
    /// The last gap, which also separates the last image from the first one of a repetition.
    gap_ns: u64,
    due_ns: u64,
}

impl Schedule {
    /// Returns the time of the frame that was recorded at a time.
    fn due(&mut self, recorded_ns: u64, now_ns: u64) -> u64 {
        if let Some(last_ns) = self.recorded_ns.replace(recorded_ns) {
            // A clock that was set back while recording makes no gap.
            let recorded_ns = recorded_ns.saturating_sub(last_ns).min(MAX_GAP_NS);
            self.gap_ns = self.period_ns.unwrap_or(recorded_ns);
        }
        // A late frame delays later ones; the camera does not catch up with a burst.
        self.due_ns = (self.due_ns + self.gap_ns).max(now_ns);
        self.due_ns
    }
}

/// Publishes all images; the first one is checked before the stage is ready.
pub fn run(stage: &mut StageContext, source: &mut dyn Recorded) -> anyhow::Result<()> {
    let calibration = if stage.graph.camera.calibration.is_some() { None } else { source.calibration()? };
    let mut output = FrameOutput::open(stage, calibration)?;
    source.next()?.context("the recording contains no image: set another `camera.file` or `camera.topic`")?;
    source.with_image(&mut |raw| output.check(raw))?;
    source.rewind()?;
    // A camera that is restarted during a run continues after the last frame of its predecessor.
    for _ in 0..output.next_frame() {
        if source.next()?.is_none() {
            source.rewind()?;
        }
    }
    stage.ready();

    let period_ns =
        (stage.graph.camera.pace == FramePace::FrameRate).then(|| (1e9 / stage.graph.run.frame_rate_hz) as u64);
    let mut schedule = Schedule { period_ns, recorded_ns: None, gap_ns: 0, due_ns: monotonic_now_ns() };
    let mut is_empty = false;
    while !output.is_complete() {
        let recorded_ns = match source.next() {
            Ok(Some(recorded_ns)) => recorded_ns,
            end => {
                if let Err(error) = end {
                    stage.error(&error.context("the rest of the recording is left out"));
                }
                // A recording whose first image is damaged by now would repeat indefinitely.
                if !stage.graph.camera.repeat || std::mem::replace(&mut is_empty, true) {
                    break;
                }
                source.rewind()?;
                output.cut();
                schedule.recorded_ns = None;
                continue;
            }
        };
        is_empty = false;
        let due_ns = schedule.due(recorded_ns, monotonic_now_ns());
        if stage.wait_until(&[], due_ns)? == Woken::Stopped {
            return Ok(());
        }
        let captured_ns = monotonic_now_ns();
        let mut sent = Ok(());
        let shown = source.with_image(&mut |raw| {
            sent = output.publish(stage, raw, captured_ns);
            Ok(())
        });
        sent?;
        if let Err(error) = shown {
            stage.refuse(&error);
        }
    }
    // The last frames are still in progress.
    stage.wait_until(&[], monotonic_now_ns() + stage.graph.camera.linger_ms * 1_000_000)?;
    tracing::info!(frames = output.next_frame(), "done");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Frames follow the recorded times; a clock that jumps back makes no gap, one that jumps forward a bounded one.
    #[test]
    fn frames_follow_the_recorded_times() {
        let mut schedule = Schedule { period_ns: None, recorded_ns: None, gap_ns: 0, due_ns: 1000 * MS };
        let recorded = [50_000, 50_100, 50_250, 10, 110, 9_000_000];
        let due: Vec<u64> = recorded.map(|ms: u64| schedule.due(ms * MS, 0) / MS).to_vec();
        assert_eq!(due, [1000, 1100, 1250, 1250, 1350, 6350]);
        // A late frame delays the next ones.
        assert_eq!(schedule.due(9_000_100 * MS, 8000 * MS), 8000 * MS);
        assert_eq!(schedule.due(9_000_200 * MS, 8001 * MS), 8100 * MS);
        // A repetition begins after the same gap as before.
        schedule.recorded_ns = None;
        assert_eq!(schedule.due(50_000 * MS, 8101 * MS), 8200 * MS);
    }

    /// A given rate does not depend on the recorded times.
    #[test]
    fn frames_follow_a_given_rate() {
        let mut schedule = Schedule { period_ns: Some(20 * MS), recorded_ns: None, gap_ns: 0, due_ns: 0 };
        let due: Vec<u64> = [7, 900, 3].map(|ms: u64| schedule.due(ms * MS, 0) / MS).to_vec();
        assert_eq!(due, [0, 20, 40]);
    }
}
