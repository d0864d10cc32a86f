//! Backward: from the gradients by raw colours and densities to those by networks, hash table and latent.

use super::shard::{FoldedGradients, KeptSample, Shard, Tile, TileGradients};
use crate::kernels::block::LANES;
use crate::kernels::dispatch;
use crate::march::samples::Samples;
use crate::model::field::{Field, RGB_ROWS};
use crate::model::network::{Backward, GROUP};

/// The background gets a gradient when at least one ray has a larger transmittance than this.
const MIN_TRANSMITTANCE: f32 = 1e-3;

impl Shard {
    /// Backward of the kept samples' networks and of their features.
    pub(super) fn tiles_backward(&mut self, field: &Field) {
        let gradients = &mut self.tile_gradients;
        for (tile, kept) in self.tiles.iter().zip(self.kept.chunks(GROUP * LANES)) {
            gradients.networks(field, tile, kept, (&mut self.network_gradient, &mut self.folded_gradients));
            gradients.table(field, &self.samples, kept, &mut self.table_gradient);
        }
    }

    /// Backward of the background network.
    pub(super) fn background_backward(&mut self, field: &Field) {
        let l = &field.layout;
        let count = self.rays.len().div_ceil(LANES);
        let TileGradients { output, hidden, .. } = &mut self.tile_gradients;
        let mut dy = output.blocks_mut(RGB_ROWS, count);
        dy.as_mut_slice().fill(0.0);
        let rays = &self.samples.by_latent[0].rays;
        for (i, (state, rgb)) in rays.iter().zip(&self.background.rgb).enumerate() {
            for (c, v) in rgb.iter().enumerate() {
                *dy.at_mut(i, c) = self.pixels.rgb_gradient[i][c] * state.transmittance * v * (1.0 - v);
            }
        }
        if !rays.iter().any(|state| state.transmittance > MIN_TRANSMITTANCE) {
            return;
        }
        let work = Backward {
            gradient: &mut self.network_gradient,
            folded_gradient: &mut self.folded_gradients.background,
            hidden,
        };
        let pass = (self.background.directions.blocks(l.direction, count), &self.background.hidden);
        l.background.backward(field.weights(), pass, dy.into_blocks(), work, None);
    }
}

impl TileGradients {
    /// Backward of the colour network, then of the density network; leaves the gradient by features.
    fn networks(
        &mut self,
        field: &Field,
        tile: &Tile,
        kept: &[KeptSample],
        (gradient, folded): (&mut [f32], &mut FoldedGradients),
    ) {
        let (l, weights) = (&field.layout, field.weights());
        let count = kept.len().div_ceil(LANES);
        let inputs = l.geometry + l.direction;
        let mut dy = self.output.blocks_mut(RGB_ROWS, count);
        dy.as_mut_slice().fill(0.0);
        for (at, k) in kept.iter().enumerate() {
            dy.write_sample(at, 0, &k.color_gradient);
        }
        let pass = (tile.color_inputs.blocks(inputs, count), &tile.color_hidden);
        let mut d_inputs = self.color_inputs.blocks_mut(inputs, count);
        let work = Backward { gradient: &mut *gradient, folded_gradient: &mut folded.color, hidden: &mut self.hidden };
        l.color.backward(weights, pass, dy.into_blocks(), work, Some(d_inputs.reborrow()));
        for (at, k) in kept.iter().enumerate() {
            // The clamp of the raw density passes the gradient through, as instant-ngp's does.
            *d_inputs.at_mut(at, 0) += k.sigma_gradient;
        }
        let pass = (tile.features.blocks(l.features, count), &tile.density_hidden);
        let work = Backward { gradient, folded_gradient: &mut folded.density, hidden: &mut self.hidden };
        let d_features = self.features.blocks_mut(l.features, count);
        l.density.backward(weights, pass, d_inputs.into_blocks(), work, Some(d_features));
    }

    /// Backward of the features: adds to the gradient by the hash table.
    fn table(&mut self, field: &Field, samples: &Samples, kept: &[KeptSample], table_gradient: &mut [f32]) {
        let l = &field.layout;
        let mut features = self.features.blocks_mut(l.features, kept.len().div_ceil(LANES));
        self.points.clear();
        self.points.extend(kept.iter().map(|k| samples.points.points[k.index as usize]));
        if field.has_point_width() {
            self.widths.clear();
            self.widths.extend(kept.iter().map(|k| samples.widths[k.index as usize]));
            for (widths, block) in self.widths.chunks(LANES).zip(features.iter_mut()) {
                dispatch::attenuate(field.set, &l.grid, widths, block);
            }
        }
        for (points, block) in self.points.chunks(LANES).zip(features.into_blocks().iter()) {
            dispatch::scatter(field.set, &l.grid, table_gradient, points, block);
        }
    }
}
