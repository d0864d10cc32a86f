//! The belief with and without memory, on drives whose camera pans.

use crate::trials::{
    views::SUREST,
    watches::{Watch, WatchedFrame},
};
use crate::{Progress, Subject};
use carff_checkpoint::FieldProbe;
use carff_decision::{Evidence, ImageEvidence, Memory, MemorySettings, Mixture, ProbeLayout, Sampling, is_likely};
use carff_trials::{RELIABILITY_BINS, SAMPLES, reliability};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A belief is sure of a hazard at or above this probability, and of none at or below its complement.
const SURE: f64 = 0.95;
/// The exact observer is sure beyond this probability.
const EXACTLY_SURE: f64 = 0.999;
/// Frames in which a wrong belief is to be corrected.
const CORRECTED_IN: usize = 3;

/// Frames of one kind, and those with the right belief.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RightFrames {
    /// Frames with the right belief.
    pub right: usize,
    /// Frames.
    pub frames: usize,
    /// Drives with such frames: what is independent.
    pub drives: usize,
}

/// Figures of one observer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObserverFigures {
    /// Mean of -ln of the probability given to what is true (hazard or none), clamped to 0.001..=0.999.
    pub log_loss: f64,
    /// Expected calibration error of the hazard probability.
    pub calibration_error: f64,
    /// The hazard was in sight and is hidden: at least 0.95.
    pub seen_then_hidden: RightFrames,
    /// The clear place was in sight and is hidden: at most 0.05.
    pub clear_then_hidden: RightFrames,
    /// Nothing was seen: 0.4 to 0.6.
    pub never_seen: RightFrames,
    /// Wrong beliefs about what the image shows (`frames`), and those corrected within three frames (`right`).
    pub corrected: RightFrames,
}

/// Figures by observer:
///
/// | name | belief |
/// |---|---|
/// | `none` | each image by itself |
/// | `compared` | each image by itself, with its comparison |
/// | `filter` | with memory |
/// | `graph` | with memory and with the comparison of each image, as the graph decides |
/// | `exact`, `exact_filter` | the exact posterior, of each image by itself and of all images |
pub type ByObserver = BTreeMap<String, ObserverFigures>;

/// The table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MemoryTable {
    /// Learned numbers of the memory.
    pub settings: MemorySettings,
    /// Drives.
    pub drives: usize,
    /// Frames.
    pub frames: usize,
    /// Figures by observer.
    pub observers: ByObserver,
}

