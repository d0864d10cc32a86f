//! What a camera would see: which of the known states look the same from a pose.

use crate::lanes::Lanes;
use carff_base::geometry::PinholeCamera;
use carff_field::{Field, HypothesisBuffer, RenderOptions};
use carff_messages::LATENT_DIM;

/// Longest side of the rendered views, pixels.
const SIDE_PX: u32 = 32;
/// Coarse: only whether a vehicle is in sight counts.
const COARSE: RenderOptions =
    RenderOptions { threads: 1, max_samples_per_ray: 96, min_transmittance: 0.1, min_weight: 0.1, step_scale: 2.0 };
/// A pixel differs if a channel differs by more than this, of 1.
const DIFFERENCE: f32 = 0.15;
/// Number of such pixels from which two states look different.
const DIFFERENT_PX: usize = 3;

/// Renders the known states from poses at which the camera is not yet. It reuses its memory.
#[derive(Debug, Default)]
pub struct Sight {
    buffer: HypothesisBuffer,
}

impl Sight {
    /// Renders the states from a pose. Returns false if the camera sees no lane: all states then look the same.
    pub fn look(
        &mut self,
        field: &Field,
        states: &[[f32; LATENT_DIM]],
        lanes: &Lanes,
        camera: &PinholeCamera,
        threads: usize,
    ) -> bool {
        let longest = camera.width_px.max(camera.height_px).max(1);
        let scaled = |side: u32| (side * SIDE_PX / longest).max(1);
        let small = camera.resized(scaled(camera.width_px), scaled(camera.height_px));
        let seen: Vec<bool> = lanes.ground_points(&small).iter().map(|g| g.is_some_and(|g| g.on_lanes)).collect();
        if !seen.contains(&true) || states.is_empty() {
            return false;
        }
        let options = RenderOptions { threads: threads.max(1), ..COARSE };
        field.render_hypotheses_where(&small, states, |i| seen[i], &options, &mut self.buffer);
        true
    }

    /// Reports whether two states look the same in the last look that saw a lane.
    pub fn alike(&self, a: usize, b: usize) -> bool {
        let Some((a, b)) = self.buffer.images.get(a).zip(self.buffer.images.get(b)) else { return true };
        let differ = |(a, b): &(&[f32], &[f32])| a.iter().zip(*b).any(|(a, b)| (a - b).abs() > DIFFERENCE);
        a.rgb.chunks_exact(3).zip(b.rgb.chunks_exact(3)).filter(differ).take(DIFFERENT_PX).count() < DIFFERENT_PX
    }
}
