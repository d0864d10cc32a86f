//! Densities at points under many latents: features and the first layer's products are computed once for all of them.

use std::cell::RefCell;

use super::field::Field;
use super::network::{GROUP, Hidden, Input};
use crate::config::LATENT_DIM;
use crate::kernels::block::{BlockBuffer, Blocks, BlocksMut, LANES};
use crate::kernels::dense::{Activation, Affine};
use crate::kernels::dispatch;

/// Outputs of the last layer that are computed: the raw density, and padding to a kernel's tile.
const LAST_OUTPUTS: usize = 4;

/// Points to evaluate again and again: their features through the first layer of the density network, before any
/// latent. Only valid for the field that prepared them.
#[derive(Clone, Debug, Default)]
pub struct PreparedPoints {
    count: usize,
    projected: BlockBuffer,
}

impl PreparedPoints {
    /// Returns the number of points.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Returns true if there are no points.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }
}

/// Buffers that are reused from call to call.
#[derive(Debug, Default)]
struct Scratch {
    points: Vec<[f32; 3]>,
    features: BlockBuffer,
    projected: BlockBuffer,
    latents: LatentScratch,
}

/// Buffers for the layers after the first.
#[derive(Debug, Default)]
struct LatentScratch {
    folded: Vec<f32>,
    last_weights: Vec<f32>,
    hidden: Hidden,
    raw: BlockBuffer,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

impl Field {
    /// Prepares world points (metres) for [`Field::density_prepared`].
    pub fn prepare(&self, points_m: &[[f32; 3]]) -> PreparedPoints {
        let points: Vec<[f32; 3]> = points_m.iter().map(|p| self.contraction.contract(*p)).collect();
        let mut prepared = PreparedPoints { count: points.len(), ..PreparedPoints::default() };
        let projected = self.projected(&mut prepared.projected, points.len());
        SCRATCH.with_borrow_mut(|scratch| self.project(&points, &mut scratch.features, projected));
        prepared
    }

    /// Computes the density (1/metre) at prepared points under each latent: `out[latent * points + point]`. Latents
    /// that do not fit into `out` are left out, extra room is left unchanged.
    pub fn density_prepared(&self, points: &PreparedPoints, latents: &[[f32; LATENT_DIM]], out: &mut [f32]) {
        let projected = points.projected.blocks(self.width(), points.count.div_ceil(LANES));
        SCRATCH.with_borrow_mut(|scratch| {
            self.density_of_projected((points.count, projected), latents, &mut scratch.latents, out);
        });
    }

    /// Computes the density (1/metre) at world points (metres) under one latent, for as many points as `out` and
    /// `points_m` both have.
    pub fn density(&self, points_m: &[[f32; 3]], latent: &[f32; LATENT_DIM], out: &mut [f32]) {
        let count = points_m.len().min(out.len());
        self.density_by_latent(&points_m[..count], std::slice::from_ref(latent), &mut out[..count]);
    }

    /// Computes the density (1/metre) at a height, metres, over the bounds: width, height and rows of an image with +X
    /// to the right, +Y up, and `longest_px` points along its longer side.
    pub fn density_slice(&self, latent: &[f32; LATENT_DIM], height_m: f32, longest_px: u32) -> (u32, u32, Vec<f32>) {
        let [low, high] = self.config().bounds_m;
        let extent_m = [high[0] - low[0], high[1] - low[1]];
        let pixel_m = extent_m[0].max(extent_m[1]) / longest_px.max(1) as f32;
        let [width_px, height_px] = extent_m.map(|e| ((e / pixel_m).round() as u32).max(1));
        let points: Vec<[f32; 3]> = (0..height_px)
            .flat_map(|y| (0..width_px).map(move |x| (x, y)))
            .map(|(x, y)| [low[0] + (x as f32 + 0.5) * pixel_m, high[1] - (y as f32 + 0.5) * pixel_m, height_m])
            .collect();
        let mut densities = vec![0.0; points.len()];
        self.density(&points, latent, &mut densities);
        (width_px, height_px, densities)
    }

    /// Computes the density (1/metre) at world points (metres) under each of several latents:
    /// `out[latent * points + point]`. Latents that do not fit into `out` are left out, extra room is left unchanged.
    pub fn density_by_latent(&self, points_m: &[[f32; 3]], latents: &[[f32; LATENT_DIM]], out: &mut [f32]) {
        let mut points = SCRATCH.with_borrow_mut(|scratch| std::mem::take(&mut scratch.points));
        points.clear();
        points.extend(points_m.iter().map(|p| self.contraction.contract(*p)));
        self.density_in_cube(&points, latents, out);
        SCRATCH.with_borrow_mut(|scratch| scratch.points = points);
    }

    /// As [`Self::density_by_latent`], at points of the unit cube.
    pub(crate) fn density_in_cube(&self, points: &[[f32; 3]], latents: &[[f32; LATENT_DIM]], out: &mut [f32]) {
        SCRATCH.with_borrow_mut(|scratch| {
            let Scratch { features, projected, latents: work, .. } = scratch;
            self.project(points, features, self.projected(projected, points.len()));
            let projected = projected.blocks(self.width(), points.len().div_ceil(LANES));
            self.density_of_projected((points.len(), projected), latents, work, out);
        });
    }

    fn width(&self) -> usize {
        self.config.hidden_width
    }

    fn projected<'a>(&self, buffer: &'a mut BlockBuffer, points: usize) -> BlocksMut<'a> {
        buffer.blocks_mut(self.width(), points.div_ceil(LANES))
    }

    /// Computes the first layer's products for points of the unit cube.
    fn project(&self, points: &[[f32; 3]], features: &mut BlockBuffer, projected: BlocksMut<'_>) {
        let l = &self.layout;
        for (points, projected) in points.chunks(GROUP * LANES).zip(projected.groups(GROUP)) {
            let count = projected.count();
            self.encode(points, None, features.blocks_mut(l.features, count));
            l.density.project(self.weights(), features.blocks(l.features, count), projected);
        }
    }

    /// Computes the rest of the density network for each latent, from the number of points and their projections.
    fn density_of_projected(
        &self,
        (count, projected): (usize, Blocks<'_>),
        latents: &[[f32; LATENT_DIM]],
        work: &mut LatentScratch,
        out: &mut [f32],
    ) {
        if count == 0 {
            return;
        }
        let LatentScratch { folded, last_weights, hidden, raw } = work;
        let (density, weights) = (&self.layout.density, self.weights());
        let [first, .., last] = &density.layers;
        last_weights.clear();
        let rows = last.weights(&self.networks).chunks_exact(last.outputs);
        last_weights.extend(rows.flat_map(|row| row[..LAST_OUTPUTS].iter().copied()));
        let last = Affine { weights: last_weights, bias: &last.biases(&self.networks)[..LAST_OUTPUTS] };
        for (latent, out) in latents.iter().zip(out.chunks_exact_mut(count)) {
            first.fold(&self.networks, &self.unit_scaled(latent), folded);
            for (group, out) in out.chunks_mut(GROUP * LANES).enumerate() {
                let blocks = out.len().div_ceil(LANES);
                let x = Input::Projected(projected.range(group * GROUP..group * GROUP + blocks));
                let x = density.forward_hidden(weights, folded, x, hidden, blocks);
                let raw_blocks = raw.blocks_mut(LAST_OUTPUTS, blocks);
                dispatch::dense_forward(self.set, last, x, raw_blocks, Activation::Identity);
                dispatch::sigma(self.set, raw.blocks(LAST_OUTPUTS, blocks), self.config.density_offset, out);
            }
        }
    }
}
