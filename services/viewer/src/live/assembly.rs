//! Assembles the messages of each frame of a run into the moments that the window shows.

use crate::input::{ChosenImage, Truth};
use crate::session::{Moment, ShownForecast};
use carff_dataset::Image;
use carff_decision::Step;
use carff_messages::{Belief, FrameMeta, Gaussian, Observability, Posterior, UnknownBox, Unknowns};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Maximum number of unfinished frames; the oldest are dropped.
const MOST_FRAMES: usize = 32;

/// Assembles the messages of each frame.
#[derive(Default)]
pub(super) struct Assembly {
    frames: BTreeMap<u64, Parts>,
}

struct Parts {
    input: Arc<ChosenImage>,
    unknowns: Arc<[UnknownBox]>,
    forecasts: BTreeMap<u32, carff_messages::Forecast>,
    moments: Vec<Moment>,
    /// The state that the last belief resolved to, and its posterior: the source of the next forecast.
    fed_back: Option<(Gaussian, usize)>,
}

impl Assembly {
    pub(super) fn frame(&mut self, frame_id: u64, input: ChosenImage) {
        let parts = Parts {
            input: Arc::new(input),
            unknowns: Arc::default(),
            forecasts: BTreeMap::new(),
            moments: Vec::new(),
            fed_back: None,
        };
        self.frames.insert(frame_id, parts);
        while self.frames.len() > MOST_FRAMES {
            self.frames.pop_first();
        }
    }

    pub(super) fn posterior(&mut self, posterior: &Posterior) {
        if let Some(parts) = self.frames.get_mut(&posterior.header.frame_id) {
            parts.moments = vec![Moment::of_posterior(parts.input.clone(), posterior.gaussian)];
        }
    }

    pub(super) fn forecast(&mut self, forecast: &carff_messages::Forecast) {
        if let Some(parts) = self.frames.get_mut(&forecast.header.frame_id) {
            parts.forecasts.insert(forecast.header.step, *forecast);
        }
    }

    pub(super) fn unknowns(&mut self, unknowns: &Unknowns) {
        if let Some(parts) = self.frames.get_mut(&unknowns.header.frame_id) {
            parts.unknowns = unknowns.boxes().into();
        }
    }

    /// Returns all moments of a frame when its last belief arrives.
    pub(super) fn belief(&mut self, belief: &Belief) -> Option<Vec<Moment>> {
        let frame_id = belief.header.frame_id;
        let parts = self.frames.get_mut(&frame_id)?;
        let forecast = parts.forecasts.get(&belief.header.step)?;
        // A step without the step before it cannot be followed: the window joined in between.
        let before = parts.moments.last().filter(|m| m.step + 1 == belief.header.step)?;
        let moment = moment(before, parts.fed_back, forecast, belief);
        parts.moments.push(moment);
        let state = usize::try_from(belief.resolved_state).ok().filter(|_| belief.fed_back().is_empty());
        parts.fed_back = state.map(|state| (belief.resolved, state));
        if !belief.is_final() {
            return None;
        }
        let Parts { mut moments, unknowns, .. } = self.frames.remove(&frame_id)?;
        for moment in &mut moments {
            moment.unknowns = unknowns.clone();
        }
        // Beliefs about older frames are not shown.
        self.frames.retain(|id, _| *id > frame_id);
        Some(moments)
    }
}

/// Returns the input image of a frame.
pub(super) fn input(meta: &FrameMeta, bytes: &[u8]) -> ChosenImage {
    let view = &meta.dataset_view;
    let observability = Observability::of_code(view.observability).ok().flatten();
    let index = |value: i32| usize::try_from(value).ok();
    let truth = match (index(view.branch), index(view.timestamp), index(view.view)) {
        (Some(branch), Some(timestamp), Some(view)) => Some(Truth { branch, timestamp, view, observability }),
        _ => None,
    };
    ChosenImage {
        title: format!("frame {}", meta.header.frame_id),
        image: Image { width_px: meta.width_px, height_px: meta.height_px, rgb: bytes.to_vec() },
        camera: Some(meta.camera()),
        truth: truth.filter(|_| view.is_known()),
        frame: meta.header.frame_id,
        seed: Some(meta.header.seed),
    }
}

