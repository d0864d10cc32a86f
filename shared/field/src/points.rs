//! Densities at points under many latents: what does not depend on the latent is computed once for all of them.

use std::cell::RefCell;

use crate::config::LATENT_DIM;
use crate::dispatch;
use crate::field::{Field, GROUP, grow};
use crate::kernels::{LANES, stride};

/// Outputs of the last layer that are computed: the raw density, and what fills up a kernel's tile.
const LAST_OUTPUTS: usize = 4;

/// Points that are asked about again and again: what the density network's first layer makes of their features, before
/// any latent. Of the field that prepared them, and no other.
#[derive(Clone, Debug, Default)]
pub struct PreparedPoints {
    count: usize,
    before: Vec<f32>,
}

impl PreparedPoints {
    /// How many points.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }
}

/// Reused from call to call.
#[derive(Debug, Default)]
struct Work {
    points: Vec<[f32; 3]>,
    features: Vec<f32>,
    before: Vec<f32>,
    first_bias: Vec<f32>,
    last_weights: Vec<f32>,
    hidden_a: Vec<f32>,
    hidden_b: Vec<f32>,
    raw: Vec<f32>,
}

thread_local! {
    static WORK: RefCell<Work> = RefCell::default();
}

impl Field {
    /// Prepares world points (metres) for [`Field::density_prepared`].
    pub fn prepare(&self, points_m: &[[f32; 3]]) -> PreparedPoints {
        let points: Vec<[f32; 3]> = points_m.iter().map(|p| self.contraction.contract(*p)).collect();
        let mut before = vec![0.0; points.len().div_ceil(LANES) * stride(self.layout.width)];
        WORK.with_borrow_mut(|work| self.before_latents(&points, &mut work.features, &mut before));
        PreparedPoints { count: points.len(), before }
    }

    /// Density (1/metre) at prepared points under each latent: `out[latent * points + point]`. Latents that do not fit
    /// into `out` are left out, extra room is left as it is.
    pub fn density_prepared(&self, points: &PreparedPoints, latents: &[[f32; LATENT_DIM]], out: &mut [f32]) {
        WORK.with_borrow_mut(|work| self.after_latents(points.count, &points.before, latents, work, out));
    }

    /// Density (1/metre) at world points (metres) under one latent. Handles as many points as `out` and `points` both
    /// have.
    pub fn density(&self, points_m: &[[f32; 3]], latent: &[f32; LATENT_DIM], out: &mut [f32]) {
        let count = points_m.len().min(out.len());
        self.density_by_latent(&points_m[..count], std::slice::from_ref(latent), &mut out[..count]);
    }

    /// Density (1/metre) at world points (metres) under each of several latents: `out[latent * points + point]`.
    /// Latents that do not fit into `out` are left out, extra room is left as it is.
    pub fn density_by_latent(&self, points_m: &[[f32; 3]], latents: &[[f32; LATENT_DIM]], out: &mut [f32]) {
        let mut points = WORK.with_borrow_mut(|work| std::mem::take(&mut work.points));
        points.clear();
        points.extend(points_m.iter().map(|p| self.contraction.contract(*p)));
        self.density_in_cube(&points, latents, out);
        WORK.with_borrow_mut(|work| work.points = points);
    }

    /// The same at points of the unit cube.
    pub(crate) fn density_in_cube(&self, points: &[[f32; 3]], latents: &[[f32; LATENT_DIM]], out: &mut [f32]) {
        WORK.with_borrow_mut(|work| {
            let mut before = std::mem::take(&mut work.before);
            let blocks = points.len().div_ceil(LANES);
            let filled = grow(&mut before, blocks * stride(self.layout.width));
            self.before_latents(points, &mut work.features, filled);
            self.after_latents(points.len(), filled, latents, work, out);
            work.before = before;
        });
    }

    /// Features of points of the unit cube through the first layer's weights, without its bias.
    fn before_latents(&self, points: &[[f32; 3]], features: &mut Vec<f32>, before: &mut [f32]) {
        let l = &self.layout;
        let (sf, sw) = (stride(l.features), stride(l.width));
        for (points, before) in points.chunks(GROUP * LANES).zip(before.chunks_mut(GROUP * sw)) {
            let features = grow(features, before.len() / sw * sf);
            self.encode(points, None, features);
            self.first_layer(features, before);
        }
    }

    /// The rest of the density network, for each latent.
    fn after_latents(
        &self,
        count: usize,
        before: &[f32],
        latents: &[[f32; LATENT_DIM]],
        work: &mut Work,
        out: &mut [f32],
    ) {
        if count == 0 {
            return;
        }
        let l = &self.layout;
        let [first, second, last] = &l.density;
        let (sw, so) = (stride(l.width), stride(LAST_OUTPUTS));
        let networks = &self.networks;
        work.last_weights.clear();
        let rows = last.weights(networks).chunks_exact(last.outputs);
        work.last_weights.extend(rows.flat_map(|row| row[..LAST_OUTPUTS].iter().copied()));
        let last_bias = &last.biases(networks)[..LAST_OUTPUTS];
        for (latent, out) in latents.iter().zip(out.chunks_exact_mut(count)) {
            first.fold(networks, &self.unit_scaled(latent), &mut work.first_bias);
            for (before, out) in before.chunks(GROUP * sw).zip(out.chunks_mut(GROUP * LANES)) {
                let blocks = before.len() / sw;
                let a = grow(&mut work.hidden_a, blocks * sw);
                let b = grow(&mut work.hidden_b, blocks * sw);
                let raw = grow(&mut work.raw, blocks * so);
                dispatch::bias_relu(self.set, before, &work.first_bias, a, sw);
                self.dense(second, second.biases(networks), a, b, true);
                dispatch::dense_forward(self.set, &work.last_weights, last_bias, b, sw, raw, so, false);
                dispatch::densities(self.set, raw, so, self.config.density_offset, out);
            }
        }
    }
}