/// Computes the table, or returns the reason why there is none.
pub fn memory(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<MemoryTable, String> {
    super::planning::plannable(subject)?;
    if subject.watches.is_empty() {
        return Err("there are no drives: the dataset has no scenario file".into());
    }
    let planner = subject.planner(Sampling::Stratified)?;
    let settings = subject.memory.ok_or("the checkpoint has no memory (`carff checkpoint memory` learns it)")?;
    let forecast = |state: &_| planner.net.forecast(state);
    let states = planner.probe.states().to_vec();
    let memory = Memory::new(planner.probe.layout(), states, forecast, settings);
    let mut probe = planner.probe.clone();
    let mut observers: BTreeMap<&str, Vec<Vec<f64>>> = BTreeMap::new();
    let total = subject.watches.len();
    for (done, watch) in subject.watches.iter().enumerate() {
        let seed = subject.options.seed;
        let mut of = |beliefs: Vec<Weighed>| -> Vec<f64> {
            let frames = watch.frames.iter().zip(&beliefs);
            frames.map(|(frame, (mixture, image))| hazard(&mut probe, mixture, image.as_ref(), frame, seed)).collect()
        };
        let by_itself = |compares: bool| {
            let of_frame = |f: &WatchedFrame| (f.forecast.clone(), f.image.clone().filter(|_| compares));
            watch.frames.iter().map(of_frame).collect()
        };
        let (filter, graph) = with_memory(&memory, planner.probe.layout(), &settings, watch);
        for (name, beliefs) in
            [("none", by_itself(false)), ("compared", by_itself(true)), ("filter", filter), ("graph", graph)]
        {
            observers.entry(name).or_default().push(of(beliefs));
        }
        observers.entry("exact").or_default().push(watch.frames.iter().map(|f| f.exact).collect());
        let exact = watch.frames.iter().map(|f| f.exact_with_memory).collect();
        observers.entry("exact_filter").or_default().push(exact);
        on_progress(&Progress { phase: "memory", done: done + 1, total, line: String::new() });
    }
    let figures = |(name, found): (&str, Vec<Vec<f64>>)| (name.to_owned(), figures(&subject.watches, &found));
    Ok(MemoryTable {
        settings,
        drives: total,
        frames: subject.watches.iter().map(|watch| watch.frames.len()).sum(),
        observers: observers.into_iter().map(figures).collect(),
    })
}

/// The forecast of a frame, and the evidence that weighs it.
type Weighed = (Mixture, Option<ImageEvidence>);

/// The forecast of each frame of a watch from all its images so far: the memory's own, and that of the graph, whose prober
/// weighs it by the frame's own image.
fn with_memory(
    memory: &Memory,
    layout: &ProbeLayout,
    settings: &MemorySettings,
    watch: &Watch,
) -> (Vec<Weighed>, Vec<Weighed>) {
    let mut memory = memory.clone();
    memory.clear();
    let mut step = watch.frames.first().map_or(0, |frame| frame.timestamp);
    let seen = watch.frames.iter().map(|frame| {
        (step..frame.timestamp).for_each(|_| memory.advance());
        step = frame.timestamp;
        let (before, states) = (memory.see(&frame.forecast), memory.remembered());
        let after = frame.image.as_ref().map_or_else(|| before.clone(), |image| memory.compare(image.places()));
        let image = frame.image.clone().map(|image| image.with_memory(states, layout, settings));
        ((after, None), (before, image))
    });
    seen.unzip()
}

/// Hazard probability of the next state, as the prober reads it.
fn hazard(
    probe: &mut FieldProbe,
    mixture: &Mixture,
    image: Option<&ImageEvidence>,
    frame: &WatchedFrame,
    seed: u64,
) -> f64 {
    let draws = mixture.draw(SAMPLES, Sampling::Stratified, seed, frame.frame, 1);
    let step = probe.step(mixture.clone(), draws, 1.0, image);
    Evidence::of_steps(&[step]).hazard_or_unknown_probability()
}

/// Figures of the probabilities `[watch][frame]` of an observer.
fn figures(watches: &[Watch], found: &[Vec<f64>]) -> ObserverFigures {
    let mut figures = ObserverFigures::default();
    let mut forecasts = Vec::new();
    for (watch, found) in watches.iter().zip(found) {
        let of_watch = kinds(watch, found);
        for (sum, of) in figures.kinds().into_iter().zip(of_watch) {
            sum.right += of.right;
            sum.frames += of.frames;
            sum.drives += usize::from(of.frames > 0);
        }
        forecasts.extend(found.iter().map(|&p| (p, watch.hazard)));
    }
    let loss = |&(p, hazard): &(f64, bool)| {
        let p = p.clamp(SUREST, 1.0 - SUREST);
        -(if hazard { p } else { 1.0 - p }).ln()
    };
    figures.log_loss = forecasts.iter().map(loss).sum::<f64>() / forecasts.len().max(1) as f64;
    figures.calibration_error = reliability(&forecasts, RELIABILITY_BINS).expected_calibration_error;
    figures
}

impl ObserverFigures {
    fn kinds(&mut self) -> [&mut RightFrames; 4] {
        [&mut self.seen_then_hidden, &mut self.clear_then_hidden, &mut self.never_seen, &mut self.corrected]
    }
}

/// Counts of one watch, in the order of [`ObserverFigures::kinds`].
fn kinds(watch: &Watch, found: &[f64]) -> [RightFrames; 4] {
    let mut counts = [RightFrames::default(); 4];
    let sure = |p: f64| !(1.0 - EXACTLY_SURE..=EXACTLY_SURE).contains(&p);
    for (k, (frame, &p)) in watch.frames.iter().zip(found).enumerate() {
        let (kind, right) = match (sure(frame.exact), sure(frame.exact_with_memory)) {
            (false, true) if watch.hazard => (0, p >= SURE),
            (false, true) => (1, p <= 1.0 - SURE),
            (_, false) if (0.4..=0.6).contains(&frame.exact_with_memory) => (2, (0.4..=0.6).contains(&p)),
            (true, _) if is_likely(p) != watch.hazard => {
                let later = found.iter().enumerate().skip(k + 1).take(CORRECTED_IN);
                (3, later.clone().any(|(_, &p)| is_likely(p) == watch.hazard))
            }
            _ => continue,
        };
        counts[kind].frames += 1;
        counts[kind].right += usize::from(right);
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Gaussian;

    /// A watch with these exact probabilities without and with memory.
    fn watch(hazard: bool, exact: &[(f64, f64)]) -> Watch {
        let forecast = Mixture { weights: vec![1.0], components: vec![Gaussian::standard()] };
        let frame = |(exact, exact_with_memory): &(f64, f64)| WatchedFrame {
            timestamp: 0,
            frame: 0,
            forecast: forecast.clone(),
            image: None,
            exact: *exact,
            exact_with_memory: *exact_with_memory,
        };
        Watch { number: 0, hazard, frames: exact.iter().map(frame).collect() }
    }

    /// A hazard is hidden, seen, and hidden again. Each kind of frame is counted where it is, and the loss is the closed
    /// form.
    #[test]
    fn frames_are_counted_by_kind() {
        let watches = [watch(true, &[(0.5, 0.5), (1.0, 1.0), (1.0, 1.0), (0.5, 1.0)])];
        let forgets = figures(&watches, &[vec![0.5, 0.2, 0.99, 0.5]]);
        let one = |right| RightFrames { right, frames: 1, drives: 1 };
        assert_eq!((forgets.never_seen, forgets.seen_then_hidden, forgets.corrected), (one(1), one(0), one(1)));
        assert_eq!(forgets.clear_then_hidden, RightFrames::default());
        let loss = -(0.5_f64.ln() + 0.2_f64.ln() + 0.99_f64.ln() + 0.5_f64.ln()) / 4.0;
        assert!((forgets.log_loss - loss).abs() < 1e-12);
        assert_eq!(figures(&watches, &[vec![0.5, 0.9, 0.99, 0.96]]).seen_then_hidden, one(1));
        let clear = figures(&[watch(false, &[(0.0, 0.0), (0.5, 0.0)])], &[vec![0.0, 0.04]]);
        assert_eq!(clear.clear_then_hidden, one(1));
    }
}