/// Returns the moment of a step from the graph's messages. `fed_back` is the state that the step before resolved to.
fn moment(
    before: &Moment,
    fed_back: Option<(Gaussian, usize)>,
    forecast: &carff_messages::Forecast,
    belief: &Belief,
) -> Moment {
    let step = Step::of_messages(forecast, belief);
    let (mixture, draws) = (step.mixture.clone(), step.draws.clone());
    let (source, source_state) = match fed_back {
        Some((gaussian, state)) => (gaussian, Some(state)),
        None => (before.source, before.source_state),
    };
    let path = before.steps().cloned().collect();
    let path_probability = forecast.path_probability;
    let before = Moment { source, source_state, path_probability, path, ..before.clone() };
    Moment {
        belief: Some(step),
        ..Moment::of_forecast(&before, forecast.header.step, ShownForecast { mixture, draws })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_decision::Draw;
    use carff_messages::{ForecastSource, Header};

    fn meta(frame_id: u64) -> FrameMeta {
        let dataset_view = carff_messages::DatasetView {
            known: 1,
            view: 7,
            branch: 1,
            timestamp: 2,
            observability: carff_messages::Observability::None.code(),
            ..carff_messages::DatasetView::UNKNOWN
        };
        FrameMeta {
            header: Header::of_frame(frame_id, 5, 77),
            width_px: 2,
            height_px: 1,
            dataset_view,
            ..FrameMeta::default()
        }
    }

    fn posterior(frame_id: u64) -> Posterior {
        let header = Header::of_frame(frame_id, 5, 77);
        Posterior {
            header,
            gaussian: Gaussian { mean: [0.5; 8], ..Gaussian::standard() },
            take_start: 0,
            stage_latency_ns: 0,
        }
    }

    fn forecast(frame_id: u64, step: u32) -> carff_messages::Forecast {
        let header = Header::of_frame(frame_id, 5, 77).at_step(step);
        let mut forecast = carff_messages::Forecast::empty(header, ForecastSource::Observed, 2);
        (forecast.component_count, forecast.sample_count) = (2, 3);
        forecast.weights[..2].copy_from_slice(&[0.25, 0.75]);
        forecast.samples[2] = [step as f32; 8];
        forecast.sample_component[2] = 1;
        forecast.path_probability = 1.0 / step as f32;
        forecast
    }

    fn belief(frame_id: u64, step: u32) -> Belief {
        let mut belief = Belief::empty(Header::of_frame(frame_id, 5, 77).at_step(step), 2);
        (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (4, 2, 2, 3);
        belief.state_probability[..4].copy_from_slice(&[0.1, 0.6, 0.2, 0.1]);
        belief.samples[2].state = 1;
        belief.samples[2].occupancies[1] = 0.875;
        belief.resolved_state = 1;
        belief.resolved.mean = [9.0; 8];
        belief.path_probability = 1.0 / step as f32;
        belief
    }

    /// A frame's messages become its moments: the posterior, and each step with its belief. The second step starts from
    /// the state that the first resolved to. Nothing is shown before the last belief.
    #[test]
    fn messages_become_moments() {
        let mut assembly = Assembly::default();
        assembly.frame(3, input(&meta(3), &[1, 2, 3, 4, 5, 6]));
        assembly.posterior(&posterior(3));
        for step in [1, 2] {
            assembly.forecast(&forecast(3, step));
        }
        let mut unknowns = Unknowns::of_frame(Header::of_frame(3, 5, 77));
        (unknowns.box_count, unknowns.boxes[0].probability) = (1, 0.9);
        assembly.unknowns(&unknowns);
        assert!(assembly.belief(&belief(3, 1)).is_none());
        let moments = assembly.belief(&belief(3, 2)).unwrap();
        assert_eq!(moments.iter().map(|m| m.step).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(moments.iter().all(|m| m.unknowns[..] == unknowns.boxes[..1]));
        let input = &moments[0].input;
        assert_eq!((input.image.rgb.as_slice(), input.seed), ([1, 2, 3, 4, 5, 6].as_slice(), Some(77)));
        let truth = input.truth.unwrap();
        assert_eq!(
            (truth.branch, truth.timestamp, truth.view, truth.observability),
            (1, 2, 7, Some(Observability::None))
        );
        assert_eq!((moments[1].source.mean, moments[1].source_state), ([0.5; 8], None));
        assert_eq!((moments[2].source.mean, moments[2].source_state), ([9.0; 8], Some(1)));
        let last = &moments[2];
        assert_eq!((last.path_probability, last.path.len()), (0.5, 1));
        let step = last.belief.as_ref().unwrap();
        assert_eq!(step.resolved.state_probabilities, [0.1, 0.6, 0.2, 0.1]);
        assert_eq!((step.samples[2].reading.state, step.samples[1].reading.state), (Some(1), None));
        assert_eq!(step.samples[2].occupancies, [0.0, 0.875]);
        assert_eq!(last.forecast.as_ref().unwrap().draws[2], Draw { latent: [2.0; 8], component: 1 });
        assert_eq!(last.selection, crate::session::Selection::Component(1));
    }

    /// Frames without their first message or without an earlier step make no moment. The number of unfinished frames is
    /// bounded.
    #[test]
    fn what_is_incomplete_is_left_out() {
        let mut assembly = Assembly::default();
        assembly.posterior(&posterior(1));
        assembly.forecast(&forecast(1, 2));
        assert!(assembly.belief(&belief(1, 2)).is_none());
        assembly.frame(2, input(&meta(2), &[0; 6]));
        assembly.posterior(&posterior(2));
        assembly.forecast(&forecast(2, 2));
        assert!(assembly.belief(&belief(2, 2)).is_none());
        for frame_id in 3..200 {
            assembly.frame(frame_id, input(&meta(frame_id), &[0; 6]));
        }
        assert_eq!(assembly.frames.len(), MOST_FRAMES);
    }
}
