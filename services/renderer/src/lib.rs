//! The renderer stage's arithmetic: the choice of hypotheses and cameras, and their images.

use anyhow::Context;
use carff_base::geometry::PinholeCamera;
use carff_checkpoint::Manifest;
use carff_config::ViewChoice;
use carff_field::{Field, HypothesisBuffer, InstructionSet, RenderBuffer, RenderOptions, to_byte};
use carff_messages::{Belief, Forecast, Header, LATENT_DIM, ViewKind, ViewMeta, row_major};
use std::path::Path;

/// Loads the field for rendering.
pub fn load(checkpoint: &Path) -> anyhow::Result<Field> {
    let mut field = carff_checkpoint::load_field(checkpoint, &Manifest::load(checkpoint)?)?;
    field.set_instruction_set(InstructionSet::detect_for_images());
    Ok(field)
}

/// A hypothesis to render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderedHypothesis {
    /// Index: a mixture component's, or the number of components plus a sample's.
    pub index: u32,
    /// Latent of the hypothesis.
    pub latent: [f32; LATENT_DIM],
    /// The state that probing found; -1 for none of the known ones.
    pub state: i32,
    /// Probability of the hypothesis, 0..=1.
    pub probability: f32,
}

/// Returns at most `count` hypotheses of a forecast and its belief, the most probable first: the component means, then
/// the samples.
pub fn hypotheses(forecast: &Forecast, belief: &Belief, count: usize) -> Vec<RenderedHypothesis> {
    let components = forecast.component_count as usize;
    let mut all: Vec<RenderedHypothesis> = (0..components)
        .map(|i| RenderedHypothesis {
            index: i as u32,
            latent: forecast.components[i].mean,
            state: belief.components[i].state,
            probability: forecast.weights[i].clamp(0.0, 1.0),
        })
        .collect();
    all.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    let samples = forecast.samples();
    let share = 1.0 / samples.len().max(1) as f32;
    all.extend(samples.iter().zip(belief.samples()).enumerate().map(|(i, (latent, probe))| RenderedHypothesis {
        index: (components + i) as u32,
        latent: *latent,
        state: probe.state,
        probability: share,
    }));
    all.truncate(count);
    all
}

/// Returns a camera over the field's region: straight down with +Y up in the image, or from a corner.
pub fn camera(field: &Field, choice: ViewChoice, width_px: u32, height_px: u32) -> PinholeCamera {
    let bounds_m = field.config().bounds_m.map(|corner| corner.map(f64::from));
    let [low, high] = bounds_m;
    match choice {
        ViewChoice::BirdsEye => PinholeCamera::above(bounds_m, width_px, height_px),
        ViewChoice::Free => PinholeCamera::look_at(
            [high[0], low[1], low[2] + PinholeCamera::height_above_m(bounds_m) * 0.5],
            [f64::midpoint(low[0], high[0]), f64::midpoint(low[1], high[1]), low[2] + 1.0],
            [0.0, 0.0, 1.0],
            width_px,
            height_px,
            PinholeCamera::ABOVE_FOV_DEG,
        ),
    }
}

/// The forecasts that wait for the belief which answers them.
#[derive(Debug, Default)]
pub struct Pairing {
    newest: Option<Forecast>,
}

impl Pairing {
    /// Remembers a forecast; only the newest is kept.
    pub fn forecast(&mut self, forecast: &Forecast) {
        self.newest = Some(*forecast);
    }

    /// Returns the forecast that a belief answers, where it is the newest one.
    pub fn answered(&self, belief: &Belief) -> Option<&Forecast> {
        let of = |header: &Header| (header.frame_id, header.step);
        self.newest.as_ref().filter(|forecast| of(&forecast.header) == of(&belief.header))
    }
}

/// Renders one image per hypothesis from one camera.
pub fn render(
    field: &Field,
    camera: &PinholeCamera,
    hypotheses: &[RenderedHypothesis],
    threads: usize,
    buffer: &mut HypothesisBuffer,
) {
    let options = RenderOptions { threads, ..RenderOptions::default() };
    let latents: Vec<[f32; LATENT_DIM]> = hypotheses.iter().map(|h| h.latent).collect();
    field.render_hypotheses(camera, &latents, &options, buffer);
}

/// Writes an image as 8-bit RGB, rows from the top.
pub fn write(image: &RenderBuffer, rgb: &mut [u8]) -> anyhow::Result<()> {
    let wanted = image.rgb.len();
    (rgb.len() == wanted).then_some(()).with_context(|| format!("{} bytes for a view of {wanted}", rgb.len()))?;
    for (to, from) in rgb.iter_mut().zip(&image.rgb) {
        *to = to_byte(*from);
    }
    Ok(())
}

/// Describes a rendered view.
pub fn meta(
    forecast: &Forecast,
    hypothesis: &RenderedHypothesis,
    choice: ViewChoice,
    camera: &PinholeCamera,
) -> ViewMeta {
    ViewMeta {
        header: forecast.header,
        hypothesis: hypothesis.index,
        kind: match choice {
            ViewChoice::BirdsEye => ViewKind::BirdsEye,
            ViewChoice::Free => ViewKind::Free,
        }
        .code(),
        state: hypothesis.state,
        width_px: camera.width_px,
        height_px: camera.height_px,
        probability: hypothesis.probability,
        latent: hypothesis.latent,
        intrinsics: camera.into(),
        world_from_camera: row_major(&camera.world_from_camera),
        stage_latency_ns: 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::ForecastSource;

    /// A belief is only paired with the forecast of its own frame and step, and only with the newest one.
    #[test]
    fn beliefs_are_paired_with_their_forecasts() {
        let header = |frame, step| Header::of_frame(frame, frame, 1).at_step(step);
        let mut pairing = Pairing::default();
        let belief = |frame, step| Belief::empty(header(frame, step), 2);
        assert!(pairing.answered(&belief(1, 1)).is_none());
        for step in 1..=2 {
            pairing.forecast(&Forecast::empty(header(1, step), ForecastSource::Observed, 2));
        }
        assert!(pairing.answered(&belief(1, 1)).is_none());
        assert_eq!(pairing.answered(&belief(1, 2)).map(|f| f.header.step), Some(2));
        assert!(pairing.answered(&belief(2, 2)).is_none());
    }
}
