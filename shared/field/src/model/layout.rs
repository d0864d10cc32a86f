//! The places of the model's numbers: hash-grid levels and network layers in two flat buffers.

use super::network::{Dense, Mlp, Output};
use crate::config::{FieldConfig, LATENT_DIM};
use crate::kernels::hash_grid::{HashGrid, Level};

/// Returns the hash grid of a configuration.
pub(crate) fn hash_grid(config: &FieldConfig) -> HashGrid {
    let (low, high) = (f64::from(config.base_resolution), f64::from(config.max_resolution));
    let growth = if config.levels > 1 { (high / low).powf(1.0 / (config.levels - 1) as f64) } else { 1.0 };
    let most = 1_usize << config.log2_table_size;
    let mut first = 0;
    let levels = (0..config.levels)
        .map(|i| {
            let resolution = (low * growth.powi(i as i32) + 1e-6).floor();
            let vertices = (resolution as usize + 1).pow(3);
            let dense = vertices <= most;
            let entries = if dense { vertices } else { most };
            let level = Level { resolution: resolution as u32, first, entries, dense };
            first += entries;
            level
        })
        .collect();
    HashGrid { levels, features_per_level: config.features_per_level }
}

/// The hash grid, the networks, and the sizes of the two buffers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Layout {
    pub grid: HashGrid,
    /// Features of a point: inputs of the density network.
    pub features: usize,
    /// Outputs of the density network: the raw density, then the geometry features.
    pub geometry: usize,
    /// Spherical harmonics of a viewing direction.
    pub direction: usize,
    /// (features, z) to (raw density, geometry features).
    pub density: Mlp<3>,
    /// (outputs of the density network, direction, z) to a colour.
    pub color: Mlp<3>,
    /// (direction, z) to the colour beyond the bounds.
    pub background: Mlp<2>,
    pub table_len: usize,
    pub networks_len: usize,
}

impl Layout {
    /// Makes the layout of a configuration.
    pub fn new(config: &FieldConfig) -> Self {
        let grid = hash_grid(config);
        let entries: usize = grid.levels.iter().map(|l| l.entries).sum();
        let mut end = 0;
        let mut layer = |inputs: usize, latents: usize, outputs_used: usize| {
            let outputs = outputs_used.next_multiple_of(4);
            let weight = end;
            let bias = weight + (inputs + latents) * outputs;
            end = bias + outputs;
            Dense { inputs, latents, outputs, outputs_used, weight, bias }
        };
        let features = config.levels * config.features_per_level;
        let geometry = 1 + config.geometry_features;
        let direction = config.direction_degree * config.direction_degree;
        let width = config.hidden_width;
        let density = [layer(features, LATENT_DIM, width), layer(width, 0, width), layer(width, 0, geometry)];
        let color = [layer(geometry + direction, LATENT_DIM, width), layer(width, 0, width), layer(width, 0, 3)];
        let background = [layer(direction, LATENT_DIM, config.background_width), layer(config.background_width, 0, 3)];
        Self {
            table_len: entries * config.features_per_level,
            grid,
            features,
            geometry,
            direction,
            density: Mlp { layers: density, output: Output::Raw, trained_inputs: features },
            color: Mlp { layers: color, output: Output::Logistic, trained_inputs: geometry },
            background: Mlp { layers: background, output: Output::Logistic, trained_inputs: 0 },
            networks_len: end,
        }
    }

    /// Returns the layers with their names, in the order of the buffer.
    pub fn named_layers(&self) -> [(&'static str, Dense); 8] {
        let ([d0, d1, d2], [c0, c1, c2]) = (self.density.layers, self.color.layers);
        let [b0, b1] = self.background.layers;
        [
            ("density.0", d0),
            ("density.1", d1),
            ("density.2", d2),
            ("color.0", c0),
            ("color.1", c1),
            ("color.2", c2),
            ("background.0", b0),
            ("background.1", b1),
        ]
    }
}
