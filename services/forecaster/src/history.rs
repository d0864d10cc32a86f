//! The last images of a take, so that a comparison that comes late still counts.

use carff_decision::{Mixture, Remembered, TakeFrame, TakeMemory};
use std::collections::VecDeque;

/// Number of images that are kept: those that a restarted forecaster gets from shared memory.
const KEPT: usize = 48;

/// One image.
#[derive(Clone, Debug)]
struct Seen {
    frame: TakeFrame,
    forecast: Mixture,
    /// Values of the places in the image; `None` until its comparison comes.
    places: Option<Vec<f64>>,
}

impl Seen {
    fn count_in(&self, memory: &mut TakeMemory) {
        memory.see(self.frame, &self.forecast);
        if let Some(places) = &self.places {
            memory.compare(self.frame.frame, places);
        }
    }
}

/// A memory whose result does not depend on when the comparisons come, up to [`KEPT`] images later.
#[derive(Clone, Debug)]
pub struct TakeHistory {
    /// The memory before the oldest kept image.
    before: TakeMemory,
    /// The memory after the newest one.
    memory: TakeMemory,
    seen: VecDeque<Seen>,
    /// Comparisons that came before their posterior, by frame.
    early: VecDeque<(u64, Vec<f64>)>,
}

impl TakeHistory {
    /// A history without images.
    pub fn new(memory: TakeMemory) -> Self {
        Self { before: memory.clone(), memory, seen: VecDeque::new(), early: VecDeque::new() }
    }

    /// Counts the forecast of the next image, and returns what the memory then holds. The comparison of an image counts for
    /// the images after it.
    pub fn see(&mut self, frame: TakeFrame, forecast: Mixture) -> Remembered {
        if self.seen.len() == KEPT
            && let Some(oldest) = self.seen.pop_front()
        {
            oldest.count_in(&mut self.before);
        }
        let remembered = self.memory.see(frame, &forecast);
        let places = self.early.iter().position(|(of, _)| *of == frame.frame).and_then(|i| self.early.remove(i));
        let places = places.map(|(_, places)| places);
        if let Some(places) = &places {
            self.memory.compare(frame.frame, places);
        }
        self.seen.push_back(Seen { frame, forecast, places });
        remembered
    }

    /// Counts what the image of a frame shows of each place.
    pub fn compare(&mut self, frame: u64, places: Vec<f64>) {
        let Some(at) = self.seen.iter().rposition(|seen| seen.frame.frame == frame) else {
            if self.early.len() == KEPT {
                self.early.pop_front();
            }
            self.early.push_back((frame, places));
            return;
        };
        if self.seen[at].places.replace(places).is_none() && at + 1 == self.seen.len() {
            self.memory.compare(frame, self.seen[at].places.as_deref().unwrap_or_default());
        } else {
            self.memory = self.before.clone();
            for seen in &self.seen {
                seen.count_in(&mut self.memory);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::OrientedBox;
    use carff_decision::{Memory, MemorySettings, Place, ProbeLayout, StepLength};
    use carff_messages::Gaussian;

    fn at(x: f32) -> Gaussian {
        Gaussian { mean: [x; 8], log_variance: [-4.0; 8] }
    }

    /// Two states that stay; the second one takes the place.
    fn history() -> TakeHistory {
        let stays = |state: &Gaussian| Mixture { weights: vec![1.0], components: vec![*state] };
        let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
        let place = Place { name: "actor".into(), oriented_box, occupied_in: vec![false, true] };
        let layout = ProbeLayout::new(vec![place], vec![false, true]).unwrap();
        let settings = MemorySettings { repeated_share: 0.3, distrust: 0.1, place_strength: 4.0 };
        let memory = Memory::new(&layout, vec![at(-3.0), at(3.0)], stays, settings);
        TakeHistory::new(TakeMemory::new(memory, StepLength::Frames(6)))
    }

    fn image(frame: u64) -> (TakeFrame, Mixture) {
        let weight = 0.4 + 0.01 * (frame % 7) as f32;
        let forecast = Mixture { weights: vec![weight, 1.0 - weight], components: vec![at(-3.0), at(3.0)] };
        (TakeFrame { take_start: 0, frame, capture_time_ns: 100 * frame }, forecast)
    }

    /// Comparisons that come before their image, in time, or several images late give the same memory to the bit. The image's
    /// own comparison is not in its forecast.
    #[test]
    fn comparisons_count_whenever_they_come() {
        let places = |frame: u64| vec![if frame % 5 == 2 { 0.2 } else { -0.05 }];
        let (mut early, mut in_time, mut late) = (history(), history(), history());
        for frame in 0..100 {
            let (taken, forecast) = image(frame);
            early.compare(frame, places(frame));
            let [a, b] = [&mut early, &mut in_time].map(|history| history.see(taken, forecast.clone()));
            assert_eq!(a, b);
            in_time.compare(frame, places(frame));
            late.see(taken, forecast);
            if frame % 10 == 9 {
                (frame - 9..=frame).rev().for_each(|frame| late.compare(frame, places(frame)));
            }
        }
        let next = |mut history: TakeHistory, frame| {
            let (taken, forecast) = image(frame);
            history.see(taken, forecast)
        };
        let [a, b, c] = [early, in_time, late].map(|history| next(history, 100));
        assert_eq!((&a, &a), (&b, &c));
        let mut first = history();
        first.compare(0, vec![1.0]);
        let (taken, forecast) = image(0);
        let before = first.see(taken, forecast).states;
        assert!(before.weights[1] < 0.65 && before.hazard_by_places == 0.5);
        let after = next(first, 1).states;
        assert!(after.weights[1] > 0.9 && after.hazard_by_places > 0.9);
    }
}
