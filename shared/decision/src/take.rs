//! The memory of a take: its steps in time, and its cuts.

use crate::{Memory, Mixture, RememberedStates};
use carff_messages::Posterior;

/// Length of a time step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepLength {
    /// In frames, for a camera that shows a dataset or a scenario.
    Frames(u64),
    /// In capture time, nanoseconds.
    TimeNs(u64),
}

/// A frame of a take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TakeFrame {
    /// Number of the take's first frame.
    pub take_start: u64,
    /// Number of the frame.
    pub frame: u64,
    /// Capture time, nanoseconds.
    pub capture_time_ns: u64,
}

impl From<&Posterior> for TakeFrame {
    fn from(posterior: &Posterior) -> Self {
        Self {
            take_start: posterior.take_start,
            frame: posterior.header.frame_id,
            capture_time_ns: posterior.header.capture_time_ns,
        }
    }
}

/// The belief over the frames of a take. It starts anew with each take, and after a gap of more than a time step.
///
/// ```
/// use carff_base::geometry::OrientedBox;
/// use carff_decision::{Memory, MemorySettings, Mixture, Place, ProbeLayout, StepLength, TakeFrame, TakeMemory};
/// use carff_messages::Gaussian;
/// let [left, right] = [-3.0, 3.0].map(|x| Gaussian { mean: [x; 8], log_variance: [-4.0; 8] });
/// // Each state stays.
/// let stays = |state: &Gaussian| Mixture { weights: vec![1.0], components: vec![*state] };
/// let settings = MemorySettings { repeated_share: 0.0, distrust: 0.01, place_strength: 5.0 };
/// let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
/// let place = Place { name: "actor".into(), oriented_box, occupied_in: vec![false, true] };
/// let layout = ProbeLayout::new(vec![place], vec![false, true])?;
/// let memory = Memory::new(&layout, vec![left, right], stays, settings);
/// let mut memory = TakeMemory::new(memory, StepLength::Frames(6));
/// let image = |weight: f32| Mixture { weights: vec![weight, 1.0 - weight], components: vec![left, right] };
/// let frame = |frame| TakeFrame { take_start: 0, frame, capture_time_ns: 100 * frame };
/// memory.see(frame(0), &image(0.999));
/// // The next image shows nothing: the belief is still that of the first one.
/// let now = memory.see(frame(1), &image(0.5));
/// let of_left = now.forecast.weights.iter().zip(&now.forecast.components).filter(|(_, c)| c.mean[0] < 0.0);
/// assert!(of_left.map(|(weight, _)| weight).sum::<f32>() > 0.9 && now.images == 2);
/// // This image shows that the place is taken, which counts from the next one on.
/// memory.compare(1, &[1.0]);
/// let next = memory.see(frame(2), &image(0.5));
/// assert!(next.states.weights[1] > 0.1 && next.states.hazard_by_places > 0.9);
/// # Ok::<(), carff_decision::ProbingError>(())
/// ```
#[derive(Clone, Debug)]
pub struct TakeMemory {
    memory: Memory,
    step: StepLength,
    progress: Option<TakeProgress>,
}

/// Progress of a take.
#[derive(Clone, Copy, Debug)]
struct TakeProgress {
    /// Capture time of the first image that was seen, nanoseconds.
    first_ns: u64,
    /// Time steps that the belief has been moved by.
    steps: u64,
    /// The last image.
    last: TakeFrame,
    /// Images so far.
    images: u64,
}

/// Content of the memory at an image, without the comparison of this image.
#[derive(Clone, Debug, PartialEq)]
pub struct Remembered {
    /// Number of the image's frame.
    pub frame: u64,
    /// Forecast from all images of the take so far.
    pub forecast: Mixture,
    /// Weights of the states.
    pub states: RememberedStates,
    /// Number of images so far, 1 if the memory starts anew.
    pub images: u64,
}

impl TakeMemory {
    /// A memory without a take.
    pub fn new(memory: Memory, step: StepLength) -> Self {
        Self { memory, step, progress: None }
    }

    /// Counts the forecast from the newest image, and returns what the memory then holds.
    pub fn see(&mut self, frame: TakeFrame, image: &Mixture) -> Remembered {
        let fits = |p: &TakeProgress| p.last.take_start == frame.take_start && !self.is_gap(p.last, frame);
        let mut progress = if let Some(progress) = self.progress.filter(fits) {
            progress
        } else {
            self.memory.clear();
            let first_ns = frame.capture_time_ns;
            TakeProgress { first_ns, steps: self.steps(first_ns, frame), last: frame, images: 0 }
        };
        let steps = self.steps(progress.first_ns, frame);
        (progress.steps..steps).for_each(|_| self.memory.advance());
        progress = TakeProgress { steps, last: frame, images: progress.images + 1, ..progress };
        self.progress = Some(progress);
        let forecast = self.memory.see(image);
        Remembered { frame: frame.frame, forecast, states: self.memory.remembered(), images: progress.images }
    }

    /// Weighs the belief by what frame `frame` shows of each place ([`Memory::compare`]). A frame that is not the last one
    /// counts for nothing: the comparison came too late.
    pub fn compare(&mut self, frame: u64, places: &[f64]) {
        if self.progress.is_some_and(|progress| progress.last.frame == frame) {
            self.memory.compare(places);
        }
    }

