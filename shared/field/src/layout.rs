//! Where each number of the model lies: hash-grid levels and network layers in two flat buffers.

use crate::config::{FieldConfig, LATENT_DIM};

/// One level of the hash grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Level {
    /// Cells along the cube's side.
    pub resolution: u32,
    /// First entry in the table.
    pub first: usize,
    /// Entries.
    pub entries: usize,
    /// Whether entries are found by coordinates (else by hash; then `entries` is a power of two).
    pub dense: bool,
}

pub(crate) fn grid_levels(config: &FieldConfig) -> Vec<Level> {
    let (low, high) = (f64::from(config.base_resolution), f64::from(config.max_resolution));
    let growth = if config.levels > 1 { (high / low).powf(1.0 / (config.levels - 1) as f64) } else { 1.0 };
    let most = 1_usize << config.log2_table_size;
    let mut first = 0;
    (0..config.levels)
        .map(|i| {
            let resolution = (low * growth.powi(i as i32) + 1e-6).floor();
            let vertices = (resolution as usize + 1).pow(3);
            let dense = vertices <= most;
            let entries = if dense { vertices } else { most };
            let level = Level { resolution: resolution as u32, first, entries, dense };
            first += entries;
            level
        })
        .collect()
}

/// One fully connected layer in the flat buffer: weights input-major, `[inputs + latents][outputs]`, then biases.
/// The latent's rows stand last, so that a prefix of the rows is the layer with the latent folded away.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub(crate) struct Layer {
    /// Inputs beside the latent.
    pub inputs: usize,
    /// 8 when the layer sees the latent, else 0.
    pub latents: usize,
    /// Outputs, padded to a multiple of 4.
    pub outputs: usize,
    /// Outputs that mean something.
    pub outputs_used: usize,
    pub weight: usize,
    pub bias: usize,
}

impl Layer {
    pub fn rows(&self) -> usize {
        self.inputs + self.latents
    }

    pub fn weights<'a>(&self, networks: &'a [f32]) -> &'a [f32] {
        &networks[self.weight..self.weight + self.inputs * self.outputs]
    }

    pub fn weights_mut<'a>(&self, networks: &'a mut [f32]) -> &'a mut [f32] {
        &mut networks[self.weight..self.weight + self.inputs * self.outputs]
    }

    pub fn biases<'a>(&self, networks: &'a [f32]) -> &'a [f32] {
        &networks[self.bias..self.bias + self.outputs]
    }

    pub fn biases_mut<'a>(&self, networks: &'a mut [f32]) -> &'a mut [f32] {
        &mut networks[self.bias..self.bias + self.outputs]
    }

    /// Its weights as pairs in bf16, in a buffer half as long as the networks' ([`crate::bf16::pack`]). They fit: what
    /// rounding up an odd number of inputs takes, the biases leave.
    pub fn pairs(&self) -> std::ops::Range<usize> {
        let start = self.weight / 2;
        start..start + self.inputs.div_ceil(2) * self.outputs
    }

    /// Biases with the latent's share added: `W_z z + b`.
    pub fn fold(&self, networks: &[f32], latent: &[f32; LATENT_DIM], out: &mut Vec<f32>) {
        out.clear();
        out.extend_from_slice(self.biases(networks));
        for (k, z) in latent.iter().enumerate().take(self.latents) {
            let row = &networks[self.weight + (self.inputs + k) * self.outputs..][..self.outputs];
            for (o, w) in out.iter_mut().zip(row) {
                *o += z * w;
            }
        }
    }

    /// Backward of `fold`: adds the gradient of bias and latent rows, and the latent's own gradient.
    pub fn fold_backward(
        &self,
        networks: &[f32],
        latent: &[f32; LATENT_DIM],
        bias_gradient: &[f32],
        gradient: &mut [f32],
        latent_gradient: &mut [f32; LATENT_DIM],
    ) {
        for (g, d) in self.biases_mut(gradient).iter_mut().zip(bias_gradient) {
            *g += d;
        }
        for k in 0..self.latents {
            let at = self.weight + (self.inputs + k) * self.outputs;
            let mut sum = 0.0;
            for (o, d) in bias_gradient.iter().enumerate().take(self.outputs) {
                gradient[at + o] += latent[k] * d;
                sum += networks[at + o] * d;
            }
            latent_gradient[k] += sum;
        }
    }
}

/// All layers, and the sizes of the two buffers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Layout {
    pub levels: Vec<Level>,
    pub features_per_level: usize,
    pub features: usize,
    pub geometry: usize,
    pub direction: usize,
    pub width: usize,
    pub density: [Layer; 3],
    pub color: [Layer; 3],
    pub background: [Layer; 2],
    pub table_len: usize,
    pub networks_len: usize,
}

impl Layout {
    pub fn new(config: &FieldConfig) -> Self {
        let levels = grid_levels(config);
        let entries: usize = levels.iter().map(|l| l.entries).sum();
        let mut end = 0;
        let mut layer = |inputs: usize, latents: usize, outputs_used: usize| {
            let outputs = outputs_used.next_multiple_of(4);
            let weight = end;
            let bias = weight + (inputs + latents) * outputs;
            end = bias + outputs;
            Layer { inputs, latents, outputs, outputs_used, weight, bias }
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
            levels,
            features_per_level: config.features_per_level,
            features,
            geometry,
            direction,
            width,
            density,
            color,
            background,
            networks_len: end,
        }
    }

    /// Names of the layers in the order of the buffer.
    pub fn named_layers(&self) -> [(&'static str, Layer); 8] {
        [
            ("density.0", self.density[0]),
            ("density.1", self.density[1]),
            ("density.2", self.density[2]),
            ("color.0", self.color[0]),
            ("color.1", self.color[1]),
            ("color.2", self.color[2]),
            ("background.0", self.background[0]),
            ("background.1", self.background[1]),
        ]
    }
}
