//! Forward: colours of the background and of the kept samples, with all activations stored.

use super::shard::{Background, KeptSample, Shard, Tile};
use crate::kernels::block::LANES;
use crate::kernels::math::spherical_harmonics;
use crate::march::samples::Samples;
use crate::model::field::{Field, Folded, RGB_ROWS};
use crate::model::network::{GROUP, Input};
use carff_base::geometry::Ray;

impl Shard {
    /// Computes the background's colour for each ray.
    pub(super) fn background_forward(&mut self, field: &Field) {
        let l = &field.layout;
        let count = self.rays.len().div_ceil(LANES);
        let Background { directions, hidden, output, rgb } = &mut self.background;
        let mut inputs = directions.blocks_mut(l.direction, count);
        inputs.as_mut_slice().fill(0.0);
        for (i, ray) in self.rays.iter().enumerate() {
            inputs.write_sample(i, 0, &spherical_harmonics(ray.direction)[..l.direction]);
        }
        let (input, y) = (Input::Features(inputs.into_blocks()), output.blocks_mut(RGB_ROWS, count));
        l.background.forward(field.weights(), &self.folded.background, input, hidden, y);
        let output = output.blocks(RGB_ROWS, count);
        rgb.clear();
        rgb.extend((0..self.rays.len()).map(|i| output.rgb(i)));
    }

    /// Computes the colours of the kept samples, a tile at a time.
    pub(super) fn color_forward(&mut self, field: &Field) {
        let tiles = self.kept.len().div_ceil(GROUP * LANES);
        if self.tiles.len() < tiles {
            self.tiles.resize_with(tiles, Tile::default);
        }
        for (tile, kept) in self.tiles.iter_mut().zip(self.kept.chunks_mut(GROUP * LANES)) {
            tile.gather(field, &self.rays, &self.samples, kept);
            tile.forward(field, &self.folded, kept);
        }
    }
}

impl Tile {
    /// Gathers features and directions of the kept samples; lanes that fill up the last block are zero.
    fn gather(&mut self, field: &Field, rays: &[Ray], samples: &Samples, kept: &[KeptSample]) {
        let l = &field.layout;
        let count = kept.len().div_ceil(LANES);
        let of_latent = &samples.by_latent[0];
        let from = samples.features.blocks(l.features, of_latent.ray.len() / LANES);
        let mut features = self.features.blocks_mut(l.features, count);
        let mut inputs = self.color_inputs.blocks_mut(l.geometry + l.direction, count);
        for at in kept.len()..count * LANES {
            for row in 0..l.features {
                *features.at_mut(at, row) = 0.0;
            }
            for row in l.geometry..l.geometry + l.direction {
                *inputs.at_mut(at, row) = 0.0;
            }
        }
        for (at, k) in kept.iter().enumerate() {
            let i = k.index as usize;
            features.copy_sample(at, from, i, l.features);
            let harmonics = spherical_harmonics(rays[of_latent.ray[i] as usize].direction);
            inputs.write_sample(at, l.geometry, &harmonics[..l.direction]);
        }
    }

    /// Runs both networks: the density network's outputs are the first inputs of the colour network.
    fn forward(&mut self, field: &Field, folded: &Folded, kept: &mut [KeptSample]) {
        let (l, weights) = (&field.layout, field.weights());
        let count = kept.len().div_ceil(LANES);
        let inputs = l.geometry + l.direction;
        let x = Input::Features(self.features.blocks(l.features, count));
        let y = self.color_inputs.blocks_mut(inputs, count);
        l.density.forward(weights, &folded.density, x, &mut self.density_hidden, y);
        let x = Input::Features(self.color_inputs.blocks(inputs, count));
        let y = self.output.blocks_mut(RGB_ROWS, count);
        l.color.forward(weights, &folded.color, x, &mut self.color_hidden, y);
        let output = self.output.blocks(RGB_ROWS, count);
        for (at, k) in kept.iter_mut().enumerate() {
            k.color = output.rgb(at);
        }
    }
}