    /// Time steps from the start of the take to a frame.
    fn steps(&self, first_ns: u64, frame: TakeFrame) -> u64 {
        match self.step {
            StepLength::Frames(frames) => frame.frame.saturating_sub(frame.take_start) / frames.max(1),
            StepLength::TimeNs(step_ns) => frame.capture_time_ns.saturating_sub(first_ns) / step_ns.max(1),
        }
    }

    /// Reports whether more than a time step passed without an image, or time went back.
    fn is_gap(&self, last: TakeFrame, now: TakeFrame) -> bool {
        let (passed, longest) = match self.step {
            StepLength::Frames(frames) => (now.frame.checked_sub(last.frame), frames),
            StepLength::TimeNs(step_ns) => (now.capture_time_ns.checked_sub(last.capture_time_ns), step_ns),
        };
        passed.is_none_or(|passed| passed > longest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MemorySettings, Place, ProbeLayout};
    use carff_base::geometry::OrientedBox;
    use carff_messages::Gaussian;

    fn at(x: f32) -> Gaussian {
        Gaussian { mean: [x; 8], log_variance: [-4.0; 8] }
    }

    /// Two branches of two steps: states 0 -> 1 and 2 -> 3, which stay.
    fn memory(step: StepLength) -> TakeMemory {
        let states: Vec<Gaussian> = [-3.0, -1.0, 1.0, 3.0].map(at).to_vec();
        let forecast = |state: &Gaussian| {
            let next = if state.mean[0] < 0.0 { at(-1.0) } else { at(3.0) };
            Mixture { weights: vec![1.0], components: vec![next] }
        };
        let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
        let place = Place { name: "actor".into(), oriented_box, occupied_in: vec![true, true, false, false] };
        let layout = ProbeLayout::new(vec![place], vec![true, true, false, false]).unwrap();
        let settings = MemorySettings { repeated_share: 0.2, distrust: 0.01, place_strength: 5.0 };
        TakeMemory::new(Memory::new(&layout, states, forecast, settings), step)
    }

    fn image(first_branch: f32) -> Mixture {
        Mixture { weights: vec![first_branch, 1.0 - first_branch], components: vec![at(-1.0), at(3.0)] }
    }

    /// Weight of the first branch.
    fn first_branch(mixture: &Mixture) -> f32 {
        mixture.weights.iter().zip(&mixture.components).filter(|(_, c)| c.mean[0] < 0.0).map(|(w, _)| w).sum()
    }

    fn frame(take_start: u64, frame: u64) -> TakeFrame {
        TakeFrame { take_start, frame, capture_time_ns: 100 * frame }
    }

    /// The content of one image holds over later images that show nothing, over time steps, until the take ends.
    #[test]
    fn a_take_is_remembered() {
        for step in [StepLength::Frames(3), StepLength::TimeNs(300)] {
            let mut memory = memory(step);
            let even = |now: Remembered| ((first_branch(&now.forecast) - 0.5).abs() < 0.01, now.images);
            assert_eq!(even(memory.see(frame(0, 0), &image(0.5))), (true, 1));
            memory.see(frame(0, 1), &image(0.999));
            for later in 2..9 {
                let now = memory.see(frame(0, later), &image(0.5));
                assert!(first_branch(&now.forecast) > 0.95, "{now:?}");
                assert_eq!(now.images, later + 1);
            }
            assert_eq!(even(memory.see(frame(9, 9), &image(0.5))), (true, 1), "a new take");
            memory.see(frame(9, 10), &image(0.001));
            assert_eq!(even(memory.see(frame(9, 20), &image(0.5))), (true, 1), "a gap");
        }
    }

    /// An image that is wrong with certainty is corrected by the next ones.
    #[test]
    fn a_wrong_glance_is_corrected() {
        let mut memory = memory(StepLength::Frames(6));
        memory.see(frame(0, 0), &image(0.999));
        memory.see(frame(0, 1), &image(0.001));
        let now = memory.see(frame(0, 2), &image(0.001));
        assert!(first_branch(&now.forecast) < 0.5, "{now:?}");
    }

    /// A place that an image shows taken decides for its states, over later images that show nothing. A comparison that
    /// comes after the next image counts for nothing.
    #[test]
    fn a_place_is_remembered() {
        for (compared, low, high) in [(1, 0.98, 1.0), (0, 0.49, 0.51)] {
            let mut memory = memory(StepLength::Frames(3));
            memory.see(frame(0, 0), &image(0.5));
            memory.see(frame(0, 1), &image(0.5));
            memory.compare(compared, &[1.0]);
            let now = memory.see(frame(0, 2), &image(0.5));
            assert!((low..=high).contains(&first_branch(&now.forecast)), "{now:?}");
            memory.compare(2, &[0.0]);
            let later = memory.see(frame(0, 3), &image(0.5));
            assert!((low..=high).contains(&first_branch(&later.forecast)), "{later:?}");
        }
    }

    /// A component far from all known states passes through unchanged.
    #[test]
    fn the_unknown_passes_through() {
        let mut memory = memory(StepLength::Frames(6));
        let image = Mixture { weights: vec![0.25, 0.75], components: vec![at(-1.0), at(40.0)] };
        let mixture = memory.see(frame(0, 0), &image).forecast;
        let far: f32 =
            mixture.weights.iter().zip(&mixture.components).filter(|(_, c)| c.mean[0] > 9.0).map(|x| x.0).sum();
        assert!((far - 0.75).abs() < 1e-6, "{mixture:?}");
    }
}
